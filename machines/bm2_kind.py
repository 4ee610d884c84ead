"""BM2 as a machine kind: sections of the programming file, registers, frames and posteriors (thesis 2.1.3).

After each start or resume, a board without a stream draws one batch of samples. A board with a stream draws samples
until the buffer of the stream is full.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar, Final

import msgspec
import numpy as np
import numpy.typing as npt

from machines import make_bm2_kernel
from machines.bm2 import SAMPLES_MAX, BM2Machine, BM2Parameters, BM2Start, BM2StopReason, start_state
from machines.bm2_estimate import BoardSamples, estimate, searched_counts, searched_values
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
    UsedRegisters,
    check_frame_value,
)
from machines.parameters import CYCLES_MAX, RngKind, RngReset, SampleEvery, Sequencer

STREAM_WORDS_MAX: Final = 4096
"""Maximum number of words in the stream's buffer. It is the size of the block STREAM in the register map."""

BATCHES: Final = 20
"""Number of batches into which a frame's samples are divided, if the boards do not stream their samples.

The variation between the means of the batches shows how much the samples depend on each other.
"""

STREAM_BYTES_MAX: Final = 3 << 20
"""Maximum size in bytes of a frame's streams on all boards, because one message between services contains them all."""

_STARTS_KEPT: Final = 4096  # start states that a host remembers
_ORDERS: Final = tuple(Sequencer)
_ANSWER: Final = ("SAMPLES_DONE", "UNUSED", "TIMED_OUT_BIT")
_SETTINGS: Final = ("BURN_IN", "OPS_TIMEOUT", "ORDER")
_NO_BIT: Final = 2**32 - 1


class BM2Kind(MachineKind):
    """Approximate inference by Gibbs sampling, bit by bit (thesis 2.1.3). Each board runs one chain of the model."""

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

    def due_sections(self, parameters: BM2Parameters) -> Iterator[tuple[str, str, tuple[int, ...]]]:
        """Yield the name, dtype and shape of each section that a programming file must have.

        Each CDE has a section with its codes. Each factor has a section that marks its non-zero entries. If the
        generators read a table of random numbers, this table is the last section.
        """
        for at in range(parameters.cdes):
            bits = len(parameters.factor_bits(at))
            yield f"cde {at}", "<u2", (bits << bits >> 1,)
        for at, factor in enumerate(parameters.factors):
            yield f"support {at}", "|u1", tuple(parameters.cardinalities[each] for each in factor)
        if parameters.rng is RngKind.TABLE:
            yield "rng", "<u4", (-1,)

    def machine(self, parameters: BM2Parameters, sections: Mapping[str, npt.NDArray[Any]]) -> BM2Machine:
        """Return the machine with these tables."""
        tables, supports = (
            tuple(sections[f"{name} {at}"] for at in range(parameters.cdes)) for name in ("cde", "support")
        )
        return BM2Machine(parameters, tables, supports, sections.get("rng"))

    def registers(self, parameters: BM2Parameters) -> UsedRegisters:
        """Return the registers that a board uses. `lines` is 1, because each board runs a chain of the whole model."""
        words = parameters.state_words
        if parameters.stream * words > STREAM_WORDS_MAX:
            raise ParameterError(
                f"stream is {parameters.stream}; a board has room for {STREAM_WORDS_MAX // words} states of this machine."
            )
        answer = {"RESULTS": parameters.result_words} | dict.fromkeys(_ANSWER, 1)
        if parameters.stream:
            answer |= {"STREAM_COUNT": 1, "STREAM": parameters.stream * words}
        return UsedRegisters(
            lines=1,
            part=(parameters.chain, parameters.chains),
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
        """Return the initial words of registers: the default settings of a frame. A host may overwrite them."""
        return _settings_blocks(machine.parameters)

    def kernel(self, machine: BM2Machine) -> BM2Kernel:
        """Return the fastest kernel that runs the machine."""
        return make_bm2_kernel(machine)

    def on_board(self, kernel: BM2Kernel, memory: Mapping[str, memoryview]) -> BoardMachine:
        """Return a board's machine that runs the kernel.

        `memory` is the board's blocks of registers by name, with the machine's inputs and results.
        """
        return _OnBoard(kernel, memory)

    def on_host(self, machines: Sequence[BM2Machine]) -> HostMachine:
        """Return the host's view of all boards' machines. Each machine runs one chain of the whole model."""
        return _OnHost(machines)

    def infer(self, results: Sequence[BoardResult], variables: Sequence[str] = ()) -> Inference:
        """Return the posterior of the chains of all boards.

        If a board timed out or has no sample, its chain is left out, and the details of the result name the board.
        """
        chains, every = [], [_kept(board) for board in results]
        if len({(kept.parameters.cardinalities, kept.parameters.searched) for kept in every}) > 1:
            raise MachineError("The results of the boards are those of different models.")
        for board, kept in zip(results, every, strict=True):
            parameters = kept.parameters
            words = np.frombuffer(b"".join([*kept.batches, board.words]), "<u4")
            counts = searched_counts(parameters, words.reshape(-1, parameters.result_words))
            values = None
            if parameters.stream:
                stream = np.frombuffer(kept.stream, "<u4").reshape(-1, parameters.state_words)
                values = searched_values(parameters, stream)
            chains.append(BoardSamples(BM2StopReason(board.reason), counts, values))
        totals = [kept.samples - kept.unused for kept in every]
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
            "samples": str(sum(kept.samples for kept in counted)),
            "unused": str(sum(kept.unused for kept in counted)),
        }
        error = 0.0 if found.error is None else float(found.error.max())
        numbers = {
            "effective_samples": (found.effective_samples, ".0f"),
            "standard_error": (error, ".4g"),
            "r_hat": (found.r_hat, ".4f"),
        }
        details |= {
            key: format(value, form) for key, (value, form) in numbers.items() if not math.isnan(value)
        }
        if left_out:
            details["left_out"] = left_out
        outcome = "posterior"
        # the samples of these boards depend on how long the moves took
        early = [at for at, board in enumerate(results) if board.reason == BM2StopReason.MAX_CYCLES]
        if early:
            details["ended_early"] = ", ".join(f"board{number}" for number in early)
            outcome = f"biased posterior: max_cycles ended {details['ended_early']}"
        samples, size = b"".join([kept.stream for kept in counted]), 4 * every[0].parameters.state_words
        return Inference(results, found.posterior, totals, outcome, details, samples, size)

    def posterior(
        self, machines: Sequence[BM2Machine], frame: FrameInput, variables: Sequence[str] = ()
    ) -> tuple[npt.NDArray[np.float64], Mapping[str, str]]:
        """Run a frame on the machines of all boards, and return the posterior and statistics of the frame.

        The machines run in this process, one after another. Each machine draws the same samples as on its board.

        Raises:
            NoPosteriorError: The frame has no posterior.
        """
        inference = self.infer(run_batches(kernels_of(machines), frame), variables)
        if inference.posterior is None:
            raise NoPosteriorError(f"There is {inference.outcome}.")
        return inference.posterior, inference.details


BM2: Final = BM2Kind()


def _word(value: int) -> bytes:
    return value.to_bytes(4, "little")


def _settings_blocks(parameters: BM2Parameters) -> Blocks:
    order = _ORDERS.index(parameters.sequencer)
    return dict(zip(_SETTINGS, map(_word, (parameters.burn_in, parameters.ops_timeout, order)), strict=True))


def _start_of(
    parameters: BM2Parameters, blocks: Mapping[str, bytes | memoryview], settings: FrameSettings
) -> BM2Start:
    """Return the start that a host has written to a board's register blocks.

    If a block has more words than the state of the machine, the words after the state's words are ignored.
    """

    def value(block: str) -> int:
        # a frame without a start state has no words for it
        return int.from_bytes(blocks.get(block, b"")[: 4 * parameters.state_words], "little")

    order = value("ORDER")
    if settings.prior_select or order >= len(_ORDERS):
        raise StartError(f"the order is {order} and the prior's address {settings.prior_select}")
    return BM2Start(
        state=value("START_STATE"),
        known=value("KNOWN_MASK"),
        samples=settings.target_count,
        burn_in=value("BURN_IN"),
        ops_timeout=value("OPS_TIMEOUT"),
        max_cycles=settings.max_cycles,
        bank=settings.bank,
        sequencer=_ORDERS[order],
    )


def kernels_of(machines: Sequence[BM2Machine]) -> list[BM2Kernel]:
    """Return kernels for `run_batches`. The kernels have no streams, because a stream does not change the samples."""
    return [
        make_bm2_kernel(replace(machine, parameters=replace(machine.parameters, stream=0)))
        for machine in machines
    ]


def run_batches(kernels: Sequence[BM2Kernel], frame: FrameInput) -> list[BoardResult]:
    """Run a frame on the kernels from `kernels_of`, one for each board. Raises a StartError if the frame does not fit.

    Each kernel draws its samples in up to `BATCHES` batches, like a board that does not stream its samples.
    """
    starts, settings = _OnHost([kernel.machine for kernel in kernels]).starts(frame)
    first, *others = _batch_ends(settings.target_count)
    results = []
    for kernel, blocks in zip(kernels, starts, strict=True):
        parameters = kernel.machine.parameters
        kernel.start(_start_of(parameters, blocks, settings._replace(target_count=first)))
        batches = [kernel.results]
        for target in others:
            if kernel.reason is not BM2StopReason.SAMPLES:
                break
            kernel.resume(target)
            batches.append(kernel.results)
        *before, words = (each.astype("<u4").tobytes() for each in batches)
        kept = Kept(parameters, kernel.samples, kernel.unused, kernel.timed_out_bit, before)
        results.append(BoardResult(words, kernel.cycles, kernel.reason, kept=msgspec.msgpack.encode(kept)))
    return results


def _batch_ends(samples: int, batches: int = BATCHES) -> list[int]:
    """Return the number of samples after which each batch ends; with few samples there are fewer batches."""
    return sorted({samples * (at + 1) // batches for at in range(batches)} - {0}) or [0]


class _OnBoard(BoardMachine):
    """A kernel that reads start state, known bits and settings from a board's blocks, and writes its answer there."""

    def reset(self) -> None:
        self._kernel.reset()
        self._show()

    def start(self, settings: FrameSettings, end: int) -> None:
        self._check_run_until()
        self._kernel.start(_start_of(self._kernel.machine.parameters, self._memory, settings), end)
        self._show()

    def resume(self, end: int) -> None:
        self._check_run_until()
        self._kernel.resume(int.from_bytes(self._memory["TARGET_COUNT"], "little"), end)
        self._show()

    def step(self, end: int) -> None:
        self._kernel.step(end)
        self._show()

    def _check_run_until(self) -> None:
        if any(self._memory["RUN_UNTIL"]):
            raise StartError("this machine has no slices: RUN_UNTIL must be 0")

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


class Kept(msgspec.Struct, array_like=True):
    """The results of one board's chain in a frame, without the last result words.

    The last result words are in `BoardResult.words`.

    Attributes:
        samples: Number of samples drawn so far.
        unused: Number of samples that no histogram counts.
        timed_out_bit: The state bit on which the CDEs did not agree in time, or -1 if there is no such bit.
        batches: The result words at the end of each batch, if the machine has no stream. When the frame has ended, the
            last batch is removed from `batches`, because `BoardResult.words` contains the words of the last batch.
        stream: The sampled states. Each state has `state_words` words.
    """

    parameters: BM2Parameters
    samples: int = 0
    unused: int = 0
    timed_out_bit: int = -1
    batches: list[bytes] = msgspec.field(default_factory=list)
    stream: bytearray = msgspec.field(default_factory=bytearray)

    def add(self, answer: memoryview) -> None:
        """Add an answer of the board. The answer has the words of the blocks in `UsedRegisters.answer`."""
        end = 4 * self.parameters.result_words
        self.samples, self.unused, bit, *streamed = np.frombuffer(answer[end : end + 16], "<u4").tolist()
        self.timed_out_bit = -1 if bit == _NO_BIT else bit
        if streamed:
            self.stream += answer[end + 16 : end + 16 + 4 * self.parameters.state_words * streamed[0]]
        else:
            self.batches.append(bytes(answer[:end]))


def _kept(board: BoardResult) -> Kept:
    # a result may come from a pipe, into which anybody can write
    try:
        kept = msgspec.msgpack.decode(board.kept, type=Kept)
    except msgspec.MsgspecError as error:
        raise MachineError(f"The result of a board has no record of its chain: {error}.") from error
    parameters = kept.parameters
    sizes = {len(words) for words in (*kept.batches, board.words)}
    streamed = kept.samples if parameters.stream else 0
    lowest_bit = 0 if board.reason == BM2StopReason.OPS_TIMEOUT else -1
    if (
        sizes != {4 * parameters.result_words}
        or len(kept.stream) != 4 * parameters.state_words * streamed
        or not 0 <= kept.unused <= kept.samples
        or board.reason not in BM2.reasons
        or not lowest_bit <= kept.timed_out_bit < parameters.state_bits
    ):
        raise MachineError("The result of a board does not match the record of its chain.")
    return kept


def _why_left_out(number: int, reason: int, kept: Kept, variables: Sequence[str]) -> str:
    if reason != BM2StopReason.OPS_TIMEOUT:
        return f"board{number} drew no sample that counts: raise max_cycles"
    parameters, bit = kept.parameters, kept.timed_out_bit
    variable = next(at for at, mask in enumerate(parameters.masks) if mask >> bit & 1)
    name = variables[variable] if variable < len(variables) else f"variable {variable}"
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
        self._targets = _batch_ends(settings.target_count, 1 if machines[0].parameters.stream else BATCHES)
        self.settings = settings._replace(target_count=self._targets.pop(0))
        self._kept = [Kept(machine.parameters) for machine in machines]
        self._running = list(range(len(machines)))

    def proceed(
        self, reasons: Sequence[Sequence[int]], answers: Sequence[memoryview]
    ) -> tuple[Sequence[int], Blocks]:
        """Resume boards whose stream is full, and, for the next batch, boards that have drawn this batch's samples."""
        going = {BM2StopReason.FULL} if not self._targets else {BM2StopReason.FULL, BM2StopReason.SAMPLES}
        for number in self._running:
            self._kept[number].add(answers[number])
        self._running = [number for number in self._running if reasons[number][0] in going]
        if self._running and self._targets:
            self.settings = self.settings._replace(target_count=self._targets.pop(0))
        return self._running, {}

    def conclude(self, results: Sequence[BoardResult]) -> Sequence[BoardResult]:
        """Add the records of the chains (`Kept`) to the results."""
        for kept in self._kept:
            del kept.batches[-1:]
        return [
            msgspec.structs.replace(result, kept=msgspec.msgpack.encode(kept))
            for result, kept in zip(results, self._kept, strict=True)
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
        """Return a frame's `FrameCourse`; boards start alternately from the smallest and the largest state."""
        return _Course(*self.starts(frame), self._machines)

    def starts(self, frame: FrameInput) -> tuple[Sequence[Blocks], FrameSettings]:
        """Return the blocks to write to each board, and the settings of the frame for all boards.

        Raises a StartError if the frame does not fit the machine.
        """
        parameters = self._parameters
        check_frame_value("The number of samples", frame.target_count, 1, SAMPLES_MAX)
        check_frame_value("The most cycles", frame.max_cycles, 1, CYCLES_MAX)
        check_frame_value("The RNG bank", frame.bank, 0, parameters.rng_banks - 1)
        if frame.prior_codes is not None:
            raise StartError("The frame has a written prior, but the prior of the machine is in its tables")
        if frame.target_count * self._stream_bytes > STREAM_BYTES_MAX:
            raise StartError(
                f"The streams of {frame.target_count} samples exceed {STREAM_BYTES_MAX} bytes; take at most "
                f"{STREAM_BYTES_MAX // self._stream_bytes} samples, or no stream"
            )
        starts = self._starts(tuple(frame.addresses))
        if isinstance(starts, str):
            raise StartError(starts)
        # no state agrees with the readings: the boards are asked for no samples
        samples = frame.target_count if starts else 0
        settings = FrameSettings(samples, frame.max_cycles, frame.bank, 0)
        return starts or [self._blocks] * len(self._machines), settings

    def slowest(self) -> FrameInput:
        """Return a frame without readings, in which all bits are sampled."""
        known = (None,) * len(self._parameters.known)
        samples = STREAM_BYTES_MAX // self._stream_bytes if self._stream_bytes else SAMPLES_MAX
        return FrameInput(addresses=known, target_count=samples, max_cycles=CYCLES_MAX)

    def _blocks_of(self, addresses: tuple[int | None, ...]) -> list[Blocks] | str:
        """Return the blocks of each board (none if the readings have probability 0), or the text of an error."""
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
        try:
            ends = [start_state(self._machines[0], evidence, largest=largest) for largest in (False, True)]
        except StartError as error:
            return str(error)  # remembered, too, so that a long search is not repeated
        size = 4 * parameters.state_words
        words = [b"" if end is None else end.to_bytes(size, "little") for end in ends]
        common = {**self._blocks, "KNOWN_MASK": known.to_bytes(size, "little")}
        boards = self._machines if all(words) else ()
        return [{**common, "START_STATE": words[machine.parameters.chain & 1]} for machine in boards]
