"""A machine kind: the interface through which programming files, boards, drivers and posteriors use any machine.

    host                                                     board
    begin(frame) ──── settings, blocks ────▶ start ──▶ step, step, ... ─┐
    proceed(answers) ─ settings, blocks ───▶ resume ─▶ step, step, ... ─┤ until `proceed` resumes no board
    infer(results) ◀── results, cycles, reasons ────────────────────────┘

The register map gives each block of registers a name and an address. This folder uses only the names, and defines
what the words of a block mean to a machine. `pcie_shim` translates the names to addresses.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from machines.errors import StartError

Blocks: TypeAlias = Mapping[str, bytes]
"""Words to write to registers, by the name of their block in the register map."""

OUTCOME: Final = np.dtype([("reason", "<u4"), ("zero", "<u4"), ("cycles", "<u8")])
"""The entry of one replica in the register block OUTCOMES: stop reason and cycles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameInput:
    """Readings and settings of a frame, for all boards.

    Attributes:
        addresses: One table address per sensor column, in the order of the model, or None for a missing reading.
            A machine with inputs per cell or with replicas gets an array of integers instead, in the `input_shape`
            of the whole machine. The integers are addresses or codes. A missing reading is -1 in all its lines.
        prior_address: Row of the prior's table (prior select). With replicas, one row for all replicas, or a tuple
            with one row per replica.
        prior_codes: The written prior: uint16[total lines], for all replicas, or uint16[replicas, total lines].
            None selects the prior in the image.
        target_count: Count that stops the machines (thesis figure 3.3: number of target samples).
        max_cycles: Maximum number of cycles.
        bank: Set of seeds from which the RNGs restart.
        stop: With `slices`, all boards stop at the end of the slice in which the first board overflows. With `own`,
            each board stops independently.
    """

    addresses: tuple[int | None, ...] | npt.NDArray[np.integer]
    prior_address: int | tuple[int, ...] = 0
    prior_codes: npt.NDArray[np.uint16] | None = None
    target_count: int
    max_cycles: int
    bank: int = 0
    stop: Literal["slices", "own"] = "slices"


class FrameSettings(NamedTuple):
    """The settings of a frame: the values of four registers, in the order of the register map.

    The host writes the settings before it starts or resumes the frame. Every kind of machine has these registers.
    """

    target_count: int
    max_cycles: int
    bank: int
    prior_select: int


class BoardResult(msgspec.Struct, frozen=True, array_like=True, tag="board"):
    """The result of a board. Records between the services contain this result as MessagePack.

    Attributes:
        words: The result words of all replicas, one replica after another. A word has 32 bits, little-endian.
        cycles: Cycles of the board's machine. With replicas, the cycles of the replica that ran longest.
        reason: Stop reason, a key of `MachineKind.reasons`. With replicas, the replicas' `joint_reason`.
        replica_cycles: Cycles of each replica. Empty if the board has a single machine.
        replica_reasons: Stop reason of each replica. Empty if the board has a single machine.
        kept: Further results that `FrameCourse.conclude` adds for `MachineKind.infer`, in the kind's encoding.
    """

    words: bytes
    cycles: int
    reason: int
    replica_cycles: tuple[int, ...] = ()
    replica_reasons: tuple[int, ...] = ()
    kept: bytes = b""

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """A copy of the result words: uint32[results], or with replicas uint32[replicas, results per replica]."""
        counts = np.frombuffer(self.words, "<u4").astype(np.uint32)
        return counts.reshape(len(self.replica_cycles), -1) if self.replica_cycles else counts


class Inference(NamedTuple):
    """The posterior computed from the results of all boards.

    Attributes:
        boards: The boards' results.
        posterior: The joint posterior, float64[all lines], or None if there is none. With replicas,
            float64[replicas * all lines]: the replicas' posteriors one after the other. A replica without a posterior
            has zeros. The value is None only if no replica has a posterior.
        totals: For each board, the sum of its counts.
        outcome: The text `posterior`, or the reason why the posterior is missing or biased.
        details: Further values for the report of the frame, by their keys.
        samples: The sampled states of the machine, concatenated. A machine without a stream has none.
        sample_bytes: Length of each sampled state in bytes.
    """

    boards: Sequence[BoardResult]
    posterior: npt.NDArray[np.float64] | None
    totals: list[int]
    outcome: str
    details: Mapping[str, str] = MappingProxyType({})
    samples: bytes = b""
    sample_bytes: int = 0

    @property
    def best(self) -> int:
        """The most probable line of the posterior, or -1 without a posterior."""
        return -1 if self.posterior is None else int(self.posterior.argmax())


@dataclass(frozen=True, slots=True, kw_only=True)
class UsedRegisters:
    """The registers of a board that a machine uses, according to its parameters.

    Attributes:
        lines: Number of the model's lines on the board.
        part: Index of the board and number of boards, or None if the parameters do not contain them.
        replicas: Number of machines on the board.
        inputs: Name of the block of inputs.
        input_words: Number of input words of all replicas.
        result_words: Number of words of the block RESULTS, for all replicas.
        written: The number of words of each block that a host may write, by the block's name. The block of inputs is
            not included.
        answer: The number of words of each block that a stopped board sends, by the block's name. The blocks are in the
            order of sending, and RESULTS is the first.
        capabilities: Values of capability registers (`CAP_LINES`) or of their fields (`CAP_MACHINE.KIND`), by name.
        size: The size of the machine, described for a user.
    """

    lines: int
    part: tuple[int, int] | None = None
    replicas: int
    inputs: str
    input_words: int
    result_words: int
    written: Mapping[str, int] = field(default_factory=dict)
    answer: Mapping[str, int]
    capabilities: Mapping[str, int]
    size: str


class BoardMachine(ABC):
    """The machine of a board. It reads its inputs from the board's registers and writes its results there.

    The machine runs only during calls of `start`, `resume` and `step`. After a doorbell, `start` or `resume` begins a
    slice. `step` continues a slice. Each call ends at cycle `end` at the latest; an `end` of 0 sets no limit. After
    each call, the results are in the blocks of `UsedRegisters.answer`.
    """

    def __init__(self, kernel: Any, memory: Mapping[str, memoryview]) -> None:
        self._kernel = kernel
        self._memory = memory

    def prepare(self) -> None:
        """Do work in advance that would slow down the first frames, and reset the machine."""
        self.reset()

    @abstractmethod
    def reset(self) -> None:
        """Stop the machine, clear its results and cycles, and restart its RNGs from bank 0."""

    @abstractmethod
    def start(self, settings: FrameSettings, end: int) -> None:
        """Run a new frame. If the registers do not fit the machine, raise a StartError and change nothing."""

    @abstractmethod
    def resume(self, end: int) -> None:
        """Run the next slice of the frame. If the registers do not fit the machine, raise a StartError."""

    @abstractmethod
    def step(self, end: int) -> None:
        """Run the next part of the slice."""

    @property
    @abstractmethod
    def paused(self) -> bool:
        """True if the machine has stopped only because it reached cycle `end`, so that `step` can continue."""

    @property
    def resumable(self) -> bool:
        """True if a host may resume the frame."""
        return self.paused

    @property
    def reason(self) -> int:
        """The stop reason of the machine: a key of `MachineKind.reasons`."""
        return int(self._kernel.reason)

    @property
    def cycles(self) -> int:
        """Number of cycles of this frame so far."""
        return int(self._kernel.cycles)


class FrameCourse(ABC):
    """A frame on all boards, from its start through its slices.

    Attributes:
        starts: The blocks to write before the start, for each board.
        settings: The settings of the present slice, for all boards.
        begun: Last cycle before the present slice.
        end: Last cycle of the present slice, or 0 if the slice ends with the frame.
    """

    starts: Sequence[Blocks]
    settings: FrameSettings
    begun: int
    end: int

    @abstractmethod
    def proceed(
        self, reasons: Sequence[Sequence[int]], answers: Sequence[memoryview]
    ) -> tuple[Sequence[int], Blocks]:
        """Return the indices of the boards to resume, and the blocks to write to each of them before its resume.

        If the frame is over, there are no indices. For each board, `reasons` has the last stop reasons of its replicas,
        and `answers` has the words of the blocks in `UsedRegisters.answer`. A board's words are valid until the board
        is resumed.
        """

    def conclude(self, results: Sequence[BoardResult]) -> Sequence[BoardResult]:
        """Return the results. A subclass may add data that it stored during the slices, as `BoardResult.kept`."""
        return results


def check_frame_value(name: str, value: int, lowest: int, highest: int) -> None:
    """Raise a StartError if the value `name` of a frame is not from `lowest` to `highest`."""
    if not lowest <= value <= highest:
        raise StartError(f"{name} is {value}; this machine takes {lowest} to {highest}")


class HostMachine(ABC):
    """The host's interface to the machines of all boards."""

    @abstractmethod
    def begin(self, frame: FrameInput) -> FrameCourse:
        """Return a frame's `FrameCourse`. Raises a StartError if the frame does not fit the machines."""

    @abstractmethod
    def slowest(self) -> FrameInput:
        """Return the frame that takes the most time per cycle, for measuring the speed of a board."""


class MachineKind(ABC):
    """A kind of Bayesian machine. Each kind has its own types of machines, parameters and kernels.

    Attributes:
        name: Name of the kind in programming files and deployments.
        has_hardware: True if machines of this kind exist in VHDL.
        parameters: Dataclass of the machine's parameters.
        reasons: Stop reasons in words for users, by the number in the status register. 0 means not started.
    """

    name: ClassVar[str]
    has_hardware: ClassVar[bool]
    parameters: ClassVar[type]
    reasons: ClassVar[Mapping[int, str]]

    # ---- programming file -----------------------------------------------------------------------------

    def sections(self, machine: Any) -> list[tuple[str, npt.NDArray[Any]]]:
        """Return the machine's tables as sections of a programming file: the name and the content of each section."""
        due = zip(self.due_sections(machine.parameters), machine.arrays, strict=True)
        return [(name, array.astype(words, copy=False)) for (name, words, _), array in due]

    @abstractmethod
    def due_sections(self, parameters: Any) -> Iterator[tuple[str, str, tuple[int, ...]]]:
        """Yield the name, dtype and shape of each section that a file must have. Length -1 stands for any length."""

    @abstractmethod
    def machine(self, parameters: Any, sections: Mapping[str, npt.NDArray[Any]]) -> Any:
        """Return a machine with the parameters and sections of a programming file, or raise a MachineError."""

    # ---- board ----------------------------------------------------------------------------------------

    @abstractmethod
    def registers(self, parameters: Any) -> UsedRegisters:
        """Return the registers that a board with such a machine uses."""

    @abstractmethod
    def contents(self, machine: Any) -> Blocks:
        """Return the initial words of the register blocks after an image is loaded.

        The registers in `UsedRegisters.capabilities` are not included.
        """

    @abstractmethod
    def kernel(self, machine: Any) -> Any:
        """Return the fastest kernel that runs the machine."""

    @abstractmethod
    def on_board(self, kernel: Any, memory: Mapping[str, memoryview]) -> BoardMachine:
        """Return a board's machine, which runs `kernel` on registers. `memory` has the register blocks by name."""

    # ---- host -----------------------------------------------------------------------------------------

    @abstractmethod
    def on_host(self, machines: Sequence[Any]) -> HostMachine:
        """Return the host's interface to all boards' machines. `machines` are in the order of the boards."""

    def joint_reason(self, reasons: Sequence[int]) -> int:
        """Combine the stop reasons of a board's replicas into one. Without replicas, return the only stop reason."""
        return reasons[0]

    @abstractmethod
    def infer(self, results: Sequence[BoardResult], variables: Sequence[str] = ()) -> Inference:
        """Return the posterior for the results of all boards.

        `variables` are the variables' names, for the text that says why a board was left out.
        """

    @abstractmethod
    def posterior(
        self, machines: Sequence[Any], frame: FrameInput, variables: Sequence[str] = ()
    ) -> tuple[npt.NDArray[np.float64], Mapping[str, str]]:
        """Run the machines of all boards in this process, and return the posterior with details about it.

        Each machine runs until it stops by itself.

        Raises:
            NoPosteriorError: The readings give no posterior.
            StartError: The frame does not fit the machines.
        """
