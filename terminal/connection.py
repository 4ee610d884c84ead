"""Messages for the user about lost and restored connections."""

import logging
from collections.abc import Callable

from terminal.logs import log_libraries
from terminal.output import say


def report_connection(uri: str) -> Callable[[str, str], None]:
    """Return a callback for a client's `on_state` that reports each lost and restored connection once."""
    # the client itself logs a warning at each loss
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
