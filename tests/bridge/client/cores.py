"""A client's core, and the test in the place of its server."""

import json

from bridge.client.protocol import ClientCore


def connected(**options):
    core = ClientCore(**options)
    core.restore()
    return core


def sent(core):
    return [json.loads(data) for data in core.data_to_send()]


def tell(core, now=0.0, **operation):
    return core.receive(json.dumps(operation).encode(), now)
