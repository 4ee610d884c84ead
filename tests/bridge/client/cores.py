"""A client's core, and the test in the place of its server."""

import json
from typing import Any

from bridge.client.protocol import ClientCore


def connected(**options: Any) -> ClientCore:
    core = ClientCore(**options)
    core.restore()
    return core


def sent(core: ClientCore) -> list[dict[str, Any]]:
    return [json.loads(data) for data in core.data_to_send()]


def tell(core: ClientCore, now: float = 0.0, **operation: Any) -> Any:
    return core.receive(json.dumps(operation).encode(), now)
