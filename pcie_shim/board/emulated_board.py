"""The emulated FPGA board, without sockets: a register file and a Bayesian machine.

    load ──▶ IDLE ── START ──▶ RUNNING ── step, step, ... ──▶ DONE (overflow, impossible, max cycles, end of a slice)
               ▲                  │                            │
               └───── reset ──────┴────────────────────────────┘ RESUME continues a slice

The whole map is one array of bytes, so a read is a slice, and only registers with side effects need code. The
machine runs in chunks of about 50 ms (`EmulatedBoard.step`), between which the server can receive a reset.
Chunks do not change results, because a machine that is stopped and resumed gives the same bits.
"""

import math
import struct
import time
from collections.abc import Callable, Collection
from typing import Final, NoReturn

import numpy as np
import numpy.typing as npt

from machines import make_kernel
from machines.bm1 import BM1Machine, Start, StopReason, missing_inputs
from machines.errors import MachineError, StartError
from machines.kernel import BM1Kernel
from machines.parameters import CYCLES_MAX, BM1Parameters, PriorMode, RngReset
from pcie_shim import register_map as rm
from pcie_shim.errors import ImageError, PcieShimError
from pcie_shim.programming_file import Image, image_from_bytes, is_plain
from pcie_shim.register_layout import ALL_ONES, DONE_BLOCK, REPLICA_OUTCOME, SETTINGS, WORD, next_doorbell
from pcie_shim.register_map import BoardState, ErrorCode, MachineKind, RngKind, SensorMode

CHUNK_S: Final = 0.05
"""Duration of a chunk in seconds, after which the board reads from its host again."""

_NO_ACCESS, _READ, _READ_WRITE = 0, 1, 3
_SETTINGS: Final = struct.Struct(f"{SETTINGS.format}Q")  # and RUN_UNTIL
_SHORTEST_CHUNK: Final = 64  # cycles, even if the machine is slow
_ALIGNMENT: Final = 4096  # chunks end between the blocks of a fast kernel


class RefusedError(PcieShimError):
    """The board refuses an access.

    Attributes:
        code: The error code for the host.
    """

    def __init__(self, code: ErrorCode, detail: str) -> None:
        super().__init__(detail)
        self.code = code


class EmulatedBoard:
    """A board: blank until an image is loaded, then a BM1 with registers (docs/reference/registers.md)."""

    def __init__(self, make: Callable[[BM1Machine], BM1Kernel] = make_kernel) -> None:
        self._make = make
        self.turned = 0.0
        """Monotonic time at which its server last looked for requests; 0 before the first time."""
        self.programmed = 0
        """Number of images loaded so far."""
        self.done = 0
        """The number of the last start or resume that has stopped (register DONE)."""
        self.running = False
        """True while the machine is running and `step` must be called; registers are then read-only."""

        # The whole map, and for each word of it whether it may be read and written. Changed by `load` alone.
        self._memory = bytearray(rm.BAR_SIZE)
        self._view = memoryview(self._memory)
        self._access = bytearray(rm.BAR_SIZE // 4)

        # The machine of the loaded image, None while blank, and what follows from its parameters. The arrays are
        # views of the map: what is assigned to them is what a host reads.
        self._kernel: BM1Kernel | None = None
        self._results: npt.NDArray[np.uint32] = np.empty(0, np.uint32)
        self._outcomes: npt.NDArray[np.void] = np.empty(0, REPLICA_OUTCOME)
        self._sensors = struct.Struct("")
        self._is_plain = True

        # High words of 64-bit registers by address, from the read of the low word until they are read.
        self._latched: dict[int, bytes] = {}

        # Why the last access was refused, for STATUS.ERROR; cleared by a reset.
        self._error = ErrorCode.NONE

        # Cycles of the next chunk, which adapts to the measured speed, and of the first one of each frame.
        self._chunk = self._first_chunk = _SHORTEST_CHUNK

        # Those of the last start or resume: its limits, its time so far, and its number.
        self._max_cycles = 0
        self._run_until = 0
        self._compute_ns = 0
        self._number = 0
        self._power_up()

    # ---- identity -------------------------------------------------------------------------------------

    @property
    def image_hash(self) -> str:
        """SHA-256 (hex) of the loaded image; zeros while blank."""
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
        self._view[rm.MAP_HASH : rm.MAP_HASH + 32] = bytes.fromhex(rm.MAP_SHA256)
        self._latched.clear()
        self.done = 0
        for block in rm.BLOCKS:
            access = _READ_WRITE if block.writable else _READ
            self._allow(block.address, block.words, access)
        for window in _DATA:
            self._allow(window.start, len(window) // 4, _NO_ACCESS)

    def load(self, content: bytes) -> None:
        """Program the board with the bytes of a programming file.

        This prepares the machine (about 0.1 s), runs it for a few milliseconds to measure its speed, and
        resets it.

        Raises:
            RefusedError: The machine is running, or the image is damaged or for another map.
        """
        if self.running:
            raise RefusedError(ErrorCode.BUSY, "the machine is running; reset it before programming")
        try:
            image = image_from_bytes(content, "the image")
            kernel = self._make(image.machine)
            # now, so that the first frame does not wait for it
            kernel.prepare()
        except (ImageError, MachineError) as error:
            raise RefusedError(ErrorCode.BAD_IMAGE, str(error).rstrip(".")) from error
        self._kernel = kernel
        self.programmed += 1
        # the registers of the former image must not be seen beside those of this one
        self._power_up()
        self._describe(image)
        speed = _measure_speed(kernel)
        self._first_chunk = max(int(speed * CHUNK_S), _SHORTEST_CHUNK)
        self._put(rm.CAP_SPEED, min(int(speed), ALL_ONES))
        self.reset()

    def _describe(self, image: Image) -> None:
        """Set the capability registers, and permit access to the words that the image implements."""
        parameters, part = image.machine.parameters, image.partition
        written = parameters.prior_mode is PriorMode.WRITTEN
        self._view[rm.IMAGE_HASH : rm.IMAGE_HASH + 32] = bytes.fromhex(image.image_hash)
        self._put(
            rm.CAP_MACHINE,
            MachineKind.BM1 << rm.CAP_MACHINE_KIND_SHIFT
            | RngKind[parameters.rng.name] << rm.CAP_MACHINE_RNG_SHIFT
            | parameters.shared << rm.CAP_MACHINE_SHARED_SHIFT
            | (parameters.rng_reset is RngReset.FREE) << rm.CAP_MACHINE_FREE_SHIFT
            | written << rm.CAP_MACHINE_PRIOR_WRITTEN_SHIFT
            | SensorMode[parameters.sensor_mode.name] << rm.CAP_MACHINE_SENSOR_MODE_SHIFT,
        )
        self._put(rm.CAP_LINES, parameters.lines)
        self._put(rm.CAP_TOTAL_LINES, part.total_lines)
        self._put(rm.CAP_LINE_OFFSET, part.line_offset)
        self._put(
            rm.CAP_PARTITION,
            part.index << rm.CAP_PARTITION_INDEX_SHIFT | part.count << rm.CAP_PARTITION_COUNT_SHIFT,
        )
        self._put(rm.CAP_SENSORS, parameters.sensors)
        self._put(
            rm.CAP_WIDTHS,
            parameters.prob_bits << rm.CAP_WIDTHS_PROB_BITS_SHIFT
            | parameters.counter_bits << rm.CAP_WIDTHS_COUNTER_BITS_SHIFT
            | parameters.prior_bits << rm.CAP_WIDTHS_PRIOR_BITS_SHIFT,
        )
        self._put(rm.CAP_BANKS, parameters.rng_banks)
        self._put(rm.CAP_REPLICAS, parameters.replicas)
        self._put(
            rm.CAP_INTERFACE,
            image.interface_sensors << rm.CAP_INTERFACE_SENSORS_SHIFT
            | image.interface_results << rm.CAP_INTERFACE_RESULTS_SHIFT,
        )
        self._put(rm.CAP_STEPS, parameters.steps_per_clock)
        # a machine with inputs per cell can have more sensors than fit into the register
        widths = bytes(parameters.sensor_bits[: 4 * rm.CAP_SENSOR_BITS_WORDS])
        self._view[rm.CAP_SENSOR_BITS : rm.CAP_SENSOR_BITS + len(widths)] = widths
        self._sensors = struct.Struct(f"<{parameters.sensors}I")
        lines = parameters.replicas * parameters.lines
        results = np.frombuffer(self._memory, "<u4", lines, rm.RESULTS)
        self._results = results.reshape(parameters.count_shape)
        self._is_plain = is_plain(parameters)
        inputs = rm.SENSORS if self._is_plain else rm.INPUTS
        self._allow(inputs, image.interface_sensors, _READ_WRITE)
        self._allow(rm.RESULTS, image.interface_results, _READ)
        several = parameters.replicas if parameters.replicas > 1 else 0
        self._outcomes = np.frombuffer(self._memory, REPLICA_OUTCOME, several, rm.OUTCOMES)
        self._allow(rm.OUTCOMES, 4 * several, _READ)
        self._allow(rm.PRIOR_SELECTS, several, _READ_WRITE)
        if written:
            self._allow(rm.PRIOR_CODES, lines, _READ_WRITE)
            prior = image.machine.prior[0].astype("<u4").tobytes() * parameters.replicas
            self._view[rm.PRIOR_CODES : rm.PRIOR_CODES + len(prior)] = prior

    # ---- registers ------------------------------------------------------------------------------------

    def read(self, address: int, count: int) -> bytes:
        """Return `count` words from `address` on; a RefusedError if one is not in the map, or not implemented."""
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
        """Write words from `address` on, as `Board.write`; if a word is refused, earlier ones may be written."""
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
            if self._kernel is None and any(address in block for block in _DATA):
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
        self._put(rm.STATUS, status & ~rm.STATUS_ERROR_MASK | code << rm.STATUS_ERROR_SHIFT)
        raise RefusedError(code, detail)

    # ---- the machine ----------------------------------------------------------------------------------

    def reset(self) -> None:
        """Stop, clear counters and cycles, and restart the RNGs from bank 0; DONE and all settings remain."""
        self.running = False
        self._error = ErrorCode.NONE
        self._compute_ns = 0
        if self._kernel is None:
            self._publish(BoardState.BLANK, StopReason.NONE, 0)
            return
        self._kernel.reset()
        self._results[:] = 0
        self._outcomes[:] = np.zeros((), REPLICA_OUTCOME)
        self._publish(BoardState.IDLE, StopReason.NONE, 0)

    def release(self) -> None:
        """Stop a running machine and disable interrupts, because the host has disconnected."""
        if self.running:
            self.reset()
        self._put(rm.CONTROL, 0)

    def close(self) -> None:
        """Do nothing: the board ends with its process."""

    def _ring(self, doorbell: int, number: int) -> None:
        """Check a doorbell, and run the first chunk."""
        kernel = self._kernel
        if kernel is None:
            self._refuse(ErrorCode.BLANK, "the board is blank; program it first")
        # a lost or repeated start must not compute a frame
        due = next_doorbell(self.done)
        if self.running or number != due:
            self._refuse(ErrorCode.DOORBELL, f"number {number} was written, {due} was expected")
        target, max_cycles, bank, prior_address, run_until = _SETTINGS.unpack_from(
            self._memory, rm.TARGET_COUNT
        )
        if run_until > CYCLES_MAX:
            self._refuse(
                ErrorCode.BAD_VALUE, f"a slice cannot end at cycle {run_until}: the maximum is {CYCLES_MAX}"
            )
        if doorbell == rm.RESUME:
            if kernel.reason is not StopReason.SLICE:
                self._refuse(ErrorCode.DOORBELL, "there is no slice to resume")
            if 0 < run_until <= kernel.cycles:
                self._refuse(
                    ErrorCode.BAD_VALUE,
                    f"a slice cannot end at cycle {run_until}: {kernel.cycles} cycles have run",
                )
        self._compute_ns = 0
        self._run_until = run_until
        self._number = number
        if doorbell == rm.RESUME:
            try:
                self._run(kernel, None, self._chunk_end(kernel.cycles), self._halted())
            except StartError as error:
                self._refuse(ErrorCode.BAD_VALUE, str(error).rstrip("."))
        else:
            self._max_cycles = max_cycles
            self._chunk = self._first_chunk
            end = self._chunk_end(0)
            start = Start(
                addresses=self._inputs(kernel.machine.parameters),
                prior_address=self._prior_address(prior_address),
                prior_codes=self._written_prior(kernel.machine.parameters),
                target_count=target,
                max_cycles=max_cycles,
                bank=bank,
                run_until=end,
            )
            try:
                self._run(kernel, start, end)
            except StartError as error:
                self._refuse(ErrorCode.BAD_VALUE, str(error).rstrip("."))
        # only now: a refused doorbell leaves the register as it was
        self._put(doorbell, number)

    def _inputs(self, parameters: BM1Parameters) -> tuple[int, ...] | npt.NDArray[np.int64]:
        if self._is_plain:
            return self._sensors.unpack_from(self._memory, rm.SENSORS)
        shape = parameters.input_shape
        words = np.frombuffer(self._memory, "<u4", math.prod(shape), rm.INPUTS)
        return words.reshape(shape).astype(np.int64)

    def _prior_address(self, of_one: int) -> int | tuple[int, ...]:
        if self._is_plain or not len(self._outcomes):
            return of_one
        return tuple(np.frombuffer(self._memory, "<u4", len(self._outcomes), rm.PRIOR_SELECTS).tolist())

    def _halted(self) -> Collection[int]:
        """Return the replicas that a resume does not continue."""
        if not len(self._outcomes):
            return ()
        mask = int.from_bytes(self._view[rm.HALT : rm.HALT + 4 * rm.HALT_WORDS], "little")
        return {at for at in range(mask.bit_length()) if mask >> at & 1}

    def _written_prior(self, parameters: BM1Parameters) -> npt.NDArray[np.uint16] | None:
        if parameters.prior_mode is PriorMode.TABLE:
            return None
        shape = parameters.count_shape
        words = np.frombuffer(self._memory, "<u4", math.prod(shape), rm.PRIOR_CODES).reshape(shape)
        if int(words.max()) > parameters.ones_code:
            self._refuse(
                ErrorCode.BAD_VALUE, f"a prior code is {words.max()}; the maximum is {parameters.ones_code}"
            )
        codes: npt.NDArray[np.uint16] = words.astype(np.uint16)
        return codes

    def step(self) -> None:
        """Run the machine for one more chunk; then `running` tells whether it must continue."""
        kernel = self._kernel
        if kernel is not None and self.running:
            self._run(kernel, None, self._chunk_end(kernel.cycles))

    def _run(self, kernel: BM1Kernel, start: Start | None, end: int, halted: Collection[int] = ()) -> None:
        """Run one chunk, to cycle `end`, of a new frame (`start`) or of the current one."""
        began = time.perf_counter_ns()
        reason = kernel.resume(end, halted) if start is None else kernel.start(start)
        elapsed = time.perf_counter_ns() - began
        self._compute_ns += elapsed
        cycles = kernel.cycles
        # The speed varies with the frame (lines that cannot count take no time) and with the load of the
        # core.
        if elapsed < CHUNK_S * 0.5e9:
            self._chunk *= 2
        elif elapsed > CHUNK_S * 1.5e9:
            self._chunk = max(int(self._chunk * CHUNK_S * 1e9 / elapsed), _SHORTEST_CHUNK)
        # after every chunk, so that a host can look at a running machine
        self._results[:] = kernel.counts
        if not self._is_plain and len(self._outcomes):
            self._outcomes["reason"] = kernel.replica_reasons
            self._outcomes["cycles"] = kernel.replica_cycles
        self.running = reason is StopReason.SLICE and cycles != self._run_until
        if self.running:
            self._publish(BoardState.RUNNING, StopReason.NONE, cycles)
        else:
            self.done = self._number
            self._publish(BoardState.DONE, reason, cycles)

    def _chunk_end(self, cycles: int) -> int:
        """Return the end of the next chunk, or of the slice if that is nearer, in cycles; 0 for none."""
        end = cycles + self._chunk
        if end - cycles > _ALIGNMENT:
            end -= end % _ALIGNMENT
        run_until = self._run_until
        return run_until if end >= self._max_cycles or end >= run_until > 0 else end

    def _publish(self, state: BoardState, reason: StopReason, cycles: int) -> None:
        """Write the outcome to the registers."""
        status = (
            state << rm.STATUS_STATE_SHIFT
            | reason << rm.STATUS_STOP_REASON_SHIFT
            | self._error << rm.STATUS_ERROR_SHIFT
        )
        DONE_BLOCK.pack_into(self._memory, rm.DONE, self.done, status, cycles, self._compute_ns)

    def interrupt_words(self) -> bytes:
        """Return the payload of an interrupt: DONE to COMPUTE_NS, one count per line, replicas' outcomes."""
        words = self._view[rm.DONE : rm.DONE + DONE_BLOCK.size].tobytes() + self._results.tobytes()
        return words if self._is_plain else words + self._outcomes.tobytes()

    # ---- memory ---------------------------------------------------------------------------------------

    def _put(self, address: int, value: int) -> None:
        WORD.pack_into(self._memory, address, value)

    def _allow(self, address: int, words: int, access: int) -> None:
        first = address // 4
        self._access[first : first + words] = bytes([access]) * words


_LONG_LOW: Final = frozenset({rm.CYCLES, rm.COMPUTE_NS})
_DATA: Final = (
    range(rm.SENSORS, rm.SENSORS + 4 * rm.SENSORS_WORDS),
    range(rm.INPUTS, rm.INPUTS + 4 * rm.INPUTS_WORDS),
    range(rm.PRIOR_SELECTS, rm.PRIOR_SELECTS + 4 * rm.PRIOR_SELECTS_WORDS),
    range(rm.OUTCOMES, rm.OUTCOMES + 4 * rm.OUTCOMES_WORDS),
    range(rm.RESULTS, rm.RESULTS + 4 * rm.RESULTS_WORDS),
    range(rm.PRIOR_CODES, rm.PRIOR_CODES + 4 * rm.PRIOR_CODES_WORDS),
)


def _measure_speed(kernel: BM1Kernel) -> float:
    """Return the cycles per second in the slowest case: with all readings missing, all lines count.

    It measures CPU time of the thread, so that other load does not permanently make the board look slow.
    """
    parameters = kernel.machine.parameters
    start = Start(
        addresses=missing_inputs(parameters),
        target_count=parameters.target_count_max,
        max_cycles=CYCLES_MAX,
        run_until=1,
    )
    kernel.start(start)  # the first start of a kernel takes longer
    began = time.thread_time_ns()
    reason = kernel.start(start)
    while reason is StopReason.SLICE and kernel.cycles < _ALIGNMENT:
        if time.thread_time_ns() - began > CHUNK_S * 1e8:
            break
        reason = kernel.resume(2 * kernel.cycles)
    return kernel.cycles * 1e9 / max(time.thread_time_ns() - began, 1)
