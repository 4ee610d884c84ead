"""How the messages of a topic are to come: their form, their arrays, their fragments, and what ROS 2 is asked for."""

from dataclasses import dataclass
from typing import Literal, get_args

from bridge.codecs.cbor_codec import Arrays
from bridge.errors import OptionError
from bridge.qos import Qos

Compression = Literal["none", "png", "cbor", "cbor-raw"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """How the messages of a topic are to come; all subscriptions of one topic by one client have it in common.

    Attributes:
        compression: ``cbor`` for long arrays, ``cbor-raw`` for the serialised bytes alone, ``png`` for servers of
            ROS 1 on thin lines. Many servers pass over what they do not know, and send JSON.
        arrays: what arrays of numbers become, whatever the server sends.
        fragment_size: characters of a message in one fragment at most; None for whole messages. Servers keep
            the last one that a client asked for and use it for all they send to it.
        qos: what the server is to ask of ROS 2.
    """

    compression: Compression = "none"
    arrays: Arrays = "list"
    fragment_size: int | None = None
    qos: Qos | None = None

    def __post_init__(self) -> None:
        """Refuse what servers would pass over without a word."""
        for name, choices in (("compression", get_args(Compression)), ("arrays", get_args(Arrays))):
            if getattr(self, name) not in choices:
                raise OptionError(f"{name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}")
        check_fragment_size(self.fragment_size)
        if self.compression == "cbor-raw" and self.arrays == "numpy":
            raise OptionError("cbor-raw brings bytes, no arrays: leave arrays out")


def check_fragment_size(size: int | None) -> None:
    """Refuse what is no size of a fragment.

    Raises:
        OptionError: it is neither None nor a whole number from 1 up.
    """
    if size is not None and (type(size) is not int or size < 1):
        raise OptionError(f"fragment_size must be a whole number from 1 up, or None, not {size!r}")
