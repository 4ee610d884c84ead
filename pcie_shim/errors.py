"""Errors of boards and of the link; the text of each is one sentence for the user."""


class PcieShimError(Exception):
    """Base class of this package's errors."""

    exit_code: int = 5


class EndpointError(PcieShimError):
    """An endpoint that is neither `unix:/path` nor `tcp://host:port`, or at which the system cannot listen."""

    exit_code = 2


class CredentialsError(PcieShimError):
    """A key file cannot be used."""

    exit_code = 2


class ImageError(PcieShimError):
    """A programming file that cannot be created or used, for example if the model is too large for the interface."""

    exit_code = 2


class DamagedImageError(ImageError):
    """A programming file whose bytes have changed since it was written."""


class ImageMismatchError(ImageError):
    """An intact programming file for another register map, format or set of boards."""


class FrameInputError(PcieShimError):
    """A frame whose addresses, target, prior or bank do not fit the machine."""

    exit_code = 2


class SimulationError(PcieShimError):
    """A simulation of a board's hardware that cannot be started, has ended, hangs, or answers garbage."""


class LinkError(PcieShimError):
    """An unusable link to a board."""


class LinkUnreachableError(LinkError):
    """Nothing listens at the board's endpoint."""


class LinkClosedError(LinkError):
    """The other end closed the link, or this handle was closed."""


class LinkTimeoutError(LinkError):
    """An answer, or the rest of a frame, did not arrive in time."""


class FramingError(LinkError):
    """Bytes that are not a frame: another program listens at the endpoint, or the stream is damaged."""


class CrcError(FramingError):
    """A frame with a CRC-32 that does not match its header and payload."""


class SequenceError(FramingError):
    """A frame out of order: lost, repeated, or not the answer to the request."""


class ShortReadError(FramingError):
    """A read was answered with fewer or more words than requested."""


class DeviceGoneError(LinkError):
    """The ID register reads all ones: no device answers behind the link."""


class KeyRefusedError(LinkError):
    """A board and a host that do not have the same key."""

    exit_code = 2


class GreetingMismatchError(LinkError):
    """A board with another protocol version, register map or BAR size."""

    exit_code = 2


class AccessError(LinkError):
    """An access that the board has refused.

    Attributes:
        code: The board's error code, a `register_map.ErrorCode` (or an unknown number).
        detail: The board's explanation.
    """

    def __init__(self, sentence: str, *, code: int, detail: str) -> None:
        super().__init__(sentence)
        self.code = code
        self.detail = detail


class HeldError(AccessError):
    """Another host holds the board, or another loader is programming it."""


class StaleHandleError(AccessError):
    """A handle of a board that was programmed again after the handle was opened."""


class BoardError(PcieShimError):
    """A board of the mini-cluster, with its number `board` from 0, that cannot be opened or on which a frame failed.

    `__cause__` is the LinkError or ImageError, whose exit code this error takes over.
    """

    def __init__(self, sentence: str, *, board: int, exit_code: int = 5) -> None:
        super().__init__(sentence)
        self.board = board
        self.exit_code = exit_code
