"""One board of the mini-cluster: its link, the known contents of its registers, its part of a frame."""

import select
import struct
import time
from typing import Final

import numpy as np
import numpy.typing as npt

from machines.bm1 import StopReason, joint_reason
from pcie_shim import register_map as rm
from pcie_shim.endpoint import Endpoint
from pcie_shim.errors import (
    AccessError,
    BoardError,
    BoardGoneError,
    BoardHeldError,
    BoardKeyError,
    BoardLinkError,
    BoardMismatchError,
    BoardRefusedError,
    BoardSilentError,
    BoardStaleError,
    BoardUnreachableError,
    DeviceGoneError,
    FramingError,
    GreetingMismatchError,
    HeldError,
    ImageError,
    ImageMismatchError,
    KeyRefusedError,
    LinkClosedError,
    LinkTimeoutError,
    LinkUnreachableError,
    PcieShimError,
    SequenceError,
    ShortReadError,
    StaleHandleError,
)
from pcie_shim.host.frame import BoardResult, BoardWords
from pcie_shim.host.loader import program
from pcie_shim.host.socket_link import Done, RegisterWrite, SocketLink
from pcie_shim.programming_file import Image, interface_words, is_plain
from pcie_shim.register_layout import ALL_ONES, REPLICA_OUTCOME, next_doorbell
from pcie_shim.register_map import BoardState

_ASSUMED_SPEED: Final = 1e4  # cycles per second of a board that does not report its speed
_START: Final = struct.Struct("<QI")  # RUN_UNTIL, START
_RESUME: Final = struct.Struct("<QII")  # RUN_UNTIL, START (0: no effect), RESUME
_BANK_AT: Final = rm.BANK - rm.TARGET_COUNT
_REASONS: Final = frozenset(StopReason) - {StopReason.NONE}
_PRIOR_AT: Final = rm.PRIOR_SELECT - rm.TARGET_COUNT
_CAPABILITIES: Final = range(rm.CAP_MACHINE, rm.CAP_INTERFACE + 4, 4)


class DrivenBoard:
    """One board: its link, and the known contents of its registers."""

    def __init__(self, index: int, endpoint: Endpoint, image: Image, *, reprogram: bool = False) -> None:
        """Store the number of the board, its place and image; `reprogram` is that of `MiniCluster.open`."""
        self.index = index
        self.endpoint = endpoint
        self.image = image
        self._reprogram = reprogram

        # What follows from the image: where the inputs are, and the extent of a result, which every answer must have.
        parameters = image.machine.parameters
        self.lines = parameters.lines
        self.replicas = parameters.replicas
        self.inputs_at = rm.SENSORS if is_plain(parameters) else rm.INPUTS
        self.counts_bytes = 4 * self.replicas * self.lines
        outcomes = self.replicas if self.replicas > 1 else 0
        self.result_bytes = self.counts_bytes + outcomes * REPLICA_OUTCOME.itemsize

        # Either an open link, or None and the reason why.
        self.link: SocketLink | None = None
        self.broken = "it has not been opened"

        # Cycles per second, as the board reports them when it is opened.
        self.speed = _ASSUMED_SPEED
        self._forget()

    def _forget(self) -> None:
        """Forget the contents of the registers, which another host may have written."""
        # What the board has: a frame writes only what differs. Empty or None: unknown.
        self.settings = b""
        self.selects = b""
        self.prior: npt.NDArray[np.uint16] | None = None

        # Number of the last doorbell, and whether its answer is still missing: then `done` is None.
        self.number = 0
        self.waiting = False
        self.done: Done | None = None

        # The replicas' part of the last answer, copied, because the others wait for the buffer of the link.
        self.outcomes: npt.NDArray[np.void] = np.zeros(0, REPLICA_OUTCOME)

        # A poll of this board's link alone.
        self.readable = select.poll()

    # ---- opening --------------------------------------------------------------------------------------

    def open(self, timeout: float, connect_timeout: float, programming_timeout: float) -> None:
        """Open the board as `MiniCluster.open` does; each step of programming may take `programming_timeout`.

        Raises:
            PcieShimError: An error of the link or of the image.
        """
        self.close("it is being opened")
        self._forget()
        link = self._identified(timeout, connect_timeout)
        try:
            held = link.read_block(rm.IMAGE_HASH, rm.IMAGE_HASH_WORDS)
            if not any(held) or (self._reprogram and held.hex() != self.image.image_hash):
                # with the token, because this host holds the board
                program(self.endpoint, self.image, timeout=programming_timeout, token=link.token)
                link.close("the board was programmed")
                link = self._identified(timeout, connect_timeout)
            self._check_image(link)
            self._check_capabilities(link)
            link.write32(rm.CONTROL, rm.CONTROL_RESET_MASK | rm.CONTROL_INTERRUPT_ENABLE_MASK)
            self.number = link.read32(rm.DONE)
            self.speed = float(link.read32(rm.CAP_SPEED)) or _ASSUMED_SPEED
        except BaseException:
            link.close("opening it failed")
            raise
        self.link = link
        self.readable.register(link.fileno(), select.POLLIN)

    def _identified(self, timeout: float, connect_timeout: float) -> SocketLink:
        """Return a link to the board, after checking its identity and register map."""
        link = SocketLink.open(self.endpoint, timeout=timeout, connect_timeout=connect_timeout)
        try:
            self._check_identity(link)
        except BaseException:
            link.close("opening it failed")
            raise
        return link

    def _check_identity(self, link: SocketLink) -> None:
        identity = link.read32(rm.ID)
        # a device that is gone reads all ones, and memory that is no board reads what was written
        pattern = time.monotonic_ns() & ALL_ONES
        link.write32(rm.LIVENESS, pattern)
        alive = link.read32(rm.LIVENESS) == pattern ^ ALL_ONES
        if identity != rm.ID_VALUE or not alive:
            raise GreetingMismatchError(
                f"The device at {self.endpoint} is not a board: its ID is {identity:#010x} instead of {rm.ID_VALUE:#010x}, "
                f"and its LIVENESS register is {'alive' if alive else 'dead'}"
            )
        map_hash = link.read_block(rm.MAP_HASH, rm.MAP_HASH_WORDS).hex()
        if map_hash != rm.MAP_SHA256:
            raise GreetingMismatchError(
                f"The board at {self.endpoint} has register map {map_hash}, this software has "
                f"{rm.MAP_SHA256}: use a board and a host of the same version"
            )

    def _check_image(self, link: SocketLink) -> None:
        found = link.read_block(rm.IMAGE_HASH, rm.IMAGE_HASH_WORDS).hex()
        if found != self.image.image_hash:
            raise ImageMismatchError(
                f"The board at {self.endpoint} holds image {found}, the deployment's is "
                f"{self.image.image_hash}: program it with the loader, or restart it (a blank board is "
                "programmed when it is opened)"
            )

    def _check_capabilities(self, link: SocketLink) -> None:
        """Check that the registers used by the host exist, independently of the image hash."""
        parameters = self.image.machine.parameters
        words = struct.iter_unpack("<I", link.read_block(_CAPABILITIES.start, len(_CAPABILITIES)))
        capabilities = dict(zip(_CAPABILITIES, (word for (word,) in words), strict=True))
        mode = capabilities[rm.CAP_MACHINE] & rm.CAP_MACHINE_SENSOR_MODE_MASK
        mode >>= rm.CAP_MACHINE_SENSOR_MODE_SHIFT
        room = capabilities[rm.CAP_INTERFACE] & 0xFFFF, capabilities[rm.CAP_INTERFACE] >> 16
        inputs, results = interface_words(parameters)
        wanted = rm.SensorMode[parameters.sensor_mode.name]
        # these decide how long a result is, and where its parts are
        for what, theirs, ours in (
            ("replicas", capabilities[rm.CAP_REPLICAS], parameters.replicas),
            ("sensor mode", mode, int(wanted)),
            ("lines", capabilities[rm.CAP_LINES], parameters.lines),
        ):
            if theirs != ours:
                raise ImageMismatchError(
                    f"The board at {self.endpoint} has {what} {theirs}, the deployment's image has {ours}: "
                    "program it with the loader, or restart it"
                )
        if inputs > room[0] or results > room[1]:
            raise ImageMismatchError(
                f"The board at {self.endpoint} has room for {room[0]} inputs and {room[1]} results, the deployment "
                f"needs {inputs} and {results}: build it for this interface, with more partitions or fewer replicas"
            )

    @property
    def open_link(self) -> SocketLink:
        """The link of an open board; a LinkClosedError without one."""
        if self.link is None:
            raise LinkClosedError(f"The link to the board at {self.endpoint} is closed: {self.broken}")
        return self.link

    def close(self, reason: str) -> None:
        """Close the link; the board stops computing."""
        if self.link is not None:
            self.link.close(reason)
            self.link = None
        self.broken = reason
        self.waiting = False

    # ---- a frame --------------------------------------------------------------------------------------

    def start(self, words: BoardWords, end: int) -> None:
        """Post a new frame: the sensors, the settings that changed, and the doorbell (figure 3.3)."""
        self.waiting = True  # from here on, abandoning the frame must interrupt the board
        settings, sensors, selects, prior = words
        writes: list[RegisterWrite] = [(self.inputs_at, sensors)] if sensors else []
        if selects != self.selects:
            writes.append((rm.PRIOR_SELECTS, selects))
            self.selects = selects
        if prior is not None and (self.prior is None or not np.array_equal(prior, self.prior)):
            writes.append((rm.PRIOR_CODES, prior.astype("<u4").tobytes()))
            self.prior = prior.copy()
        # Settings, slice and doorbell are adjacent: write one burst from the first changed setting on.
        known = self.settings
        if settings == known:
            at = len(settings)
        elif settings[:_BANK_AT] != known[:_BANK_AT]:
            at = 0
        elif settings[_BANK_AT:_PRIOR_AT] != known[_BANK_AT:_PRIOR_AT]:
            at = _BANK_AT
        else:
            at = _PRIOR_AT
        self.settings = settings
        self._ring(writes, rm.TARGET_COUNT + at, settings[at:], _START, end)

    def resume(self, end: int, halted: bytes = b"") -> None:
        """Post the next slice of the frame; `halted` are the words of HALT, empty if nothing is halted."""
        self._ring([(rm.HALT, halted)] if halted else [], rm.RUN_UNTIL, b"", _RESUME, end, 0)

    def _ring(
        self, writes: list[RegisterWrite], address: int, before: bytes, layout: struct.Struct, *words: int
    ) -> None:
        link = self.open_link
        # the board refuses any number but the next, so a repeated start does nothing
        self.number = next_doorbell(self.number)
        self.waiting = True
        self.done = None
        link.post([*writes, (address, before + layout.pack(*words, self.number))])

    def receive(self) -> bool:
        """Receive once, after a poll; return whether the board is done.

        Raises:
            LinkError: The link broke, or the board's answer is wrong, early or repeated.
        """
        link = self.open_link
        done = link.receive_done()
        is_done = done is not None
        # a second answer is an error, which must not wait until the next frame
        while done is not None:
            self._take(done)
            done = link.take_done()
        return is_done

    def _take(self, done: Done) -> None:
        """Check the answer of the board, and store it."""
        if not self.waiting or done.number != self.number:
            raise SequenceError(
                f"The board at {self.endpoint} answered doorbell {done.number} where {self.number} was due once"
            )
        if len(done.results) != self.result_bytes:
            raise ShortReadError(
                f"The board at {self.endpoint} sent {len(done.results) // 4} results where "
                f"{self.result_bytes // 4} were due"
            )
        if done.state != BoardState.DONE or done.reason not in _REASONS:
            raise FramingError(
                f"The board at {self.endpoint} stopped with an impossible status, {done.status:#010x}"
            )
        if self.replicas > 1:
            outcomes = np.frombuffer(done.results, REPLICA_OUTCOME, self.replicas, self.counts_bytes)
            if not _REASONS.issuperset(outcomes["reason"].tolist()):
                raise FramingError(f"The board at {self.endpoint} stopped a replica with an unknown reason")
            self.outcomes = outcomes.copy()
        self.waiting = False
        self.done = done

    @property
    def reason(self) -> int:
        """The last stop reason of the machine."""
        return 0 if self.done is None else self.done.reason

    def result(self) -> BoardResult:
        """Return the result of the frame; the counts are copied from the buffer of the link."""
        if self.done is None:
            raise SequenceError(f"The board at {self.endpoint} has not answered doorbell {self.number}")
        if self.replicas > 1:
            reasons = tuple(StopReason(reason) for reason in self.outcomes["reason"].tolist())
            joint = joint_reason(reasons, range(self.replicas))
            return BoardResult(
                words=bytes(self.done.results[: self.counts_bytes]),
                cycles=self.done.cycles,
                reason=joint if joint is not StopReason.NONE else StopReason.SLICE,
                replica_cycles=tuple(self.outcomes["cycles"].tolist()),
                replica_reasons=reasons,
            )
        return BoardResult(
            words=bytes(self.done.results), cycles=self.done.cycles, reason=StopReason(self.done.reason)
        )


_BOARD_ERRORS: Final[tuple[tuple[tuple[type[PcieShimError], ...], type[BoardError]], ...]] = (
    ((LinkUnreachableError,), BoardUnreachableError),
    ((HeldError,), BoardHeldError),
    ((StaleHandleError,), BoardStaleError),
    ((AccessError,), BoardRefusedError),
    ((GreetingMismatchError, ImageError), BoardMismatchError),
    ((KeyRefusedError,), BoardKeyError),
    ((LinkTimeoutError,), BoardSilentError),
    ((LinkClosedError, DeviceGoneError), BoardGoneError),
    ((PcieShimError,), BoardLinkError),
)


def board_error(board: DrivenBoard, error: PcieShimError) -> BoardError:
    """Return the error of a board for an error of its link or image."""
    kind = next(kind for causes, kind in _BOARD_ERRORS if isinstance(error, causes))
    return kind(f"Board {board.index}: {error}", board=board.index)
