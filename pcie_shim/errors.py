"""Errors of boards and of the link. The text of each error is one sentence for the user."""


class PcieShimError(Exception):
    """Base class of this package's errors."""

    exit_code: int = 5


class EndpointError(PcieShimError):
    """An endpoint is neither `unix:/path` nor `tcp://host:port`, or the system cannot listen at it."""

    exit_code = 2


class CredentialsError(PcieShimError):
    """A key file cannot be used."""

    exit_code = 2


class ImageError(PcieShimError):
    """A programming file cannot be created or used, for example because the model is too large for the interface."""

    exit_code = 2


class DamagedImageError(ImageError):
    """The bytes of a programming file have changed since the file was written."""


class ImageMismatchError(ImageError):
    """An intact programming file does not fit this software, the board, or the other boards' files."""


class FrameInputError(PcieShimError):
    """The addresses, target, prior or bank of a frame do not fit the machine."""

    exit_code = 2


class SimulationError(PcieShimError):
    """A simulation of a board's hardware cannot be started, has ended, hangs, or gives an invalid answer."""


class LinkError(PcieShimError):
    """The link to a board is unusable."""


class LinkUnreachableError(LinkError):
    """Nothing listens at the board's endpoint."""


class LinkClosedError(LinkError):
    """The other end closed the link, or the caller had closed the handle."""


class LinkTimeoutError(LinkError):
    """An answer, or the rest of a frame, did not arrive in time."""


class FramingError(LinkError):
    """Received bytes are not a frame. Another program listens at the endpoint, or the stream is damaged."""


class CrcError(FramingError):
    """The CRC-32 of a frame does not match the frame's header and payload."""


class SequenceError(FramingError):
    """A frame was lost or repeated, or an answer does not belong to the request."""


class ShortReadError(FramingError):
    """A read was answered with fewer or more words than requested."""


class DeviceGoneError(LinkError):
    """The ID register reads all ones: no device answers behind the link."""


class KeyRefusedError(LinkError):
    """The board and the host do not have the same key."""

    exit_code = 2


class GreetingMismatchError(LinkError):
    """The board has another protocol version, register map or BAR size than the host."""

    exit_code = 2


class AccessError(LinkError):
    """The board has refused an access.

    Attributes:
        code: The board's error code: a `register_map.ErrorCode`, or an unknown number.
        detail: The board's explanation.
    """

    def __init__(self, sentence: str, *, code: int, detail: str) -> None:
        super().__init__(sentence)
        self.code = code
        self.detail = detail


class HeldError(AccessError):
    """Another host holds the board, or another loader is programming it."""


class StaleHandleError(AccessError):
    """The board was programmed again after the handle was opened."""


class BoardError(PcieShimError):
    """A board of the mini-cluster cannot be opened, or a frame failed on it. `board` is the board's number, from 0.

    `__cause__` is a LinkError or an ImageError. This error has the exit code of its cause.
    """

    def __init__(self, sentence: str, *, board: int, exit_code: int = 5) -> None:
        super().__init__(sentence)
        self.board = board
        self.exit_code = exit_code
