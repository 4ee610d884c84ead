"""Errors of the hub: one that ends it, and two of single operations, which it handles itself."""

from bridge.errors import BridgeError


class HubError(BridgeError):
    """Raised when the hub cannot serve: its address, its limits or its access control are unusable."""

    exit_code = 2


class RefusedError(BridgeError):
    """Raised when the hub refuses an operation; the text is for the log, or for the answer to a call."""


class DefinitionsPendingError(Exception):
    """Raised when a message must be repeated once the message definitions are loaded."""

    def __init__(self, data: bytes | None = None) -> None:
        """Store the message if it arrived in fragments, which cannot be repeated."""
        super().__init__()
        self.data = data
