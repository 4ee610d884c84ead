"""The host's view of a board: the link, the known contents of registers, and the board's part of a frame."""

import select
import struct
import time
from typing import Final

import numpy as np

from machines.kind import OUTCOME, Blocks, BoardResult, FrameSettings
from pcie_shim import register_map as rm
from pcie_shim.endpoint import Endpoint
from pcie_shim.errors import (
    BoardError,
    FramingError,
    GreetingMismatchError,
    ImageMismatchError,
    LinkClosedError,
    PcieShimError,
    SequenceError,
    ShortReadError,
)
from pcie_shim.host.loader import program
from pcie_shim.host.socket_link import Done, RegisterWrite, SocketLink
from pcie_shim.programming_file import Image
from pcie_shim.register_layout import ALL_ONES, DONE_BLOCK, SETTINGS, next_doorbell, register_values
from pcie_shim.register_map import BoardState

_ASSUMED_SPEED: Final = 1e4  # cycles per second of a board that does not report its speed
_START: Final = struct.Struct("<QI")  # RUN_UNTIL, START
_RESUME: Final = struct.Struct("<QII")  # RUN_UNTIL, START (0: no effect), RESUME
_BANK_AT: Final = rm.BANK - rm.TARGET_COUNT
_PRIOR_AT: Final = rm.PRIOR_SELECT - rm.TARGET_COUNT
_CAPABILITIES: Final = range(rm.CAP_MACHINE, rm.CAP_LINK + 4, 4)


class DrivenBoard:
    """One board of the mini-cluster, with the link and the register contents that the host knows."""

    def __init__(self, index: int, endpoint: Endpoint, image: Image, *, reprogram: bool = False) -> None:
        """Store the board's number, endpoint and image. `MiniCluster.open` describes `reprogram`."""
        self.index = index
        self.endpoint = endpoint
        self.image = image
        self._reprogram = reprogram

        # What follows from the image: the stop reasons, and the blocks of an answer, which begins with the results.
        self._kind = image.kind
        self._reasons = frozenset(image.kind.reasons) - {0}
        self.replicas = image.registers.replicas
        self._results_bytes = 4 * image.registers.result_words
        self._answer_blocks = [(rm.BLOCKS[name], words) for name, words in image.registers.answer.items()]

        # Either an open link, or None and the reason why.
        self.link: SocketLink | None = None
        self.broken = "it has not been opened"

        # As the board reports when it is opened: its cycles per second, and whether its interrupts carry the answer.
        self.speed = _ASSUMED_SPEED
        self.sends_results = False
        self._forget()

    def _forget(self) -> None:
        """Forget the contents of the registers, which another host may have written."""
        # Known contents of the board's blocks, empty if unknown: a frame writes only blocks that differ.
        self.settings: FrameSettings | None = None
        self._blocks: dict[str, bytes] = {}

        # Number of the last doorbell, and whether the board's answer to it is still missing; `done` is then None.
        self.number = 0
        self.waiting = False
        self.done: Done | None = None

        # True from `ask` until `fetch` has read what was asked for.
        self.asked = False

        # The last answer's words (set by `fetch`), the replicas' stop reasons, and if there are several, their cycles.
        self.answer = memoryview(b"")
        self.reasons: tuple[int, ...] = (0,) * self.replicas
        self._replica_cycles: tuple[int, ...] = ()

        # A poll of this board's link alone.
        self.readable = select.poll()

    # ---- opening --------------------------------------------------------------------------------------

    def open(self, timeout: float, connect_timeout: float, programming_timeout: float) -> None:
        """Open the board, or raise a PcieShimError. `programming_timeout` (seconds) limits each step of programming."""
        self.close("it is being opened")
        self._forget()
        link = self._identified(timeout, connect_timeout)
        try:
            held = link.read_block(rm.IMAGE_HASH, rm.IMAGE_HASH.words)
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
        if identity != rm.ID_VALUE:
            raise GreetingMismatchError(
                f"The device at {self.endpoint} is not a board: its ID is {identity:#010x} instead of {rm.ID_VALUE:#010x}"
            )
        map_hash = link.read_block(rm.MAP_HASH, rm.MAP_HASH.words).hex()
        if map_hash != rm.MAP_SHA256:
            raise GreetingMismatchError(
                f"The board at {self.endpoint} has register map {map_hash}, this software has "
                f"{rm.MAP_SHA256}: use a board and a host of the same version"
            )
        # a machine that another host left running would refuse every other write
        link.write32(rm.CONTROL, rm.CONTROL_RESET_MASK)
        # plain memory would return what was written, a board returns its complement
        pattern = time.monotonic_ns() & ALL_ONES
        link.write32(rm.LIVENESS, pattern)
        if link.read32(rm.LIVENESS) != pattern ^ ALL_ONES:
            raise GreetingMismatchError(
                f"The device at {self.endpoint} is not a board: its LIVENESS register does not read the complement of "
                "what was written"
            )

    def _check_image(self, link: SocketLink) -> None:
        found = link.read_block(rm.IMAGE_HASH, rm.IMAGE_HASH.words).hex()
        if found != self.image.image_hash:
            raise ImageMismatchError(
                f"The board at {self.endpoint} holds image {found}, the deployment's is "
                f"{self.image.image_hash}: program it with the loader, or restart it (a blank board is "
                "programmed when it is opened)"
            )

    def _check_capabilities(self, link: SocketLink) -> None:
        """Check that the registers used by the host exist, independently of the image hash."""
        words = struct.iter_unpack("<I", link.read_block(_CAPABILITIES.start, len(_CAPABILITIES)))
        theirs = dict(zip(_CAPABILITIES, (word for (word,) in words), strict=True))
        self.sends_results = bool(theirs[rm.CAP_LINK] & rm.CAP_LINK_SENDS_RESULTS_MASK)
        registers = self.image.registers
        # the capabilities decide how long a result is, and where its parts are
        for address, value in register_values(registers.capabilities).items():
            if theirs[address] != value:
                name = next(name for name, block in rm.BLOCKS.items() if block == address)
                raise ImageMismatchError(
                    f"The board at {self.endpoint} has {name} {theirs[address]:#x}, the deployment's image has {value:#x}: "
                    "program it with the loader, or restart it"
                )
        room = theirs[rm.CAP_INTERFACE] & 0xFFFF, theirs[rm.CAP_INTERFACE] >> 16
        inputs, results = registers.input_words, registers.result_words
        if inputs > room[0] or results > room[1]:
            raise ImageMismatchError(
                f"The board at {self.endpoint} has room for {room[0]} inputs and {room[1]} results, the deployment "
                f"needs {inputs} and {results}: build it for this interface, with more partitions or fewer replicas"
            )

    @property
    def open_link(self) -> SocketLink:
        """The link of an open board. Raises a LinkClosedError if the board is not open."""
        if self.link is None:
            raise LinkClosedError(
                f"The link to the board at {self.endpoint} is closed ({self.broken}): reopen the board"
            )
        return self.link

    def close(self, reason: str) -> None:
        """Close the link; the board stops computing."""
        if self.link is not None:
            self.link.close(reason)
            self.link = None
        self.broken = reason
        self.waiting = self.asked = False

    # ---- a frame --------------------------------------------------------------------------------------

    def start(self, settings: FrameSettings, blocks: Blocks, end: int) -> None:
        """Start a frame up to cycle `end`: write changed blocks and settings, and ring the doorbell (figure 3.3)."""
        self.waiting = True  # from here on, abandoning the frame must interrupt the board
        self._ring(settings, blocks, _START, end)

    def resume(self, settings: FrameSettings, blocks: Blocks, end: int) -> None:
        """Continue the frame up to cycle `end`: write changed blocks and settings, and ring the doorbell."""
        self._ring(settings, blocks, _RESUME, end, 0)

    def _changed(self, blocks: Blocks) -> list[RegisterWrite]:
        """Return the writes of blocks that differ from what the board has, and record that it has them."""
        writes: list[RegisterWrite] = []
        for name, words in blocks.items():
            if self._blocks.get(name) != words:
                writes.append((rm.BLOCKS[name], words))
                self._blocks[name] = words
        return writes

    def _changed_settings(self, settings: FrameSettings) -> bytes:
        """Return the settings from the first changed one on (empty without changes), and record them as known."""
        known = self.settings
        if settings == known:
            return b""
        words = SETTINGS.pack(*settings)
        self.settings = settings
        if known is None or settings[:2] != known[:2]:
            return words
        return words[_BANK_AT if settings.bank != known.bank else _PRIOR_AT :]

    def _ring(self, settings: FrameSettings, blocks: Blocks, layout: struct.Struct, *words: int) -> None:
        link = self.open_link
        writes = self._changed(blocks)
        # settings, slice and doorbell are adjacent, and so one burst
        before = self._changed_settings(settings)
        # the board refuses any number but the next, so a repeated start does nothing
        self.number = next_doorbell(self.number)
        self.waiting = True
        self.done = None
        writes.append((rm.RUN_UNTIL - len(before), before + layout.pack(*words, self.number)))
        link.post(writes)

    def receive(self) -> bool:
        """Receive from the link once, after a poll. Returns whether the board is done.

        Raises:
            LinkError: The link failed, or the board sent an answer that is invalid, repeated or for another doorbell.
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
        """Check the contents of an interrupt, and store them."""
        if not self.waiting or done.number != self.number:
            raise SequenceError(
                f"The board at {self.endpoint} answered doorbell {done.number} where {self.number} was due once"
            )
        due = sum(words for _, words in self._answer_blocks) if self.sends_results else 0
        if len(done.results) != 4 * due:
            raise ShortReadError(
                f"The board at {self.endpoint} sent {len(done.results) // 4} results with its interrupt where "
                f"{due} were due according to its CAP_LINK"
            )
        if done.state != BoardState.DONE or done.reason not in self._reasons:
            raise FramingError(
                f"The board at {self.endpoint} stopped with an impossible status, {done.status:#010x}"
            )
        self.waiting = False
        self.done = done

    def ask(self) -> None:
        """Request the answer of a board that is done, unless the board's interrupts carry the answers."""
        if not self.sends_results:
            self.asked = True
            self.open_link.ask([*self._answer_blocks, (rm.DONE, DONE_BLOCK.size // 4)])

    def fetch(self) -> None:
        """Store the answer of a board that is done. The interrupt carried the answer, or `ask` has requested it.

        This host holds the board, so no other host starts the machine. But if the board is reset or switched off
        between the interrupt and the reads, the results are cleared. `ask` therefore reads the results first, and then
        the registers from DONE to COMPUTE_NS. If DONE, STATUS and CYCLES still have the values that the interrupt
        reported, the results belong to this frame. Otherwise, a SequenceError is raised.
        """
        done = self._answered()
        words = done.results
        if self.asked:
            link = self.open_link
            *blocks, last = link.answers()
            self.asked = False
            words = memoryview(b"".join(blocks))
            number, status, cycles, _ = DONE_BLOCK.unpack(last)
            if (number, status, cycles) != done[:3]:
                raise SequenceError(
                    f"The board at {self.endpoint} changed while its results were read: DONE is {number} and STATUS "
                    f"{status:#010x} after {cycles} cycles, the interrupt said {done.number}, {done.status:#010x} and {done.cycles}"
                )
            if (second := link.take_done()) is not None:
                self._take(second)
        if self.replicas > 1:
            outcomes = np.frombuffer(words, OUTCOME, self.replicas, self._results_bytes)
            reasons = tuple(outcomes["reason"].tolist())
            if not self._reasons.issuperset(reasons):
                raise FramingError(f"The board at {self.endpoint} stopped a replica with an unknown reason")
            self.reasons = reasons
            self._replica_cycles = tuple(outcomes["cycles"].tolist())
        else:
            self.reasons = (done.reason,)
        self.answer = words

    def _answered(self) -> Done:
        if self.done is None:
            raise SequenceError(f"The board at {self.endpoint} has not answered doorbell {self.number}")
        return self.done

    def result(self) -> BoardResult:
        """Return the result of the frame, with a copy of the words in the link's buffer."""
        done = self._answered()
        words = bytes(self.answer[: self._results_bytes])
        if self.replicas == 1:
            return BoardResult(words, done.cycles, done.reason)
        joint = self._kind.joint_reason(self.reasons)
        return BoardResult(words, done.cycles, joint, self._replica_cycles, self.reasons)


def board_error(board: DrivenBoard, error: PcieShimError) -> BoardError:
    """Return a BoardError that wraps an error of a board's link or image."""
    return BoardError(f"Board {board.index}: {error}", board=board.index, exit_code=error.exit_code)
