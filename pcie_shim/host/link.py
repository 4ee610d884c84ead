"""Interface of a link to one board: its registers, and its answer when the machine has stopped."""

from collections.abc import Iterable
from typing import Final, NamedTuple, Protocol, TypeAlias

from pcie_shim import register_map
from pcie_shim.endpoint import Endpoint
from pcie_shim.errors import LinkTimeoutError
from pcie_shim.framing import Octets

LONGEST_POLL_S: Final = 3600.0
"""Maximum duration of a single wait in seconds, because poll expects milliseconds in 31 bits."""

RegisterWrite: TypeAlias = "tuple[int, Octets]"
"""An address of the register map in bytes, and the little-endian words to write from that address on."""


class Done(NamedTuple):
    """The answer of a board when its machine has stopped.

    Attributes:
        number: The number of the start or resume that has stopped.
        status: The STATUS register.
        cycles: Cycles run in this frame.
        compute_ns: Computing time since that start or resume, in nanoseconds.
        results: One 32-bit count per line, replica after replica, followed by OUTCOMES if there are replicas;
            as bytes, valid until the link receives again.
    """

    number: int
    status: int
    cycles: int
    compute_ns: int
    results: memoryview

    @property
    def state(self) -> int:
        """STATUS.STATE."""
        return self.status & register_map.STATUS_STATE_MASK

    @property
    def reason(self) -> int:
        """STATUS.STOP_REASON."""
        return (self.status & register_map.STATUS_STOP_REASON_MASK) >> register_map.STATUS_STOP_REASON_SHIFT


class Link(Protocol):
    """An open link to a board over any medium; it closes itself when its data cannot be trusted.

    A host with one board reads, writes and waits. A host with many boards posts to each of them, polls their
    descriptors and receives what has arrived. Every method raises `LinkError`: `AccessError` if the board
    refused the access (the link stays open), and any other error if the link is broken (it is closed).
    """

    endpoint: Endpoint
    """Endpoint of the board."""

    token: bytes
    """Token that proves to the programming port that its owner holds this link."""

    def read32(self, address: int) -> int:
        """Read one register."""

    def write32(self, address: int, value: int) -> None:
        """Write one register and wait for the acknowledgement."""

    def read_block(self, address: int, count: int) -> bytes:
        """Read `count` words from `address` on, as little-endian bytes."""

    def write_block(self, address: int, words: Octets) -> None:
        """Write little-endian words from `address` on and wait for the acknowledgement."""

    def post(self, writes: Iterable[RegisterWrite]) -> None:
        """Write without waiting; a refusal is raised when the next answer is received."""

    def receive_done(self) -> Done | None:
        """Receive once, after a poll of `fileno()`; return the board's answer if it is complete."""

    def take_done(self) -> Done | None:
        """Return the board's answer if it has already been received completely."""

    def fileno(self) -> int:
        """Return a descriptor that is readable when data has arrived."""

    def timeout_error(self, timeout: float, what: str) -> LinkTimeoutError:
        """Return the error that the board did not `what` within `timeout` seconds."""

    def close(self, reason: str = "it was closed") -> None:
        """Close the link; later calls raise `LinkClosedError` with this reason."""
