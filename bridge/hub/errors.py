"""What can keep the hub from serving, as one sentence for the user."""

from bridge.errors import BridgeError


class HubError(BridgeError):
    """Raised when the hub cannot serve at all: its address is taken, not this machine's, or not allowed."""

    exit_code = 2
