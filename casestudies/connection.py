"""What a person at the terminal is told of a connection that is lost and found again."""

from collections.abc import Callable

from bridge.client import State
from casestudies.running import say


def told(uri: str) -> Callable[[State, str], None]:
    """Return what a client calls with each new state (`on_state`): a loss is said once, and so is its end."""
    lost = False

    def state_changed(state: State, reason: str) -> None:
        nonlocal lost
        if state is State.RECONNECTING and not lost:
            lost = True
            say(f"warning: rosbridge at {uri} is gone ({reason}); waiting for it")
        elif state is State.CONNECTED and lost:
            lost = False
            say(f"rosbridge at {uri} is connected again")

    return state_changed
