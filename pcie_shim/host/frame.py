"""A frame of the mini-cluster: its input, the register words for each board, and the results."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from machines.bm1 import StopReason
from machines.parameters import CYCLES_MAX, PriorMode, SensorMode
from pcie_shim.errors import FrameInputError
from pcie_shim.programming_file import Image, is_plain
from pcie_shim.register_layout import SETTINGS

_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameInput:
    """Readings and settings of a frame.

    Attributes:
        addresses: One table address per sensor column, in the order of the model; None for a missing reading.
            With inputs per cell or replicas: an array of integers in the `input_shape` of the whole machine,
            addresses or codes, with -1 in all lines of a missing reading.
        prior_address: Row of the prior's table (prior select); with replicas one for all, or a tuple with one
            for each.
        prior_codes: uint16[total lines], a written prior; with replicas the same for all, or uint16[replicas, total
            lines]; None: the image's own.
        target_count: Count that stops the machines (thesis figure 3.3: number of target samples).
        max_cycles: Maximum number of cycles.
        bank: Set of seeds from which the RNGs restart.
        stop: `slices`: all boards stop at the end of the slice in which the first one overflows; `own`: each
            independently.
    """

    addresses: tuple[int | None, ...] | npt.NDArray[np.integer]
    prior_address: int | tuple[int, ...] = 0
    prior_codes: npt.NDArray[np.uint16] | None = None
    target_count: int
    max_cycles: int
    bank: int = 0
    stop: Literal["slices", "own"] = "slices"


class BoardResult(msgspec.Struct, frozen=True, array_like=True, tag="board"):
    """The counts of a board; its MessagePack form is part of a record between the services.

    Attributes:
        words: One count per line of the board, 32 bits each, little-endian, as received; replica after
            replica.
        cycles: Cycles of its machine; with replicas, of the longest-running one.
        reason: Stop reason; IMPOSSIBLE boards did not run and have no weight. With replicas, their
            `joint_reason`, or SLICE if all of them were stopped because of other boards.
        replica_cycles: Cycles of each replica; empty if the board has a single machine.
        replica_reasons: Stop reason of each replica; empty if the board has a single machine.
    """

    words: bytes
    cycles: int
    reason: StopReason
    replica_cycles: tuple[int, ...] = ()
    replica_reasons: tuple[StopReason, ...] = ()

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """A copy of the counts of the board: uint32[lines], with replicas uint32[replicas, lines]."""
        counts = np.frombuffer(self.words, "<u4").astype(np.uint32)
        return counts.reshape(len(self.replica_cycles), -1) if self.replica_cycles else counts


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOutput:
    """The results of a frame, and its durations in nanoseconds (thesis figure 4.5).

    Attributes:
        boards: One result per board, in the order of the partition.
        register_writes_ns: Posting settings, sensors, starts and resumes.
        compute_ns: Waiting for the boards, including their computing and the transport.
        reads_ns: Copying the results.
        boards_compute_ns: Computing time of the slowest board, summed over the slices. The rest of
            `compute_ns` is transport, or other boards on the same core.
        slices: Number of slices.
    """

    boards: tuple[BoardResult, ...]
    register_writes_ns: int
    compute_ns: int
    reads_ns: int
    boards_compute_ns: int
    slices: int


class BoardWords(NamedTuple):
    """Register words of a frame for one board.

    Attributes:
        settings: `register_layout.SETTINGS`.
        inputs: The words of SENSORS or INPUTS; empty without sensors.
        selects: The words of PRIOR_SELECTS; empty if PRIOR_SELECT is used.
        prior: The codes of PRIOR_CODES; None if the prior is a table.
    """

    settings: bytes
    inputs: bytes
    selects: bytes
    prior: npt.NDArray[np.uint16] | None


class FrameEncoder:
    """Encoder of frames for each board, which checks them against the whole machine."""

    def __init__(self, images: Sequence[Image]) -> None:
        # the boards differ in their lines and priors alone, so one has the parameters of all
        self._images = tuple(images)
        self._parameters = images[0].machine.parameters
        self._replicas = self._parameters.replicas
        self._total_lines = sum(image.machine.parameters.lines for image in images)
        self._is_plain = is_plain(self._parameters)
        # of plain machines: the words of SENSORS, and the address of a missing reading in each column
        self._sensor_words = struct.Struct(f"<{self._parameters.sensors}I")
        self._missing = tuple((1 << bits) - 1 for bits in self._parameters.sensor_bits)

    def encode(self, frame: FrameInput) -> list[BoardWords]:
        """Return the words for each board; a FrameInputError if the frame does not fit the machine."""
        settings, inputs, selects = self._words(frame)
        return [
            BoardWords(settings, own, selects, prior)
            for own, prior in zip(inputs, self._priors(frame), strict=True)
        ]

    def _words(self, frame: FrameInput) -> tuple[bytes, list[bytes], bytes]:
        """Return the settings, the inputs of each board, and the prior selects of the replicas."""
        parameters = self._parameters
        prior_address, selects = (
            (frame.prior_address, b"")
            if self._is_plain and isinstance(frame.prior_address, int)
            else self._prior_selects(frame)
        )
        for name, value, lowest, highest in (
            ("The target count", frame.target_count, 1, parameters.target_count_max),
            ("The most cycles", frame.max_cycles, 1, CYCLES_MAX),
            ("The RNG bank", frame.bank, 0, parameters.rng_banks - 1),
            ("The prior's address", prior_address, 0, parameters.prior_addresses - 1),
        ):
            if not lowest <= value <= highest:
                raise FrameInputError(f"{name} is {value}; this machine takes {lowest} to {highest}")
        if frame.stop not in {"slices", "own"}:
            raise FrameInputError(f"The stop rule '{frame.stop}' is unknown: use slices or own")
        settings = SETTINGS.pack(frame.target_count, frame.max_cycles, frame.bank, prior_address)
        if not self._is_plain:
            return settings, self._input_words(np.asarray(frame.addresses)), selects
        addresses = frame.addresses
        if len(addresses) != parameters.sensors:
            raise FrameInputError(
                f"The frame has {len(addresses)} readings; this machine has {parameters.sensors} sensors"
            )
        words = []
        for column, (address, missing) in enumerate(zip(addresses, self._missing, strict=True), start=1):
            if address is not None and not 0 <= address <= missing:
                raise FrameInputError(
                    f"The address of sensor column {column} is {address}; this machine takes 0 to "
                    f"{missing - 1}, or none"
                )
            words.append(missing if address is None else address)
        return settings, [self._sensor_words.pack(*words)] * len(self._images), selects

    def _prior_selects(self, frame: FrameInput) -> tuple[int, bytes]:
        """Return the prior's address (of several, the one most out of range) and the words of PRIOR_SELECTS."""
        given = frame.prior_address
        if isinstance(given, tuple):
            if self._replicas == 1 or len(given) != self._replicas:
                raise FrameInputError(
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
        """Return the words of INPUTS for each board: with inputs per cell, those of its lines."""
        parameters = self._parameters
        per_cell = parameters.sensor_mode is not SensorMode.COLUMN
        replicas, sensors, lines = self._replicas, parameters.sensors, self._total_lines
        shape = (sensors, lines) if per_cell else (sensors,)
        if replicas > 1:
            shape = (replicas, *shape)
        if not sensors:
            return [b""] * len(self._images)
        if inputs.shape != shape or inputs.dtype.kind not in "ui":
            raise FrameInputError(
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
            raise FrameInputError(
                f"The input of sensor column {column + 1}{where} is {value}; this machine takes 0 to "
                f"{top - 1 if parameters.has_tables else top}"
                + (", or -1 in all lines of a missing reading" if per_cell else ", or -1 for none")
            )
        words = np.where(absent, missing, words).astype("<u4")
        if not per_cell:
            return [words.tobytes()] * len(self._images)
        return [own.tobytes() for own in self._by_board(words)]

    def _priors(self, frame: FrameInput) -> list[npt.NDArray[np.uint16] | None]:
        """Return the part of the written prior for each board, or None if the prior is a table."""
        codes = frame.prior_codes
        if self._parameters.prior_mode is not PriorMode.WRITTEN:
            if codes is not None:
                raise FrameInputError(
                    "The frame has a written prior, but the prior of the machine is a table"
                )
            return [None] * len(self._images)
        if codes is None:
            # written all the same, because the frame before may have written another
            return [np.tile(image.machine.prior[0], self._replicas) for image in self._images]
        shapes = {(self._total_lines,)} | (
            {(self._replicas, self._total_lines)} if self._replicas > 1 else set()
        )
        if codes.shape not in shapes or int(codes.max()) > self._parameters.ones_code:
            raise FrameInputError(
                f"The prior to write has shape {codes.shape} and codes up to {codes.max()}; this machine takes "
                f"{self._total_lines} codes from 0 to {self._parameters.ones_code}, or as many for each of several "
                "replicas"
            )
        by_line = np.broadcast_to(codes, (self._replicas, self._total_lines))
        return [own.reshape(-1) for own in self._by_board(by_line)]

    def _by_board(self, array: npt.NDArray[_Scalar]) -> list[npt.NDArray[_Scalar]]:
        """Split an array by its last axis, the lines of all boards."""
        parts = []
        for image in self._images:
            offset = image.partition.line_offset
            parts.append(array[..., offset : offset + image.machine.parameters.lines])
        return parts
