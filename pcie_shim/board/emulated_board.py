"""The emulated FPGA board, without sockets: a register file and a Bayesian machine.

    load ──▶ IDLE ── START ──▶ RUNNING ── step, step, ... ──▶ DONE (overflow, impossible, max cycles, end of a slice)
               ▲                  │                            │
               └───── reset ──────┴────────────────────────────┘ RESUME continues a slice

The register map is one array of bytes. Therefore a read is a slice, and only registers with side effects need code.
The machine runs in chunks of about 50 ms (`EmulatedBoard.step`). Between two chunks, the server can receive a reset.
Chunks do not change results, because a machine that is stopped and resumed continues with identical bits.
"""

import struct
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NoReturn

from machines.errors import MachineError, StartError
from machines.kind import BoardMachine, FrameSettings
from machines.parameters import CYCLES_MAX
from pcie_shim import register_map as rm
from pcie_shim.errors import ImageError, PcieShimError
from pcie_shim.programming_file import Image, image_from_bytes
from pcie_shim.register_layout import (
    ALL_ONES,
    DONE_BLOCK,
    SETTINGS,
    WORD,
    in_field,
    next_doorbell,
    register_values,
)
from pcie_shim.register_map import BoardState, ErrorCode

CHUNK_S: Final = 0.05
"""Length of a chunk in seconds. After each chunk of running the machine, the board reads from its host."""

_NO_ACCESS, _READ, _READ_WRITE = 0, 1, 3
_SETTINGS: Final = struct.Struct(f"{SETTINGS.format}Q")  # and RUN_UNTIL
_SHORTEST_CHUNK: Final = 64  # cycles, even if the machine is slow
_ALIGNMENT: Final = 4096  # chunks end between the blocks of a fast kernel


class RefusedError(PcieShimError):
    """Raised if a board refuses an access. `code` is the error code that the host receives."""

    def __init__(self, code: ErrorCode, detail: str) -> None:
        super().__init__(detail)
        self.code = code


class EmulatedBoard:
    """The registers and the machine of a board (docs/reference/registers.md). It is blank until an image is loaded."""

    def __init__(self, make: Callable[[Any], Any] | None = None, *, sends_results: bool = True) -> None:
        """Create a blank board. `make` creates the kernel of a machine; the default is `MachineKind.kernel`.

        If `sends_results` is False, interrupts do not contain the results. As on hardware, the host must then read the
        results.
        """
        self._make = make
        self._sends_results = sends_results
        self.turned = 0.0
        """Monotonic time at which the board's server last polled for requests; 0 before the first poll."""
        self.programmed = 0
        """Number of images loaded so far."""
        self.done = 0
        """Doorbell number of the last completed run, as in the register DONE. A start or a resume begins a run."""
        self.running = False
        """True while the machine is running and `step` must be called; registers are then read-only."""

        # The whole map, and for each word of it whether it may be read and written. Changed by `load` alone.
        self._memory = bytearray(rm.BAR_SIZE)
        self._view = memoryview(self._memory)
        self._access = bytearray(rm.BAR_SIZE // 4)

        # The machine of the loaded image, None while blank, which reads and writes the blocks of the map; and the
        # words that an interrupt carries: from DONE on, and if it sends results, those that the image names.
        self._machine: BoardMachine | None = None
        self._blocks = {
            name: self._view[block : block + 4 * block.words] for name, block in rm.BLOCKS.items()
        }
        self._answer = [self._view[rm.DONE : rm.DONE + DONE_BLOCK.size]]

        # High words of 64-bit registers by address, from the read of the low word until they are read.
        self._latched: dict[int, bytes] = {}

        # Why the last access was refused, for STATUS.ERROR; cleared by a reset.
        self._error = ErrorCode.NONE

        # Cycles of the next chunk, which adapts to the measured speed, and of the first one of each frame.
        self._chunk = self._first_chunk = _SHORTEST_CHUNK

        # Of the last start or resume: its limits, its computing time so far, and its doorbell number.
        self._max_cycles = 0
        self._run_until = 0
        self._compute_ns = 0
        self._number = 0
        self._power_up()

    # ---- identity -------------------------------------------------------------------------------------

    @property
    def image_hash(self) -> str:
        """SHA-256 of the loaded image in hexadecimal, or zeros while the board is blank."""
        return bytes(self._view[rm.IMAGE_HASH : rm.IMAGE_HASH + 32]).hex()

    @property
    def interrupt_enabled(self) -> bool:
        """True if the host has enabled interrupts."""
        return bool(self._memory[rm.CONTROL] & rm.CONTROL_INTERRUPT_ENABLE_MASK)

    def _power_up(self) -> None:
        """Set all registers to those of a blank board."""
        self._memory[:] = bytes(rm.BAR_SIZE)
        self._put(rm.ID, rm.ID_VALUE)
        self._put(rm.MAP_VERSION, rm.MAP_VERSION_VALUE)
        self._put(rm.LIVENESS, ALL_ONES)
        self._put(rm.PROGRAMMED, self.programmed)
        self._put(rm.CAP_LINK, self._sends_results)
        self._view[rm.MAP_HASH : rm.MAP_HASH + 32] = bytes.fromhex(rm.MAP_SHA256)
        self._latched.clear()
        self.done = 0
        for block in rm.BLOCKS.values():
            self._allow(block, block.words, _READ_WRITE if block.writable else _READ)
        for window in _DATA:
            self._allow(window.start, len(window) // 4, _NO_ACCESS)

    def load(self, content: bytes) -> None:
        """Program the board with the bytes of a programming file.

        The method prepares the machine (about 0.1 s), measures the machine's speed for a few milliseconds, and resets
        the machine.

        Raises:
            RefusedError: The machine is running, the image is damaged, or the image is for another register map.
        """
        if self.running:
            raise RefusedError(ErrorCode.BUSY, "the machine is running; reset it before programming")
        try:
            image = image_from_bytes(content, "the image")
            kernel = (self._make or image.kind.kernel)(image.machine)
            machine = image.kind.on_board(kernel, self._blocks)
            # now, so that the first frame does not wait for it
            machine.prepare()
            speed = self._measured_speed(image, machine)
        except (ImageError, MachineError) as error:
            raise RefusedError(ErrorCode.BAD_IMAGE, str(error).rstrip(".")) from error
        self._machine = machine
        self.programmed += 1
        # the registers of the former image must not be seen beside those of this one
        self._power_up()
        self._describe(image)
        self._first_chunk = max(int(speed * CHUNK_S), _SHORTEST_CHUNK)
        self._put(rm.CAP_SPEED, min(int(speed), ALL_ONES))
        self.reset()

    def _describe(self, image: Image) -> None:
        """Set the capability registers, and permit access to the words that the image implements."""
        registers, part = image.registers, image.partition
        self._view[rm.IMAGE_HASH : rm.IMAGE_HASH + 32] = bytes.fromhex(image.image_hash)
        capabilities = {
            **registers.capabilities,
            "CAP_TOTAL_LINES": part.total_lines,
            "CAP_LINE_OFFSET": part.line_offset,
            "CAP_PARTITION.INDEX": part.index,
            "CAP_PARTITION.COUNT": part.count,
            "CAP_INTERFACE.SENSORS": image.interface_sensors,
            "CAP_INTERFACE.RESULTS": image.interface_results,
        }
        for address, value in register_values(capabilities).items():
            self._put(address, value)
        for name, words in image.kind.contents(image.machine).items():
            self._blocks[name][: len(words)] = words
        if self._sends_results:
            self._answer[1:] = [self._blocks[name][: 4 * words] for name, words in registers.answer.items()]
        self._allow(rm.BLOCKS[registers.inputs], image.interface_sensors, _READ_WRITE)
        for name, count in {**registers.answer, "RESULTS": image.interface_results}.items():
            self._allow(rm.BLOCKS[name], count, _READ)
        for name, count in registers.written.items():
            self._allow(rm.BLOCKS[name], count, _READ_WRITE)

    def _measured_speed(self, image: Image, machine: BoardMachine) -> float:
        """Measure the cycles per second of the frame that takes longest to emulate.

        The measured time is the CPU time of the thread. Other load on the computer therefore does not make the board
        appear slow. The inputs of the frame remain in the registers.
        """
        host = image.kind.on_host([image.machine])
        course = host.begin(host.slowest())
        for name, words in course.starts[0].items():
            self._blocks[name][: len(words)] = words
        machine.start(course.settings, 1)  # the first start of a kernel takes longer
        began = time.thread_time_ns()
        machine.start(course.settings, 1)
        while machine.paused and machine.cycles < _ALIGNMENT:
            if time.thread_time_ns() - began > CHUNK_S * 1e8:
                break
            machine.step(2 * machine.cycles)
        return machine.cycles * 1e9 / max(time.thread_time_ns() - began, 1)

    # ---- registers ------------------------------------------------------------------------------------

    def read(self, address: int, count: int) -> bytes:
        """Return `count` words from `address` on, or raise a RefusedError if the board lacks one of the words."""
        end = address + 4 * count
        outside = end > rm.BAR_SIZE or self._access.find(_NO_ACCESS, address >> 2, end >> 2) >= 0
        if address & 3 or not count or outside:
            self._refuse_access(address, count, "read")
        words = bytes(self._view[address:end])
        if address in _LONG_LOW:
            # a host may read 64 bits in two accesses: reading the low word latches the high one
            self._latched[address + 4] = bytes(self._view[address + 4 : address + 8])
        elif address in self._latched:
            return self._latched.pop(address) + words[4:]
        return words

    def write(self, address: int, words: bytes | memoryview) -> None:
        """Write words from `address` on (see `Board.write`). Words before a refused word may have been written."""
        count = len(words) >> 2
        end = address + 4 * count
        first = address >> 2
        if address & 3 or not count or self._access.count(_READ_WRITE, first, first + count) != count:
            self._refuse_access(address, count, "written")
        if self.running and not (address == rm.CONTROL and count == 1 and words[0] & rm.CONTROL_RESET_MASK):
            self._refuse(ErrorCode.BUSY, "the machine is running; only a reset may be written")
        if end <= rm.START or address > rm.RESUME:
            self._view[address:end] = words
            if address <= rm.CONTROL:
                self._take_control(address, words)
            return
        # Doorbells take effect after all other words of a burst.
        plain = max(rm.START - address, 0)
        self._view[address : address + plain] = words[:plain]
        if address == rm.CONTROL:
            self._take_control(address, words)
        for doorbell in (rm.START, rm.RESUME):
            if address <= doorbell < end:
                (number,) = WORD.unpack_from(words, doorbell - address)
                if number:
                    self._ring(doorbell, number)

    def _take_control(self, address: int, words: bytes | memoryview) -> None:
        """Apply the side effect of a write to LIVENESS or CONTROL."""
        if address == rm.LIVENESS:
            self._put(rm.LIVENESS, ~WORD.unpack(words)[0] & ALL_ONES)
            return
        self._put(rm.CONTROL, words[0] & rm.CONTROL_INTERRUPT_ENABLE_MASK)
        if words[0] & rm.CONTROL_RESET_MASK:
            self.reset()

    def _refuse_access(self, address: int, count: int, verb: str) -> NoReturn:
        """Refuse an access that is misaligned, outside the map, too long or not writable."""
        words = self._access[address >> 2 : (address >> 2) + count]
        if address & 3:
            self._refuse(ErrorCode.MISALIGNED, f"address {address:#06x} is not a multiple of 4")
        if not words or words[0] == _NO_ACCESS:
            if self._machine is None and any(address in block for block in _DATA):
                self._refuse(ErrorCode.BLANK, "the board is blank; program it first")
            self._refuse(ErrorCode.OUTSIDE, f"nothing can be {verb} at {address:#06x}")
        if len(words) < count or _NO_ACCESS in words:
            self._refuse(
                ErrorCode.TOO_LONG, f"{count} words from {address:#06x} on extend beyond the end of the block"
            )
        read_only = address + 4 * words.index(_READ)
        self._refuse(ErrorCode.READ_ONLY, f"the register at {read_only:#06x} cannot be written")

    def _refuse(self, code: ErrorCode, detail: str) -> NoReturn:
        self._error = code
        (status,) = WORD.unpack_from(self._memory, rm.STATUS)
        self._put(rm.STATUS, status & ~rm.STATUS_ERROR_MASK | in_field(rm.STATUS_ERROR_MASK, code))
        raise RefusedError(code, detail)

    # ---- the machine ----------------------------------------------------------------------------------

    def reset(self) -> None:
        """Stop the machine, clear counters and cycles, and restart the RNGs from bank 0. Keep DONE and all settings."""
        self.running = False
        self._error = ErrorCode.NONE
        self._compute_ns = 0
        if self._machine is None:
            self._publish(BoardState.BLANK, 0, 0)
            return
        self._machine.reset()
        self._publish(BoardState.IDLE, 0, 0)

    def release(self) -> None:
        """Stop a running machine and disable interrupts. The server calls this after the host has disconnected."""
        if self.running:
            self.reset()
        self._put(rm.CONTROL, 0)

    def close(self) -> None:
        """Do nothing, because the board ends with its process."""

    def _ring(self, doorbell: int, number: int) -> None:
        """Check a doorbell, and run the first chunk."""
        machine = self._machine
        if machine is None:
            self._refuse(ErrorCode.BLANK, "the board is blank; program it first")
        # a lost or repeated start must not compute a frame
        due = next_doorbell(self.done)
        if self.running or number != due:
            self._refuse(ErrorCode.DOORBELL, f"number {number} was written, {due} was expected")
        *settings, run_until = _SETTINGS.unpack_from(self._memory, rm.TARGET_COUNT)
        if run_until > CYCLES_MAX:
            self._refuse(
                ErrorCode.BAD_VALUE, f"a slice cannot end at cycle {run_until}: the maximum is {CYCLES_MAX}"
            )
        if doorbell == rm.RESUME:
            if not machine.resumable:
                self._refuse(ErrorCode.DOORBELL, "there is no slice to resume")
            if 0 < run_until <= machine.cycles:
                self._refuse(
                    ErrorCode.BAD_VALUE,
                    f"a slice cannot end at cycle {run_until}: {machine.cycles} cycles have run",
                )
        self._compute_ns = 0
        self._run_until = run_until
        self._number = number
        try:
            if doorbell == rm.RESUME:
                self._run(machine, machine.resume, self._chunk_end(machine.cycles, self._max_cycles))
            else:
                frame = FrameSettings(*settings)
                self._chunk = self._first_chunk
                self._run(machine, partial(machine.start, frame), self._chunk_end(0, frame.max_cycles))
                # only now: after a refused start, a resume still continues the frame before
                self._max_cycles = frame.max_cycles
        except StartError as error:
            self._refuse(ErrorCode.BAD_VALUE, str(error).rstrip("."))
        # only now: a refused doorbell leaves the register as it was
        self._put(doorbell, number)

    def step(self) -> None:
        """Run the machine for one more chunk of about 50 ms. Then `running` tells whether to call `step` again."""
        machine = self._machine
        if machine is not None and self.running:
            self._run(machine, machine.step, self._chunk_end(machine.cycles, self._max_cycles))

    def _run(self, machine: BoardMachine, chunk: Callable[[int], None], end: int) -> None:
        """Run one chunk of the frame, to cycle `end`. Then write the results to the registers for the host."""
        began = time.perf_counter_ns()
        chunk(end)
        elapsed = time.perf_counter_ns() - began
        self._compute_ns += elapsed
        # The speed varies with the frame (lines that cannot count take no time) and with the load of the
        # core.
        if elapsed < CHUNK_S * 0.5e9:
            self._chunk *= 2
        elif elapsed > CHUNK_S * 1.5e9:
            self._chunk = max(int(self._chunk * CHUNK_S * 1e9 / elapsed), _SHORTEST_CHUNK)
        cycles = machine.cycles
        self.running = machine.paused and cycles != self._run_until
        if self.running:
            self._publish(BoardState.RUNNING, 0, cycles)
        else:
            self.done = self._number
            self._publish(BoardState.DONE, machine.reason, cycles)

    def _chunk_end(self, cycles: int, max_cycles: int) -> int:
        """Return the cycle at which the next chunk ends, at most the slice's end. 0 stands for the frame's end."""
        end = cycles + self._chunk
        if end - cycles > _ALIGNMENT:
            end -= end % _ALIGNMENT
        run_until = self._run_until
        return run_until if end >= max_cycles or end >= run_until > 0 else end

    def _publish(self, state: BoardState, reason: int, cycles: int) -> None:
        """Write state, stop reason and cycles to the registers from DONE on."""
        status = (
            in_field(rm.STATUS_STATE_MASK, state)
            | in_field(rm.STATUS_STOP_REASON_MASK, reason)
            | in_field(rm.STATUS_ERROR_MASK, self._error)
        )
        DONE_BLOCK.pack_into(self._memory, rm.DONE, self.done, status, cycles, self._compute_ns)

    def interrupt_words(self) -> bytes:
        """Return the payload of an interrupt (see `Board.interrupt_words`)."""
        return b"".join(self._answer)

    # ---- memory ---------------------------------------------------------------------------------------

    def _put(self, address: int, value: int) -> None:
        WORD.pack_into(self._memory, address, value)

    def _allow(self, address: int, words: int, access: int) -> None:
        first = address // 4
        self._access[first : first + words] = bytes([access]) * words


_LONG_LOW: Final = frozenset({rm.CYCLES, rm.COMPUTE_NS})
_DATA: Final = tuple(
    range(block, block + 4 * block.words) for block in rm.BLOCKS.values() if block >= rm.SENSORS
)
"""Addresses of the register blocks from SENSORS on. A board implements only the words that the image uses."""
