"""The machine for a model: its plan, its lines on the boards, and the codes of all boards (thesis 3.4, 4.2)."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from machines.bm1 import BM1Machine
from machines.bm1_kind import BM1
from machines.errors import ParameterError
from machines.parameters import BM1Parameters, PriorMode, RngKind, SensorMode
from pcie_shim.register_layout import interface_room
from toolchain.building.options import BuildOptions
from toolchain.building.quantise import Quantised
from toolchain.deployment import BM1Section, MachineSection, Scale
from toolchain.errors import BuildError
from toolchain.models.model import Model
from toolchain.outputs.memories import generators
from toolchain.outputs.mif import random_table

_MOST_CODES: Final = 1 << 30
"""Maximum number of codes of all columns, which take 2 bytes each while they are computed."""

MACHINE_KEYS: Final = tuple(
    key for key in BM1Section.model_fields if key in BM1Parameters.__dataclass_fields__ and key != "lines"
)
"""The parameters with the same names in `[machine]`; its `lines` are those of all boards."""


def machine_options(source: BuildOptions | MachineSection) -> dict[str, Any]:
    """Return the parameters of a machine with the same names in the build options and in `[machine]`."""
    return {key: getattr(source, key) for key in MACHINE_KEYS if key != "prior_bits"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MachinePlan:
    """The machine for a model, before any table is computed."""

    model: Model
    options: BuildOptions
    """The options; only the number of boards may still change, because the parameters do not contain it."""
    parameters: BM1Parameters
    """The parameters of the whole machine, with the lines of all boards."""

    @property
    def target_count(self) -> int:
        """The count that stops a machine."""
        asked = self.options.target_count
        return self.parameters.target_count_max if asked is None else asked


def plan_machine(model: Model, options: BuildOptions) -> MachinePlan:
    """Derive the parameters of the machine for the whole model, or raise a BuildError if model and options contradict."""
    if options.sensor_mode is not SensorMode.COLUMN and options.scaling is Scale.ADDRESS:
        raise BuildError(
            f"--scale address is impossible with --sensor-mode {options.sensor_mode}: lines use different addresses in a "
            "frame, so the factors of addresses would not cancel; use --scale column or none"
        )
    if options.prior_mode is PriorMode.TABLE and options.written_prior is not None:
        flag = "--prior-path" if options.sources is None else options.sources.toml.path
        raise BuildError(f"{flag} is for a written prior: add --prior-mode written")
    if options.prior_mode is PriorMode.WRITTEN and model.prior_select is not None:
        raise BuildError(
            f"the prior is selected by {model.prior_select.name}, so it cannot be written too: leave "
            "--prior-mode written out, or the selection"
        )
    codes = model.lines * sum(2**known.bits for known in model.known)
    if codes > _MOST_CODES and options.sensor_mode is not SensorMode.THRESHOLD:
        raise BuildError(
            f"the tables have {codes} codes, and a machine can have {_MOST_CODES}: use fewer lines, or fewer --bits"
        )
    per_line_codes = options.sensor_mode is SensorMode.THRESHOLD
    try:
        parameters = BM1Parameters(
            lines=model.lines,
            sensor_bits=tuple(options.prob_bits if per_line_codes else known.bits for known in model.known),
            prior_bits=0 if model.prior_select is None else model.prior_select.bits,
            **machine_options(options),
        )
    except ParameterError as reason:
        raise BuildError(str(reason)) from reason
    return MachinePlan(model=model, options=options, parameters=parameters)


def whole_machine(plan: MachinePlan, quantised: Quantised) -> BM1Machine:
    """Return the machine with all lines of a model, or raise a BuildError."""
    parameters, table = plan.parameters, plan.options.rng_table
    if table is None and parameters.rng is RngKind.TABLE:
        table = random_table(parameters.prob_bits)
    try:
        return BM1Machine(parameters, quantised.prior, quantised.tables, table)
    except ParameterError as reason:
        raise BuildError(str(reason)) from reason


@dataclass(frozen=True, slots=True)
class LineBlock:
    """The lines of one board: `lines` of them from `offset` on."""

    offset: int
    lines: int

    @property
    def end(self) -> int:
        """The line after the last one."""
        return self.offset + self.lines


def partition_lines(lines: int, count: int) -> tuple[LineBlock, ...]:
    """Return the blocks of `lines` lines on `count` boards, in order; the first `lines` mod `count` are one longer."""
    if not 1 <= count <= lines:
        raise BuildError(
            f"{lines} lines cannot be divided among {count} boards: expected 1 to {lines} partitions"
        )
    shorter, longer = divmod(lines, count)
    return tuple(
        LineBlock(board * shorter + min(board, longer), shorter + (board < longer)) for board in range(count)
    )


def split(machine: BM1Machine, count: int) -> tuple[BM1Machine, ...]:
    """Return the machine of each board of a whole machine; a BuildError as for the lines."""
    return tuple(
        BM1Machine(
            replace(machine.parameters, lines=block.lines),
            np.ascontiguousarray(machine.prior[:, block.offset : block.end]),
            tuple(np.ascontiguousarray(table[:, block.offset : block.end]) for table in machine.tables),
            machine.rng_table,
        )
        for block in partition_lines(machine.parameters.lines, count)
    )


DEFAULT_INTERFACE: Final = (20, 1200)
"""Inputs and results of the thesis's PCIe interface (3.2)."""

_MOST_SEEDS: Final = 1 << 23
"""Maximum number of seeds on a board, because more would need gigabytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardLayout:
    """The lines of each board, and the common interface."""

    blocks: tuple[LineBlock, ...]
    """Blocks of lines by board; the first one is one of the largest."""
    interface: tuple[int, int]
    """Inputs and results of the boards' registers."""
    reason: str
    """The reason for an interface that is not the default, as a clause; otherwise empty."""

    @property
    def interface_text(self) -> str:
        """The interface as in `deployment.toml`."""
        return _size_text(self.interface)


def board_layout(
    parameters: BM1Parameters, partitions: int, interface: tuple[int, int] | None
) -> BoardLayout:
    """Return the layout of a machine's boards, before any table is computed.

    Without an `interface`, it has as many inputs and results as needed, but at least the default numbers.

    Raises:
        BuildError: There are more boards than lines, the machine is larger than the interface, the interface is
            larger than the register map, or there are too many seeds.
    """
    blocks = partition_lines(parameters.lines, partitions)
    board = replace(parameters, lines=blocks[0].lines)
    _check_seeds(board)
    used = BM1.registers(board)
    needed, room = (used.input_words, used.result_words), interface_room(used)
    sentence = (
        f"a board needs {needed[0]} inputs and {needed[1]} results ({board.sensors} known variables and {board.lines} lines on it"
        + (f", {board.replicas} times)" if board.replicas > 1 else ")")
    )
    if not _is_within(needed, room):
        raise BuildError(
            f"{sentence}, but the register map has room for {room[0]} and {room[1]}{_advice(parameters, room)}"
        )
    if interface is None:
        default = DEFAULT_INTERFACE
        interface = (max(needed[0], default[0]), max(needed[1], default[1]))
        reason = (
            "" if interface == default else f", larger than the default {_size_text(default)}: {sentence}"
        )
        return BoardLayout(blocks=blocks, interface=interface, reason=reason)
    if not _is_within(interface, room):
        raise BuildError(
            f"the interface {_size_text(interface)} is larger than the register map's {_size_text(room)}"
        )
    if not _is_within(needed, interface):
        enough = (max(needed[0], interface[0]), max(needed[1], interface[1]))
        raise BuildError(
            f"the model is larger than the interface {_size_text(interface)}: {sentence}; use --interface {_size_text(enough)} or leave it out"
        )
    return BoardLayout(blocks=blocks, interface=interface, reason=", as asked for")


def _size_text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _is_within(needed: tuple[int, int], room: tuple[int, int]) -> bool:
    return needed[0] <= room[0] and needed[1] <= room[1]


def _advice(parameters: BM1Parameters, room: tuple[int, int]) -> str:
    """Return advice on fitting the register map, after a colon; empty if there is none."""
    lines = room[1] // parameters.replicas
    if parameters.sensor_mode is not SensorMode.COLUMN and parameters.sensors:
        lines = min(lines, room[0] // (parameters.replicas * parameters.sensors))
    elif parameters.sensors * parameters.replicas > room[0]:
        lines = 0
    ways = [f"--partitions {-(-parameters.lines // lines)} or more"] if lines else []
    ways += ["fewer --replicas"] if parameters.replicas > 1 else []
    return f": use {', or '.join(ways)}" if ways else ""


def _check_seeds(board: BM1Parameters) -> None:
    seeds = board.rng_banks * generators(board)
    if seeds > _MOST_SEEDS and board.rng is not RngKind.IDEAL:
        raise BuildError(
            f"--rng-banks {board.rng_banks} needs {seeds} seeds per board; use at most {_MOST_SEEDS // generators(board)}"
            + ("" if board.shared else ", or --shared")
        )
