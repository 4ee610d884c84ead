"""The outbox of a client: whole messages in order, while there is a connection."""

from collections.abc import Callable
from itertools import count
from typing import Any, Final

from bridge.codecs.json_codec import encode
from bridge.names import Kind, RosVersion, ros1_type, ros2_type

SMALLEST_LIMIT: Final = 2048
"""Minimum in bytes for a server's size limit: smaller ones count as this, so that subscriptions can always be sent."""


class Wire:
    """The outbox for all parts of a client's core, and the properties of the connection that they share."""

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
        """Return a type name in the form of the server's ROS version; while that is unknown, in the form of ROS 1.

        All servers accept the form of ROS 1.
        """
        return ros2_type(name, kind) if self.ros_version == 2 else ros1_type(name)

    def write(self, **operation: Any) -> None:
        """Add an operation to the outbox, as JSON."""
        self.write_bytes(encode(operation, max_size=self.sendable, max_depth=self.max_depth))

    def limit(self, size: int) -> None:
        """From now on, refuse to send messages of more than `size` bytes."""
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
