"""The interface of a board to its server; emulated and simulated boards have it."""

from typing import Protocol


class Board(Protocol):
    """Registers and a machine, without sockets: blank until an image is loaded (docs/reference/registers.md)."""

    turned: float
    """Monotonic time at which its server last looked for requests; 0 before the first time."""
    programmed: int
    """Number of images loaded so far."""
    done: int
    """The number of the last start or resume that has stopped (register DONE)."""
    running: bool
    """True while the machine is running and `step` must be called."""
    stuck: bool
    """True if the machine runs forever without a cycle, by misbehaviour."""

    @property
    def image_hash(self) -> str:
        """SHA-256 (hex) of the loaded image; zeros while blank. Any thread may read it."""

    @property
    def interrupt_enabled(self) -> bool:
        """True if the host has enabled interrupts."""

    def load(self, content: bytes) -> None:
        """Program the board with the bytes of a programming file, or raise a RefusedError."""

    def read(self, address: int, count: int) -> bytes:
        """Return `count` words from `address` on, little-endian, or raise a RefusedError."""

    def write(self, address: int, words: bytes | memoryview) -> None:
        """Write little-endian words from `address` on, or raise a RefusedError; a doorbell starts the machine."""

    def step(self) -> None:
        """Run the machine for one more chunk; then `running` tells whether it must continue."""

    def interrupt_words(self) -> bytes:
        """Return the payload of an interrupt: DONE to COMPUTE_NS, one count per line, replicas' outcomes."""

    def release(self) -> None:
        """Stop a running machine and disable interrupts, because the host has disconnected."""
