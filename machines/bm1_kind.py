"""BM1 as a machine kind: its sections of the programming file, registers, frames and posteriors (thesis 2.1.2, 3.2)."""

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any, ClassVar, Final, TypeVar

import numpy as np
import numpy.typing as npt

from machines import make_kernel
from machines.bm1 import BM1Machine, Start, StopReason, first_slice, joint_reason
from machines.errors import StartError
from machines.kernel import BM1Kernel
from machines.kind import (
    OUTCOME,
    Blocks,
    BoardMachine,
    BoardResult,
    FrameCourse,
    FrameInput,
    FrameSettings,
    HostMachine,
    Inference,
    MachineKind,
    UsedRegisters,
    check_frame_value,
)
from machines.parameters import CYCLES_MAX, BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from machines.posterior import posterior, posterior_of_lines, posteriors_of_replicas

_Scalar = TypeVar("_Scalar", bound=np.generic)
_SENSOR_BITS_MAX: Final = 64  # columns whose widths fit into the capability registers


class BM1Kind(MachineKind):
    """The BM1 (thesis 2.1.2).

    Each combination of values of the searched variables has a line of AND gates and a counter. The counts of all lines
    give an approximation of the exact posterior.
    """

    name = "BM1"
    has_hardware = True
    parameters = BM1Parameters
    reasons: ClassVar = {
        StopReason.NONE: "not started",
        StopReason.OVERFLOW: "overflow",
        StopReason.MAX_CYCLES: "max cycles",
        StopReason.SLICE: "slice",
        StopReason.IMPOSSIBLE: "impossible",
    }

    def due_sections(self, parameters: BM1Parameters) -> Iterator[tuple[str, str, tuple[int, ...]]]:
        """Yield the name, dtype and shape of each section that a programming file must have.

        The first section is the prior. Then each sensor column with a table has a section (a MIF in the thesis). With
        `rng = table`, the last section is the random numbers.
        """
        yield "prior", "<u2", (parameters.prior_addresses, parameters.lines)
        if parameters.has_tables:
            for column, bits in enumerate(parameters.sensor_bits, start=1):
                yield f"column {column}", "<u2", (1 << bits, parameters.lines)
        if parameters.rng is RngKind.TABLE:
            yield "rng", "<u4", (-1,)

    def machine(self, parameters: BM1Parameters, sections: Mapping[str, npt.NDArray[Any]]) -> BM1Machine:
        """Return the machine with these tables."""
        columns = tuple(array for name, array in sections.items() if name.startswith("column "))
        return BM1Machine(parameters, sections["prior"], columns, sections.get("rng"))

    def registers(self, parameters: BM1Parameters) -> UsedRegisters:
        """Return the registers of a board. With replicas or inputs per cell, it has INPUTS instead of SENSORS."""
        inputs, results = math.prod(parameters.input_shape), math.prod(parameters.count_shape)
        size = f"{parameters.sensors} sensors and {parameters.lines} lines"
        if not _is_plain(parameters):
            several = f" in {parameters.replicas} replicas" if parameters.replicas > 1 else ""
            size = f"{inputs} inputs and {results} results ({size}{several})"
        written = {}
        if parameters.replicas > 1:
            written["PRIOR_SELECTS"] = parameters.replicas
        if parameters.prior_mode is PriorMode.WRITTEN:
            written["PRIOR_CODES"] = results
        answer = {"RESULTS": results}
        if parameters.replicas > 1:
            answer["OUTCOMES"] = parameters.replicas * OUTCOME.itemsize // 4
        return UsedRegisters(
            lines=parameters.lines,
            replicas=parameters.replicas,
            inputs="SENSORS" if _is_plain(parameters) else "INPUTS",
            input_words=inputs,
            result_words=results,
            written=written,
            answer=answer,
            # the encodings of hdl/bm_registers.rdl
            capabilities={
                "CAP_MACHINE.KIND": 1,
                "CAP_MACHINE.RNG": 1 + list(RngKind).index(parameters.rng),
                "CAP_MACHINE.SHARED": parameters.shared,
                "CAP_MACHINE.FREE": parameters.rng_reset is RngReset.FREE,
                "CAP_MACHINE.PRIOR_WRITTEN": parameters.prior_mode is PriorMode.WRITTEN,
                "CAP_MACHINE.SENSOR_MODE": list(SensorMode).index(parameters.sensor_mode),
                "CAP_LINES": parameters.lines,
                "CAP_SENSORS": parameters.sensors,
                "CAP_WIDTHS.PROB_BITS": parameters.prob_bits,
                "CAP_WIDTHS.COUNTER_BITS": parameters.counter_bits,
                "CAP_WIDTHS.PRIOR_BITS": parameters.prior_bits,
                "CAP_BANKS": parameters.rng_banks,
                "CAP_REPLICAS": parameters.replicas,
                "CAP_STEPS": parameters.steps_per_clock,
            },
            size=size,
        )

    def contents(self, machine: BM1Machine) -> Blocks:
        """Return the initial words of registers: the columns' address widths, and the codes of a written prior."""
        parameters = machine.parameters
        # a machine with inputs per cell can have more sensors than fit into the registers
        contents = {"CAP_SENSOR_BITS": bytes(parameters.sensor_bits[:_SENSOR_BITS_MAX])}
        if parameters.prior_mode is PriorMode.WRITTEN:
            contents["PRIOR_CODES"] = machine.prior[0].astype("<u4").tobytes() * parameters.replicas
        return contents

    def kernel(self, machine: BM1Machine) -> BM1Kernel:
        """Return the fastest kernel that runs the machine."""
        return make_kernel(machine)

    def on_board(self, kernel: BM1Kernel, memory: Mapping[str, memoryview]) -> BoardMachine:
        """Return a board's machine that runs the kernel. Its inputs and results are in the board's blocks, `memory`."""
        return _OnBoard(kernel, memory)

    def on_host(self, machines: Sequence[BM1Machine]) -> HostMachine:
        """Return the host's view of all boards' machines. Each machine has some lines of the model."""
        return _OnHost(machines)

    def joint_reason(self, reasons: Sequence[int]) -> int:
        """Return the first of OVERFLOW, MAX_CYCLES and IMPOSSIBLE that any replica has.

        If no replica has one of these reasons, return SLICE.
        """
        joint = joint_reason([StopReason(reason) for reason in reasons], range(len(reasons)))
        return joint if joint is not StopReason.NONE else StopReason.SLICE

    def infer(self, results: Sequence[BoardResult], _: Sequence[str] = ()) -> Inference:
        """Return the posterior over the lines of all boards.

        With replicas, the posteriors of all replicas are returned in one array, one after the other.
        """
        joint: npt.NDArray[np.float64] | None = None
        totals: list[int] = []
        if results and results[0].replica_cycles:
            of_boards = [board.counts for board in results]
            totals = [int(each.sum(dtype=np.uint64)) for each in of_boards]
            rows = posteriors_of_replicas(of_boards, [board.replica_cycles for board in results])
            joint = None if rows is None else rows.ravel()
        else:
            counts = np.frombuffer(b"".join([board.words for board in results]), dtype="<u4")
            lines = [len(board.words) // 4 for board in results]
            if lines and all(lines):
                starts = [0, *accumulate(lines[:-1])]
                totals = np.add.reduceat(counts, starts, dtype=np.uint64).tolist()
                joint = posterior_of_lines(counts, lines, [board.cycles for board in results])
        if joint is not None:
            outcome = "posterior"
        elif all(board.reason == StopReason.IMPOSSIBLE for board in results):
            outcome = "no posterior: all counts were 0, because the readings are impossible for every line"
        else:
            outcome = "no posterior: all counts were 0 after max_cycles"
        return Inference(results, joint, totals, outcome)

    def posterior(
        self, machines: Sequence[BM1Machine], frame: FrameInput, _: Sequence[str] = ()
    ) -> tuple[npt.NDArray[np.float64], Mapping[str, str]]:
        """Run the machines with `machines.posterior.posterior`. Return the posterior and an empty mapping."""
        values = posterior(
            machines,
            frame.addresses,
            prior_address=frame.prior_address,
            prior_codes=frame.prior_codes,
            target_count=frame.target_count,
            max_cycles=frame.max_cycles,
            bank=frame.bank,
        )
        return values, {}


BM1: Final = BM1Kind()


def _is_plain(parameters: BM1Parameters) -> bool:
    """Return whether the board has a single machine, with one input per column."""
    return parameters.replicas == 1 and parameters.sensor_mode is SensorMode.COLUMN


class _OnBoard(BoardMachine):
    """A kernel that reads SENSORS or INPUTS, PRIOR_SELECTS and PRIOR_CODES, and writes RESULTS and OUTCOMES."""

    def __init__(self, kernel: BM1Kernel, memory: Mapping[str, memoryview]) -> None:
        super().__init__(kernel, memory)
        parameters = self._parameters = kernel.machine.parameters
        self._is_plain = _is_plain(parameters)
        self._sensors = struct.Struct(f"<{parameters.sensors}I")

        # Views of the map: what is assigned to them is what a host reads.
        shape = parameters.count_shape
        results = np.frombuffer(memory["RESULTS"], "<u4", math.prod(shape))
        self._results: npt.NDArray[np.uint32] = results.reshape(shape)
        several = parameters.replicas if parameters.replicas > 1 else 0
        self._outcomes: npt.NDArray[np.void] = np.frombuffer(memory["OUTCOMES"], OUTCOME, several)

    def prepare(self) -> None:
        self._kernel.prepare()

    def reset(self) -> None:
        self._kernel.reset()
        self._results[:] = 0
        self._outcomes[:] = np.zeros((), OUTCOME)

    def start(self, settings: FrameSettings, end: int) -> None:
        parameters = self._parameters
        row: int | tuple[int, ...] = settings.prior_select
        if len(self._outcomes):
            row = tuple(np.frombuffer(self._memory["PRIOR_SELECTS"], "<u4", len(self._outcomes)).tolist())
        self._kernel.start(
            Start(
                addresses=self._sensors.unpack_from(self._memory["SENSORS"])
                if self._is_plain
                else self._words("INPUTS", parameters.input_shape).astype(np.int64),
                prior_address=row,
                prior_codes=self._written_prior(),
                target_count=settings.target_count,
                max_cycles=settings.max_cycles,
                bank=settings.bank,
                run_until=end,
            )
        )
        self._show()

    def _written_prior(self) -> npt.NDArray[np.uint16] | None:
        parameters = self._parameters
        if parameters.prior_mode is PriorMode.TABLE:
            return None
        words = self._words("PRIOR_CODES", parameters.count_shape)
        if int(words.max()) > parameters.ones_code:
            raise StartError(f"a prior code is {words.max()}; the maximum is {parameters.ones_code}")
        return words.astype(np.uint16)

    def _words(self, block: str, shape: tuple[int, ...]) -> npt.NDArray[np.uint32]:
        return np.frombuffer(self._memory[block], "<u4", math.prod(shape)).reshape(shape)

    def resume(self, end: int) -> None:
        halted: set[int] = set()
        if len(self._outcomes):
            mask = int.from_bytes(self._memory["HALT"], "little")
            halted = {at for at in range(mask.bit_length()) if mask >> at & 1}
        self._kernel.resume(end, halted)
        self._show()

    def step(self, end: int) -> None:
        self._kernel.resume(end)
        self._show()

    def _show(self) -> None:
        """Copy the results to the registers."""
        self._results[:] = self._kernel.counts
        if len(self._outcomes):
            self._outcomes["reason"] = self._kernel.replica_reasons
            self._outcomes["cycles"] = self._kernel.replica_cycles

    @property
    def paused(self) -> bool:
        return self._kernel.reason is StopReason.SLICE


class _Course(FrameCourse):
    """The course of a frame on boards which together hold the lines of one model, or of all its replicas."""

    def __init__(
        self, starts: Sequence[Blocks], settings: FrameSettings, frame: FrameInput, replicas: int
    ) -> None:
        self.starts = starts
        self.settings = settings
        self._max_cycles = frame.max_cycles
        self._replicas = replicas
        self.begun = 0
        # the replicas of a single board stop by themselves
        sliced = frame.stop == "slices" and (replicas == 1 or len(starts) > 1)
        self._set_end(first_slice(frame.target_count) if sliced else 0)

    def _set_end(self, end: int) -> None:
        # the last slice ends with the frame
        self.end = 0 if end >= self._max_cycles else end

    def proceed(
        self, reasons: Sequence[Sequence[int]], _: Sequence[memoryview]
    ) -> tuple[Sequence[int], Blocks]:
        """Return the boards that run on, and the mask of halted replicas.

        If the frame's `stop` is `slices`, a replica that has overflowed on one board is halted on all boards.
        """
        over = {
            replica
            for of_board in reasons
            for replica, reason in enumerate(of_board)
            if reason == StopReason.OVERFLOW
        }
        running = [
            board
            for board, of_board in enumerate(reasons)
            if any(
                reason == StopReason.SLICE and replica not in over for replica, reason in enumerate(of_board)
            )
        ]
        self.begun = self.end
        self._set_end(2 * self.end)
        if self._replicas == 1:
            return running, {}
        # replicas stop one by one: those that have ended on one board are halted on the others
        mask = sum(1 << replica for replica in over)
        return running, {"HALT": mask.to_bytes(4 * -(-self._replicas // 32), "little")}


class _OnHost(HostMachine):
    """The host's encoder. It checks a frame against the whole machine, and encodes the frame for each board."""

    def __init__(self, machines: Sequence[BM1Machine]) -> None:
        # the boards differ in their lines and priors alone: what is used of the first one's parameters holds for all
        self._machines = tuple(machines)
        self._parameters = machines[0].parameters
        self._replicas = self._parameters.replicas
        lines = [machine.parameters.lines for machine in machines]
        self._ends = list(accumulate(lines))
        self._total_lines = self._ends[-1]
        self._is_plain = _is_plain(self._parameters)
        # of plain machines: the words of SENSORS, and the address of a missing reading in each column
        self._sensor_words = struct.Struct(f"<{self._parameters.sensors}I")
        self._missing = tuple((1 << bits) - 1 for bits in self._parameters.sensor_bits)

    def begin(self, frame: FrameInput) -> FrameCourse:
        """Check a frame's values against the whole machine, and return the frame as a `FrameCourse`."""
        select, selects = self._prior_selects(frame)
        parameters = self._parameters
        check_frame_value("The target count", frame.target_count, 1, parameters.target_count_max)
        check_frame_value("The most cycles", frame.max_cycles, 1, CYCLES_MAX)
        check_frame_value("The RNG bank", frame.bank, 0, parameters.rng_banks - 1)
        check_frame_value("The prior's address", select, 0, parameters.prior_addresses - 1)
        settings = FrameSettings(frame.target_count, frame.max_cycles, frame.bank, select)
        if frame.stop not in {"slices", "own"}:
            raise StartError(f"The stop rule '{frame.stop}' is unknown: use slices or own")
        if self._is_plain:
            inputs, name = [self._plain_words(frame)] * len(self._machines), "SENSORS"
        else:
            inputs, name = self._input_words(np.asarray(frame.addresses)), "INPUTS"
        starts = []
        for own, prior in zip(inputs, self._priors(frame), strict=True):
            blocks = {name: own} if own else {}
            if selects:
                blocks["PRIOR_SELECTS"] = selects
            if prior is not None:
                blocks["PRIOR_CODES"] = prior
            starts.append(blocks)
        return _Course(starts, settings, frame, self._replicas)

    def slowest(self) -> FrameInput:
        """Return a frame in which all readings are missing, so that all lines count."""
        parameters = replace(self._parameters, lines=self._total_lines)
        plain = (None,) * parameters.sensors
        return FrameInput(
            addresses=plain if self._is_plain else np.full(parameters.input_shape, -1),
            target_count=parameters.target_count_max,
            max_cycles=CYCLES_MAX,
        )

    def _plain_words(self, frame: FrameInput) -> bytes:
        """Return the words of the SENSORS registers. All boards get the same words."""
        addresses, sensors = frame.addresses, self._parameters.sensors
        if len(addresses) != sensors:
            raise StartError(f"The frame has {len(addresses)} readings; this machine has {sensors} sensors")
        words = []
        for column, (address, missing) in enumerate(zip(addresses, self._missing, strict=True), start=1):
            if address is not None and not 0 <= address <= missing:
                raise StartError(
                    f"The address of sensor column {column} is {address}; this machine takes 0 to "
                    f"{missing - 1}, or none"
                )
            words.append(missing if address is None else address)
        return self._sensor_words.pack(*words)

    def _prior_selects(self, frame: FrameInput) -> tuple[int, bytes]:
        """Return the prior's address and the words of PRIOR_SELECTS.

        If each replica has its own address, return only one of them for the caller's range check: the smallest if
        that is negative, otherwise the largest.
        """
        given = frame.prior_address
        if isinstance(given, tuple):
            if self._replicas == 1 or len(given) != self._replicas:
                raise StartError(
                    f"The frame has {len(given)} addresses of the prior; this machine takes one, or one for each of "
                    f"several replicas: it has {self._replicas}"
                )
        elif self._replicas == 1:
            return given, b""
        else:
            given = (given,) * self._replicas
        worst = min(given) if min(given) < 0 else max(given)
        fits = 0 <= worst < self._parameters.prior_addresses
        return worst, np.array(given, dtype="<u4").tobytes() if fits else b""

    def _input_words(self, inputs: npt.NDArray[np.integer]) -> list[bytes]:
        """Return the words of the register block INPUTS for each board, or raise a StartError.

        If the machine has inputs per cell, each board gets only the inputs of its own lines.
        """
        parameters = self._parameters
        per_cell = parameters.sensor_mode is not SensorMode.COLUMN
        replicas, sensors, lines = self._replicas, parameters.sensors, self._total_lines
        shape = (sensors, lines) if per_cell else (sensors,)
        if replicas > 1:
            shape = (replicas, *shape)
        if not sensors:
            return [b""] * len(self._machines)
        if inputs.shape != shape or inputs.dtype.kind not in "ui":
            raise StartError(
                f"The frame's readings have the shape {inputs.shape} and are {inputs.dtype}; this machine takes "
                f"integers of the shape {shape}"
            )
        missing = np.array(self._missing, dtype=np.int64)[:, np.newaxis]
        # a reading is missing in all lines or in none: the cells of a column share the address of a missing one
        words = inputs.reshape(replicas, sensors, -1).astype(np.int64)
        absent = words == -1
        partly = absent.any(axis=2) & ~absent.all(axis=2)
        wrong = np.argwhere((~absent & ((words < 0) | (words > missing))) | partly[:, :, np.newaxis] & absent)
        if len(wrong):
            replica, column, line = (int(at) for at in wrong[0])
            where = f" at line {line}" if per_cell else ""
            where += f" of replica {replica}" if replicas > 1 else ""
            top = int(missing[column, 0])
            value = int(words[replica, column, line])
            raise StartError(
                f"The input of sensor column {column + 1}{where} is {value}; this machine takes 0 to "
                f"{top - 1 if parameters.has_tables else top}"
                + (", or -1 in all lines of a missing reading" if per_cell else ", or -1 for none")
            )
        words = np.where(absent, missing, words).astype("<u4")
        if not per_cell:
            return [words.tobytes()] * len(self._machines)
        return [own.tobytes() for own in self._by_board(words)]

    def _priors(self, frame: FrameInput) -> list[bytes | None]:
        """Return the words of PRIOR_CODES for each board, or None if the prior is a table."""
        codes = frame.prior_codes
        if self._parameters.prior_mode is not PriorMode.WRITTEN:
            if codes is not None:
                raise StartError("The frame has a written prior, but the prior of the machine is a table")
            return [None] * len(self._machines)
        if codes is None:
            # written anyway, because the previous frame may have written another prior
            return [machine.prior[0].astype("<u4").tobytes() * self._replicas for machine in self._machines]
        shapes = {(self._total_lines,)} | (
            {(self._replicas, self._total_lines)} if self._replicas > 1 else set()
        )
        if codes.shape not in shapes or int(codes.max()) > self._parameters.ones_code:
            raise StartError(
                f"The prior to write has shape {codes.shape} and codes up to {codes.max()}; this machine takes "
                f"{self._total_lines} codes from 0 to {self._parameters.ones_code}, or as many for each of several "
                "replicas"
            )
        by_line = np.broadcast_to(codes, (self._replicas, self._total_lines))
        return [own.astype("<u4").tobytes() for own in self._by_board(by_line)]

    def _by_board(self, array: npt.NDArray[_Scalar]) -> list[npt.NDArray[_Scalar]]:
        """Split an array, whose last axis has the lines of all boards, into one array per board."""
        return np.split(array, self._ends[:-1], axis=-1)
