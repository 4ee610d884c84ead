"""Connections to the rosbridge servers of a deployment."""

import contextlib
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from bridge.client import Ros, State, connect
from bridge.discovery import announced_uri
from services.settings import Settings

OnState = Callable[[str, State, str], None]
"""Callback with the URI of a server, the new state of its connection, and the reason."""


async def connect_all(
    stack: contextlib.AsyncExitStack,
    settings: Settings,
    uris: Iterable[str],
    by_uri: dict[str, Ros] | None = None,
    *,
    on_state: OnState | None = None,
    **options: Any,
) -> dict[str, Ros]:
    """Connect to each server once, and return the connections by URI.

    The URI in the settings replaces all others. Connections are added to `by_uri` as they are created, so that
    the status names a server that is waited for; `options` are those of `connect`.

    Raises:
        BridgeError: A server is unreachable, is not a rosbridge server, or is not announced.
    """
    by_uri = {} if by_uri is None else by_uri
    for uri in uris:
        if (used := settings.uri or uri) not in by_uri:
            by_uri[used] = connect(
                await announced_uri(used),
                connect_timeout=settings.connect_timeout,
                retry=True,
                ca_file=settings.ca,
                ros_version=settings.ros_version,
                check_types=False,  # our own messages need no check
                on_state=None if on_state is None else partial(on_state, used),
                **options,
            )
            await stack.enter_async_context(by_uri[used])
    return by_uri


def reconnect_now(rosbridges: Mapping[str, Ros]) -> None:
    """Try at once to reach the servers that are away: another service has reached one."""
    for ros in rosbridges.values():
        ros.reconnect_now()
