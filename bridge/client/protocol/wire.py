"""The outbox of a client: complete messages in order. Without a connection, it drops messages."""

from collections.abc import Callable
from itertools import count
from typing import Any, Final

from bridge.codecs.json_codec import encode
from bridge.names import Kind, RosVersion, ros1_type, ros2_type

SMALLEST_LIMIT: Final = 2048
"""If the size limit of a server is below this many bytes, the client uses this value, so that it can subscribe."""


class Wire:
    """The outbox and the properties of the connection, for all parts of a client's core."""

    def __init__(self, *, ros_version: RosVersion | None, max_size: int, max_depth: int) -> None:
        self._outbox: list[bytes] = []
        # Whether messages are stored; without a connection they are dropped, because `restore` repeats them.
        self.connected = False
        # ROS version of the server, as configured or detected; None while unknown.
        self.ros_version: RosVersion | None = ros_version
        # Returns a new number at each call, for ids on the wire and for handles.
        self.number: Callable[[], int] = count(1).__next__
        # Maximum size and nesting of a message in both directions, as configured.
        self.max_size = max_size
        self.max_depth = max_depth
        # Maximum size of an outbound message: `max_size`, or the known limit of the server. It never increases.
        self.sendable = max_size

    def type_name(self, name: str, kind: Kind = "msg") -> str:
        """Return a type name in the form of the server's ROS version.

        While the version is unknown, the name has the form of ROS 1, because all servers accept this form.
        """
        return ros2_type(name, kind) if self.ros_version == 2 else ros1_type(name)

    def write(self, **operation: Any) -> None:
        """Add an operation to the outbox, as JSON."""
        self.write_bytes(encode(operation, max_size=self.sendable, max_depth=self.max_depth))

    def limit(self, size: int) -> None:
        """Lower the maximum size of outbound messages to `size` bytes, but not below `SMALLEST_LIMIT`."""
        self.sendable = min(self.sendable, max(size, SMALLEST_LIMIT))

    def write_bytes(self, data: bytes) -> None:
        """Add an encoded message to the outbox."""
        # Dropped without a connection, because `restore` writes everything that is wanted by then.
        if self.connected:
            self._outbox.append(data)

    def take(self) -> list[bytes]:
        """Empty the outbox, and return its messages in order."""
        data, self._outbox = self._outbox, []
        return data

    def clear(self) -> None:
        """Drop everything that was not sent."""
        self._outbox.clear()
