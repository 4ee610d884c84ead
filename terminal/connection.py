"""Messages for the user about lost and restored connections."""

import logging
from collections.abc import Callable

from terminal.logs import log_libraries
from terminal.output import say, warn


def report_waits() -> Callable[[str, str, str], None]:
    """Return a callback that prints which servers a starting command waits for, and when they are connected."""
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
    """Return a callback for a client's `on_state`. The callback reports each lost and each restored connection once.

    The function also turns off the client's own warnings, because they would report each loss again.
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
