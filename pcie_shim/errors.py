"""What can go wrong between the host and its boards, each a sentence for the user."""

from __future__ import annotations

from typing import ClassVar


class PcieShimError(Exception):
    """Root of this package's errors; ``str(error)`` says what happened and what to do."""

    exit_code: ClassVar[int] = 5


class EndpointError(PcieShimError):
    """An endpoint's text is not ``unix:/path`` or ``tcp://host:port``, or the system cannot listen there."""

    exit_code = 2


class ImageError(PcieShimError):
    """A programming file cannot be made or used: a model too large for the interface, a wrong partition."""

    exit_code = 2


class DamagedImageError(ImageError):
    """A programming file's bytes are not those that were written: the sentence says which hash is wrong."""


class ImageMismatchError(ImageError):
    """A programming file is whole, but made for another register map, format or set of boards."""


class FrameInputError(PcieShimError):
    """What is to be computed does not fit the machine: addresses, target, prior or bank."""

    exit_code = 2


class LinkError(PcieShimError):
    """The connection to a board cannot be used (any more)."""


class UnreachableError(LinkError):
    """Nothing listens at the board's endpoint."""


class LinkClosedError(LinkError):
    """The other end closed the link, or this handle was closed."""


class LinkTimeoutError(LinkError):
    """An answer, or the rest of a frame, did not come in time."""


class FramingError(LinkError):
    """The bytes received are no frame of the link: another program listens there, or the stream is broken."""


class CrcError(FramingError):
    """A frame's CRC-32 is not that of its header and payload."""


class SequenceError(FramingError):
    """A frame came out of turn: lost, doubled, or not the answer to what was asked."""


class ShortReadError(FramingError):
    """A read was answered with fewer or more words than were asked for."""


class DeviceGoneError(LinkError):
    """The ID register reads all ones: no device answers behind the link."""


class GreetingMismatchError(LinkError):
    """The board speaks another protocol version, register map or BAR size; the sentence has both values."""

    exit_code = 2


class AccessError(LinkError):
    """The board refused an access and said why.

    Attributes:
        code: The board's error code, a ``register_map.ErrorCode`` (or an unknown number).
        detail: The board's own words.
    """

    def __init__(self, sentence: str, *, code: int, detail: str) -> None:
        super().__init__(sentence)
        self.code = code
        self.detail = detail


class HeldError(AccessError):
    """Another host holds the board, or another loader is programming it."""


class StaleHandleError(AccessError):
    """The board was programmed after this handle was opened: what it knows is no longer true."""


class BoardError(PcieShimError):
    """A board of the mini-cluster failed a frame or cannot be opened.

    Attributes:
        board: The board's number in the mini-cluster, from 0.
    """

    def __init__(self, sentence: str, *, board: int) -> None:
        super().__init__(sentence)
        self.board = board


class BoardUnreachableError(BoardError):
    """Nothing listens at the board's endpoint, or it does not greet."""


class BoardHeldError(BoardError):
    """Another host or loader holds the board."""


class BoardMismatchError(BoardError):
    """The board has another register map or image than the deployment; the sentence has both."""

    exit_code = 2


class BoardSilentError(BoardError):
    """The board did not answer, or did not say done, in time."""


class BoardGoneError(BoardError):
    """The board closed its link, or its registers read all ones."""


class BoardLinkError(BoardError):
    """What came over the link is broken: a short read, a wrong CRC, a wrong sequence number."""


class BoardRefusedError(BoardError):
    """The board answered ERROR to an access that the driver made."""


class BoardStaleError(BoardError):
    """The board was programmed by someone else since it was opened."""
