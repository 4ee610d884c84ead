"""Options of a subscription: encoding, arrays, fragments and quality of service."""

from dataclasses import dataclass
from typing import Literal, get_args

from bridge.codecs.cbor_codec import Arrays
from bridge.errors import OptionError
from bridge.qos import Qos

Compression = Literal["none", "png", "cbor", "cbor-raw"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """Delivery of messages, shared by all subscriptions of a client to one topic.

    Attributes:
        compression: `cbor` for long arrays, `cbor-raw` for only the serialised bytes, `png` for ROS 1 servers
            over slow networks. Many servers ignore an unknown value and send JSON.
        arrays: Python type of arrays of numbers, regardless of the encoding.
        fragment_size: Maximum number of characters in a fragment; None for whole messages. Servers apply the
            last value that a client requested to everything they send to it.
        qos: Quality of service in ROS 2.
        max_bytes: Maximum size of a message in bytes; larger ones are discarded. None for that of the connection.
    """

    compression: Compression = "none"
    arrays: Arrays = "list"
    fragment_size: int | None = None
    qos: Qos | None = None
    max_bytes: int | None = None

    def __post_init__(self) -> None:
        for name, choices in (("compression", get_args(Compression)), ("arrays", get_args(Arrays))):
            if getattr(self, name) not in choices:
                raise OptionError(f"{name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}")
        check_fragment_size(self.fragment_size)
        if self.max_bytes is not None and (type(self.max_bytes) is not int or self.max_bytes < 1):
            raise OptionError(
                f"max_bytes must be a whole number of at least 1, or None, not {self.max_bytes!r}"
            )
        if self.compression == "cbor-raw" and self.arrays == "numpy":
            raise OptionError("cbor-raw has bytes instead of arrays: omit arrays")


def check_fragment_size(size: int | None) -> None:
    """Raise an error for a fragment size that is neither None nor a positive integer."""
    if size is not None and (type(size) is not int or size < 1):
        raise OptionError(f"fragment_size must be a whole number of at least 1, or None, not {size!r}")
