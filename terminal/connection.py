"""Reports of a lost connection and of its return, for the person at the terminal."""

from __future__ import annotations

import logging
from collections.abc import Callable

from terminal.logs import log_libraries
from terminal.output import say


def report_connection(uri: str) -> Callable[[str, str], None]:
    """Return a callback for a client's `on_state` that reports each loss of the connection once, and its return."""
    # the client logs warnings of the same losses
    log_libraries(logging.ERROR, "%(name)s: %(message)s")
    lost = False

    def on_state(state: str, reason: str) -> None:
        nonlocal lost
        if state == "reconnecting" and not lost:
            lost = True
            say(f"warning: rosbridge at {uri} is gone ({reason}); waiting for it")
        elif state == "connected" and lost:
            lost = False
            say(f"rosbridge at {uri} is connected again")

    return on_state
