"""What leaves: whole messages in order, in the form of the server's ROS, and only while there is a connection."""

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, Literal

from bridge.client.protocol.subscription_options import check_fragment_size
from bridge.codecs.fragments import split
from bridge.codecs.json_codec import encode
from bridge.names import Kind, ros1_type, ros2_type

RosVersion = Literal[1, 2]


class Wire:
    """The outbox of a client, which all parts of its core write to.

    Attributes:
        connected: whether what is said gathers; without a connection it is dropped, for it is said again to the next.
        ros_version: which ROS the server speaks for, None while nobody knows.
        fragment_size: characters of a message beyond which `pieces` cuts it, None for never.
        max_size: bytes of a message at most.
        max_depth: objects and arrays within each other at most.
        number: gives a number that was never given before.
    """

    def __init__(
        self, *, ros_version: RosVersion | None, max_size: int, max_depth: int, fragment_size: int | None
    ) -> None:
        """Begin without a connection."""
        check_fragment_size(fragment_size)
        self.connected = False
        self.ros_version: RosVersion | None = ros_version
        self.fragment_size = fragment_size
        self.max_size = max_size
        self.max_depth = max_depth
        self._outbox: list[bytes] = []
        self.number: Callable[[], int] = count(1).__next__

    def type_name(self, name: str, kind: Kind = "msg") -> str:
        """A type's name as the server's ROS has it; as ROS 1 while nobody knows, which ROS 2 servers take too."""
        return ros2_type(name, kind) if self.ros_version == 2 else ros1_type(name)

    def say(self, **operation: Any) -> None:
        """Write an operation.

        Raises:
            EncodeError: it cannot leave as JSON; a NaN or an infinity is named with its place.
        """
        data = encode(operation, nonfinite="refuse", max_size=self.max_size, max_depth=self.max_depth)
        if self.connected:
            self._outbox.append(data)

    def put(self, data: bytes) -> None:
        """Have a whole message sent."""
        if self.connected:
            self._outbox.append(data)

    def take(self) -> list[bytes]:
        """Empty the outbox: whole messages, in order."""
        data, self._outbox = self._outbox, []
        return data

    def clear(self) -> None:
        """Drop what was not sent."""
        self._outbox.clear()

    def pieces(self, data: bytes) -> Iterator[bytes]:
        """A whole message as it goes onto the wire: itself, or its fragments if it is larger than one may be."""
        if self.fragment_size is None or len(data) <= self.fragment_size:
            yield data
        else:
            yield from split(data, self.fragment_size, f"fragment:{self.number()}")
