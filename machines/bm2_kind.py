"""BM2 as a machine kind: its sections, registers, the batches or the stream of a frame, and its posterior (thesis 2.1.3)."""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, Final

import msgspec
import numpy as np
import numpy.typing as npt

from machines import make_bm2_kernel
from machines.bm2 import SAMPLES_MAX, BM2Machine, BM2Parameters, BM2Start, BM2StopReason, start_state
from machines.bm2_estimate import Chain, estimate, searched_counts, searched_values
from machines.bm2_kernel import BM2Kernel
from machines.errors import MachineError, NoPosteriorError, ParameterError, StartError
from machines.kind import (
    Blocks,
    BoardMachine,
    BoardResult,
    FrameCourse,
    FrameInput,
    FrameSettings,
    HostMachine,
    Inference,
    MachineKind,
    StoppedBoard,
    UsedRegisters,
)
from machines.parameters import CYCLES_MAX, RngKind, RngReset, SampleEvery, Sequencer

STREAM_WORDS_MAX: Final = 4096
"""Maximum number of words of the stream's buffer: the window of the register map."""

BATCHES: Final = 20
"""Parts of a frame without a stream, whose means tell how much the samples depend on each other."""

STREAM_BYTES_MAX: Final = 3 << 20
"""Maximum size of the streams of a frame, of all boards together: its result is one message between services."""

_STARTS_KEPT: Final = 4096  # start states that a host remembers
_ORDERS: Final = tuple(Sequencer)
_ANSWER: Final = ("SAMPLES_DONE", "UNUSED", "TIMED_OUT_BIT")
_SETTINGS: Final = ("BURN_IN", "OPS_TIMEOUT", "ORDER")
_NO_BIT: Final = 2**32 - 1


class BM2Kind(MachineKind):
    """Approximate inference by Gibbs sampling, bit by bit: every board is a chain of the whole model (thesis 2.1.3)."""

    name = "BM2"
    has_hardware = False
    parameters = BM2Parameters
    reasons: ClassVar = {
        BM2StopReason.NONE: "not started",
        BM2StopReason.SAMPLES: "samples",
        BM2StopReason.MAX_CYCLES: "max cycles",
        BM2StopReason.PAUSED: "paused",
        BM2StopReason.IMPOSSIBLE: "impossible",
        BM2StopReason.OPS_TIMEOUT: "ops time-out",
        BM2StopReason.FULL: "stream full",
    }

    def sections(self, machine: BM2Machine) -> list[tuple[str, npt.NDArray[Any]]]:
        """Return the table of each CDE, the non-zero entries of each factor, and a table of random numbers."""
        sections: list[tuple[str, npt.NDArray[Any]]] = []
        for at, table in enumerate(machine.tables):
            sections.append((f"cde {at}", table.astype("<u2", copy=False)))
        for at, support in enumerate(machine.supports):
            sections.append((f"support {at}", support.astype("<u1")))
        if machine.rng_table is not None:
            sections.append(("rng", machine.rng_table.astype("<u4", copy=False)))
        return sections

    def due_sections(self, parameters: BM2Parameters) -> Iterator[tuple[str, str, tuple[int, ...]]]:
        """Yield the sections that follow from the parameters."""
        for at in range(parameters.cdes):
            bits = len(parameters.factor_bits(at))
            yield f"cde {at}", "<u2", (bits << bits >> 1,)
        for at, factor in enumerate(parameters.factors):
            yield f"support {at}", "|u1", tuple(parameters.cardinalities[each] for each in factor)
        if parameters.rng is RngKind.TABLE:
            yield "rng", "<u4", (-1,)

    def machine(self, parameters: BM2Parameters, sections: Mapping[str, npt.NDArray[Any]]) -> BM2Machine:
        """Return the machine with these tables."""
        cdes = range(parameters.cdes)
        tables = tuple(sections[f"cde {at}"] for at in cdes)
        supports = tuple(sections[f"support {at}"].astype(np.bool_) for at in cdes)
        return BM2Machine(parameters, tables, supports, sections.get("rng"))

    def registers(self, parameters: BM2Parameters) -> UsedRegisters:
        """Return the registers; the line of a board is its chain."""
        words = parameters.state_words
        if parameters.stream * words > STREAM_WORDS_MAX:
            raise ParameterError(
                f"stream is {parameters.stream}; a board has room for {STREAM_WORDS_MAX // words} states of {words} words."
            )
        answer = {"RESULTS": parameters.result_words} | dict.fromkeys(_ANSWER, 1)
        if parameters.stream:
            answer |= {"STREAM_COUNT": 1, "STREAM": parameters.stream * words}
        return UsedRegisters(
            lines=1,
            replicas=1,
            inputs="START_STATE",
            input_words=words,
            result_words=parameters.result_words,
            written={"KNOWN_MASK": words} | dict.fromkeys(_SETTINGS, 1),
            answer=answer,
            # the encodings of hdl/bm_registers.rdl
            capabilities={
                "CAP_MACHINE.KIND": 2,
                "CAP_MACHINE.RNG": 1 + list(RngKind).index(parameters.rng),
                "CAP_MACHINE.FREE": parameters.rng_reset is RngReset.FREE,
                "CAP_MACHINE.LITERAL": parameters.literal,
                "CAP_MACHINE.PER_MOVE": parameters.sample_every is SampleEvery.MOVE,
                "CAP_MACHINE.STREAM": parameters.stream > 0,
                "CAP_LINES": 1,
                "CAP_SENSORS": parameters.state_bits,
                "CAP_WIDTHS.PROB_BITS": parameters.prob_bits,
                "CAP_WIDTHS.COUNTER_BITS": 32,
                "CAP_BANKS": parameters.rng_banks,
                "CAP_REPLICAS": 1,
                "CAP_STEPS": parameters.steps_per_clock,
            },
            size=f"{words} words of state and {parameters.result_words} results",
        )

    def contents(self, machine: BM2Machine) -> Blocks:
        """Return the parameters of a frame that a host may overwrite."""
        return _settings_blocks(machine.parameters)

    def kernel(self, machine: BM2Machine) -> BM2Kernel:
        """Return the fastest kernel that runs the machine."""
        return make_bm2_kernel(machine)

    def on_board(self, kernel: BM2Kernel, memory: Mapping[str, memoryview]) -> BoardMachine:
        """Return a kernel behind the registers of a board."""
        return _OnBoard(kernel, memory)

    def on_host(self, machines: Sequence[BM2Machine]) -> HostMachine:
        """Return the machines of all boards, each with a chain of the model."""
        return _OnHost(machines)

    def joint_reason(self, reasons: Sequence[int]) -> int:
        """Return the reason of the single machine of a board."""
        return reasons[0]

    def infer(self, results: Sequence[BoardResult], variables: Sequence[str] = ()) -> Inference:
        """Return the posterior of all chains; those that timed out are left out, and named in the details."""
        chains, every = [], [_kept(board) for board in results]
        for board, kept in zip(results, every, strict=True):
            parameters = kept.parameters
            words = np.frombuffer(b"".join([*kept.batches, board.words]), "<u4")
            counts = searched_counts(parameters, words.reshape(-1, parameters.result_words))
            values = None
            if parameters.stream:
                stream = np.frombuffer(kept.stream, "<u4").reshape(-1, parameters.state_words)
                values = searched_values(parameters, stream)
            chains.append(Chain(BM2StopReason(board.reason), counts, values))
        totals = [kept.samples[-1] - kept.unused[-1] for kept in every]
        found = estimate(chains)
        left_out = "; ".join(
            _why_left_out(number, results[number].reason, every[number], variables)
            for number in found.left_out
        )
        if found.posterior is None:
            impossible = all(board.reason == BM2StopReason.IMPOSSIBLE for board in results)
            why = "the readings are impossible together" if impossible else left_out
            return Inference(results, None, totals, f"no posterior: {why}")
        counted = [kept for number, kept in enumerate(every) if number not in found.left_out]
        details = {
            "samples": str(sum(kept.samples[-1] for kept in counted)),
            "unused": str(sum(kept.unused[-1] for kept in counted)),
            "effective_samples": f"{found.effective_samples:.0f}",
            "standard_error": f"{0.0 if found.error is None else found.error.max():.4g}",
        }
        if len(results) > 1:
            details["r_hat"] = f"{found.r_hat:.4f}"
        if left_out:
            details["left_out"] = left_out
        if found.is_marked:
            # their samples depend on how long the moves took
            details["ended_early"] = ", ".join(
                f"board{number}"
                for number, board in enumerate(results)
                if board.reason == BM2StopReason.MAX_CYCLES
            )
        return Inference(
            results,
            found.posterior,
            totals,
            "posterior",
            details,
            b"".join([kept.stream for kept in counted]),
            4 * every[0].parameters.state_words,
        )

    def posterior(
        self, machines: Sequence[BM2Machine], frame: FrameInput, variables: Sequence[str] = ()
    ) -> npt.NDArray[np.float64]:
        """Run the chains one after the other in this process, as boards run them."""
        boards = [_InProcess(machine) for machine in machines]
        course = self.on_host(machines).begin(frame)
        for board, blocks in zip(boards, course.starts, strict=True):
            board.start(course.settings, blocks)
        while going := course.proceed(boards)[0]:
            for number in going:
                boards[number].resume(course.settings)
        inference = self.infer(course.conclude([board.result() for board in boards]), variables)
        if inference.posterior is None:
            raise NoPosteriorError(f"There is {inference.outcome}.")
        return inference.posterior


BM2: Final = BM2Kind()


def _word(value: int) -> bytes:
    return value.to_bytes(4, "little")


def _settings_blocks(parameters: BM2Parameters) -> Blocks:
    order = _ORDERS.index(parameters.sequencer)
    return dict(zip(_SETTINGS, map(_word, (parameters.burn_in, parameters.ops_timeout, order)), strict=True))


class _OnBoard(BoardMachine):
    """A kernel that reads state, mask and settings from their blocks, and writes the blocks of its answer."""

    def __init__(self, kernel: BM2Kernel, memory: Mapping[str, memoryview]) -> None:
        self._kernel = kernel
        self._memory = memory
        self._state_bytes = 4 * kernel.machine.parameters.state_words

    def prepare(self) -> None:
        self._kernel.prepare()

    def reset(self) -> None:
        self._kernel.reset()
        self._show()

    def start(self, settings: FrameSettings, end: int) -> None:
        self._check_run_until()
        order = self._value("ORDER")
        if settings.prior_select or order >= len(_ORDERS):
            raise StartError(f"the order is {order} and the prior's address {settings.prior_select}")
        start = BM2Start(
            state=self._state("START_STATE"),
            known=self._state("KNOWN_MASK"),
            samples=settings.target_count,
            burn_in=self._value("BURN_IN"),
            ops_timeout=self._value("OPS_TIMEOUT"),
            max_cycles=settings.max_cycles,
            bank=settings.bank,
            sequencer=_ORDERS[order],
        )
        self._kernel.start(start, end)
        self._show()

    def resume(self, end: int) -> None:
        self._check_run_until()
        self._kernel.resume(self._value("TARGET_COUNT"), end)
        self._show()

    def step(self, end: int) -> None:
        self._kernel.step(end)
        self._show()

    def _check_run_until(self) -> None:
        if any(self._memory["RUN_UNTIL"]):
            raise StartError("this machine has no slices: RUN_UNTIL must be 0")

    def _state(self, block: str) -> int:
        return int.from_bytes(self._memory[block][: self._state_bytes], "little")

    def _value(self, block: str) -> int:
        return int.from_bytes(self._memory[block], "little")

    def _show(self) -> None:
        """Copy the results to the registers."""
        kernel, memory = self._kernel, self._memory
        values = (kernel.samples, kernel.unused, kernel.timed_out_bit & _NO_BIT)
        blocks = dict(zip(_ANSWER, map(_word, values), strict=True))
        blocks["RESULTS"] = kernel.results.astype("<u4").tobytes()
        if kernel.machine.parameters.stream:
            stream = kernel.stream
            blocks |= {"STREAM_COUNT": _word(len(stream)), "STREAM": stream.astype("<u4").tobytes()}
        for name, words in blocks.items():
            memory[name][: len(words)] = words

    @property
    def paused(self) -> bool:
        return self._kernel.reason is BM2StopReason.PAUSED

    @property
    def resumable(self) -> bool:
        return self._kernel.reason in {BM2StopReason.SAMPLES, BM2StopReason.FULL}

    @property
    def reason(self) -> int:
        return self._kernel.reason

    @property
    def cycles(self) -> int:
        return self._kernel.cycles


class _InProcess:
    """A machine whose registers are blocks of this process."""

    def __init__(self, machine: BM2Machine) -> None:
        used = BM2.registers(machine.parameters)
        words = {
            used.inputs: used.input_words,
            "TARGET_COUNT": 1,
            "RUN_UNTIL": 2,
            **used.written,
            **used.answer,
        }
        self._memory = {name: memoryview(bytearray(4 * count)) for name, count in words.items()}
        self._board = _OnBoard(BM2.kernel(machine), self._memory)
        self._used = used
        # those of `StoppedBoard`
        self.reasons: tuple[int, ...] = ()
        self.answer = memoryview(b"")

    def start(self, settings: FrameSettings, blocks: Blocks) -> None:
        for name, words in blocks.items():
            self._memory[name][:] = words
        self._board.start(settings, 0)
        self._stop()

    def resume(self, settings: FrameSettings) -> None:
        self._memory["TARGET_COUNT"][:] = _word(settings.target_count)
        self._board.resume(0)
        self._stop()

    def _stop(self) -> None:
        self.reasons = (self._board.reason,)
        self.answer = memoryview(b"".join(self._memory[name] for name in self._used.answer))

    def result(self) -> BoardResult:
        return BoardResult(bytes(self._memory["RESULTS"]), self._board.cycles, self._board.reason)


class Kept(msgspec.Struct, frozen=True, array_like=True):
    """What a frame leaves of one board, beside its last results.

    Attributes:
        parameters: The parameters of its machine.
        samples: Samples drawn at the end of each batch; with a stream, at the end of the frame.
        unused: Those of them that are in no histogram.
        batches: The result words at the end of each batch but the last, whose are `BoardResult.words`.
        timed_out_bit: The bit on which the CDEs did not agree; -1: none.
        stream: The sampled states, `state_words` words each.
    """

    parameters: BM2Parameters
    samples: list[int]
    unused: list[int]
    batches: list[bytes]
    timed_out_bit: int
    stream: bytes


def _kept(board: BoardResult) -> Kept:
    # a result may come from a pipe, into which anybody can write
    try:
        kept = msgspec.msgpack.decode(board.kept, type=Kept)
    except msgspec.MsgspecError as error:
        raise MachineError(f"The result of a board has no record of its chain: {error}.") from error
    parameters = kept.parameters
    sizes = {len(words) for words in (*kept.batches, board.words)}
    if (
        sizes != {4 * parameters.result_words}
        or len(kept.stream) % (4 * parameters.state_words)
        or not len(kept.samples) == len(kept.unused) == len(kept.batches) + 1
        or board.reason not in BM2.reasons
        or not -1 <= kept.timed_out_bit < parameters.state_bits
    ):
        raise MachineError("The result of a board does not match the record of its chain.")
    return kept


def _why_left_out(number: int, reason: int, kept: Kept, variables: Sequence[str]) -> str:
    if reason != BM2StopReason.OPS_TIMEOUT:
        return f"board{number} drew no sample that counts: raise max_cycles"
    parameters, bit = kept.parameters, kept.timed_out_bit
    variable = next(at for at, mask in enumerate(parameters.masks) if mask >> bit & 1)
    name = variables[variable] if variables else f"variable {variable}"
    return (
        f"board{number} timed out on bit {bit - parameters.offsets[variable]} of {name}, on which its factors did not "
        f"agree: raise --ops-timeout, or take fewer --prob-bits"
    )


class _Course(FrameCourse):
    """A frame on boards that draw their samples in batches, or until their streams are full."""

    def __init__(
        self, starts: Sequence[Blocks], settings: FrameSettings, machines: Sequence[BM2Machine]
    ) -> None:
        self.starts = starts
        self.begun = self.end = 0
        self._parameters = [machine.parameters for machine in machines]
        total = settings.target_count
        batches = 1 if self._parameters[0].stream else BATCHES
        # the samples at which each batch ends; several may be the same if there are few samples
        self._targets = sorted({total * (at + 1) // batches for at in range(batches)} - {0}) or [0]
        self._settings = settings
        self._take_target()

        # Of each board: the boards that may go on, and its answers so far.
        self._running = list(range(len(machines)))
        self._answers: list[list[tuple[int, int, bytes]]] = [[] for _ in machines]
        self._timed_out = [-1] * len(machines)
        self._streams = [bytearray() for _ in machines]

    def _take_target(self) -> None:
        self.settings = self._settings._replace(target_count=self._targets.pop(0))

    def proceed(self, boards: Sequence[StoppedBoard]) -> tuple[Sequence[int], Blocks]:
        """Resume with the next batch the boards that have drawn all samples, and those whose streams are full."""
        going = {BM2StopReason.FULL} if not self._targets else {BM2StopReason.FULL, BM2StopReason.SAMPLES}
        for number in self._running:
            self._keep(number, boards[number].answer)
        self._running = [number for number in self._running if boards[number].reasons[0] in going]
        if self._running and self._targets:
            self._take_target()
        return self._running, {}

    def _keep(self, number: int, answer: memoryview) -> None:
        parameters = self._parameters[number]
        end = 4 * parameters.result_words
        samples, unused, bit, *streamed = np.frombuffer(answer[end : end + 16], "<u4").tolist()
        self._timed_out[number] = -1 if bit == _NO_BIT else bit
        if streamed:
            size = 4 * parameters.state_words * streamed[0]
            self._streams[number] += answer[end + 16 : end + 16 + size]
            self._answers[number].clear()
        self._answers[number].append((samples, unused, b"" if streamed else bytes(answer[:end])))

    def conclude(self, results: Sequence[BoardResult]) -> Sequence[BoardResult]:
        """Add what is known of the chains."""
        return [
            msgspec.structs.replace(
                result,
                kept=msgspec.msgpack.encode(
                    Kept(
                        parameters=parameters,
                        samples=[samples for samples, _, _ in answers],
                        unused=[unused for _, unused, _ in answers],
                        batches=[words for _, _, words in answers[:-1]],
                        timed_out_bit=bit,
                        stream=bytes(stream),
                    )
                ),
            )
            for result, parameters, answers, bit, stream in zip(
                results, self._parameters, self._answers, self._timed_out, self._streams, strict=True
            )
        ]


class _OnHost(HostMachine):
    """Encoder of frames, which finds the start states that agree with the readings."""

    def __init__(self, machines: Sequence[BM2Machine]) -> None:
        self._machines = tuple(machines)
        self._parameters = machines[0].parameters
        self._blocks = _settings_blocks(self._parameters)
        # bytes of the streams of all boards for each sample
        streams = len(machines) if self._parameters.stream else 0
        self._stream_bytes = 4 * self._parameters.state_words * streams
        self._starts = lru_cache(_STARTS_KEPT)(self._blocks_of)

    def begin(self, frame: FrameInput) -> FrameCourse:
        """Return the course of a frame; its boards start from the smallest and the largest state by turns."""
        parameters = self._parameters
        for name, value, lowest, highest in (
            ("The number of samples", frame.target_count, 1, SAMPLES_MAX),
            ("The most cycles", frame.max_cycles, 1, CYCLES_MAX),
            ("The RNG bank", frame.bank, 0, parameters.rng_banks - 1),
        ):
            if not lowest <= value <= highest:
                raise StartError(f"{name} is {value}; this machine takes {lowest} to {highest}")
        if frame.prior_codes is not None:
            raise StartError("The frame has a written prior, but the prior of the machine is in its tables")
        if frame.target_count * self._stream_bytes > STREAM_BYTES_MAX:
            raise StartError(
                f"The streams of {frame.target_count} samples exceed {STREAM_BYTES_MAX} bytes; take at most "
                f"{STREAM_BYTES_MAX // self._stream_bytes} samples, or no stream"
            )
        starts = self._starts(tuple(frame.addresses))
        # no state agrees with the readings: the boards are asked for no samples
        samples = frame.target_count if starts else 0
        settings = FrameSettings(samples, frame.max_cycles, frame.bank, 0)
        return _Course(starts or [self._blocks] * len(self._machines), settings, self._machines)

    def slowest(self) -> FrameInput:
        """Return a frame without readings, in which all bits are sampled."""
        known = (None,) * len(self._parameters.known)
        samples = STREAM_BYTES_MAX // self._stream_bytes if self._stream_bytes else SAMPLES_MAX
        return FrameInput(addresses=known, target_count=samples, max_cycles=CYCLES_MAX)

    def _blocks_of(self, addresses: tuple[int | None, ...]) -> list[Blocks]:
        """Return the blocks of each board for these readings; none if their probability is 0."""
        parameters = self._parameters
        if len(addresses) != len(parameters.known):
            raise StartError(
                f"The frame has {len(addresses)} readings; this machine has {len(parameters.known)} known variables"
            )
        evidence: dict[int, int] = {}
        for at, (variable, address) in enumerate(zip(parameters.known, addresses, strict=True), start=1):
            if address is None:
                continue
            if not 0 <= address < parameters.cardinalities[variable]:
                raise StartError(
                    f"The address of known variable {at} is {address}; this machine takes 0 to "
                    f"{parameters.cardinalities[variable] - 1}, or none"
                )
            evidence[variable] = address
        known = sum(parameters.masks[variable] for variable in evidence)
        if known == (1 << parameters.state_bits) - 1:
            raise StartError("All variables of the frame are known, so that there is nothing to sample")
        ends = [start_state(self._machines[0], evidence, largest=largest) for largest in (False, True)]
        size = 4 * parameters.state_words
        return [
            {
                **self._blocks,
                "KNOWN_MASK": known.to_bytes(size, "little"),
                "START_STATE": state.to_bytes(size, "little"),
            }
            for machine in self._machines
            if (state := ends[machine.parameters.chain & 1]) is not None
        ]
