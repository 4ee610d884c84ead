"""Messages for the user about lost and restored connections."""

import logging
from collections.abc import Callable

from terminal.logs import log_libraries
from terminal.output import say, warn


def report_waits() -> Callable[[str, str, str], None]:
    """Return a callback for the states of servers that prints, during a command's start, which ones it waits for."""
    missing: set[str] = set()

    def on_state(uri: str, state: str, reason: str) -> None:
        if state == "connecting":
            missing.add(uri)
            say(f"waiting for rosbridge at {uri} ({reason})")
        elif state == "connected" and uri in missing:
            missing.discard(uri)
            say(f"rosbridge at {uri} is connected")

    return on_state


def report_connection(uri: str) -> Callable[[str, str], None]:
    """Return a callback for a client's `on_state` that reports each lost and restored connection once.

    It turns off the client's own warnings, which would report each loss a second time.
    """
    log_libraries(logging.ERROR, "%(name)s: %(message)s")
    missing = ""

    def on_state(state: str, reason: str) -> None:
        nonlocal missing
        if state == "connected" and missing:
            say(f"rosbridge at {uri} is connected{' again' if missing == 'reconnecting' else ''}")
            missing = ""
        elif state == "connecting":
            missing = state
            say(f"waiting for rosbridge at {uri} ({reason})")
        elif state == "reconnecting" and not missing:
            missing = state
            warn(f"rosbridge at {uri} is gone ({reason}); waiting for it")

    return on_state
