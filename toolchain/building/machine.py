"""The BM1 for a model: its parameters, the lines of each board, and the size of the registers (thesis 3.4, 4.2)."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np

from machines.bm1 import BM1Machine
from machines.bm1_kind import BM1
from machines.bm2 import BM2Parameters
from machines.errors import ParameterError
from machines.kind import UsedRegisters
from machines.parameters import ADDRESS_BITS_MAX, PROB_BITS_MAX, BM1Parameters, PriorMode, RngKind, SensorMode
from pcie_shim.register_layout import interface_room
from toolchain.building.options import BuildOptions, refused_parameter
from toolchain.building.quantise import Quantised, quantise
from toolchain.deployment import BM1Section, BM2Section, MachineSection, Scale
from toolchain.errors import BuildError, counted
from toolchain.flags import key_values
from toolchain.models.model import Model
from toolchain.outputs.mif import random_table

_MOST_CODES: Final = 1 << 30
"""Maximum number of codes in the tables of all columns, 2 bytes each while they are computed."""

MACHINE_KEYS: Final = tuple(
    key for key in BM1Section.model_fields if key in BM1Parameters.__dataclass_fields__ and key != "lines"
)
"""Keys of `[machine]` that are fields of BM1Parameters, except `lines`.

`[machine]` counts the lines of all boards. The BM1Parameters of a board count only the lines of this board.
"""


def machine_options(source: BuildOptions | MachineSection, keys: Iterable[str]) -> dict[str, Any]:
    """Return the values of `keys` in `source`. Omit a key if it is not a build option, or if its value is None."""
    options = [key for key in keys if key in BuildOptions.__dataclass_fields__]
    return {key: value for key in options if (value := getattr(source, key)) is not None}


def option(key: str, options: BuildOptions, section: type[BM1Section | BM2Section]) -> int:
    """Return the value of the option `key`. If the option is None, return the default of this key in `section`.

    `section` is the class of the section `[machine]`.
    """
    asked = getattr(options, key)
    return int(section.model_fields[key].default if asked is None else asked)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MachinePlan:
    """The parameters of the BM1 for a model, before any table is computed."""

    kind: ClassVar = "BM1"
    why: ClassVar = "the known variables are independent given the searched ones"
    """The reason why the build chooses a BM1, as a clause."""
    model: Model
    options: BuildOptions
    """The options of the build. Later, `fit_to_device` may change the numbers of boards and replicas."""
    parameters: BM1Parameters
    """The parameters of the whole machine, with the lines of all boards."""
    target_count: int
    """The machine stops when the counter of a line reaches this value."""
    max_cycles: int
    """The maximum number of cycles of a frame."""

    def quantised(self) -> Quantised:
        """Return the codes of the model."""
        p = self.parameters
        return quantise(
            self.model, prob_bits=p.prob_bits, scale=self.options.scaling, sensor_mode=p.sensor_mode
        )


def with_bits(model: Model, bits: Iterable[str]) -> Model:
    """Return the model with the numbers of address bits in `bits` (each is `NAME=BITS`), or raise a BuildError."""
    widths = key_values(bits, "--bits", "range=8")
    names = [variable.name for variable in model.variables]
    for name, text in widths.items():
        if name not in names:
            raise BuildError(
                f"--bits {name}={text}: the model has no such variable; it has {', '.join(names) or 'none'}"
            )
        if not re.fullmatch(r"\d{1,3}", text, re.ASCII) or not 1 <= int(text) <= ADDRESS_BITS_MAX:
            raise BuildError(f"--bits {name}={text}: expected 1 to {ADDRESS_BITS_MAX} bits")
    return model.with_bits({name: int(text) for name, text in widths.items()})


def plan_machine(model: Model, options: BuildOptions) -> MachinePlan:
    """Return the plan of the machine for the whole model, or raise a BuildError if the options do not fit the model."""
    if model.transition is not None:
        options = _filter_options(options)
    if options.sensor_mode is not SensorMode.COLUMN and options.scaling is Scale.ADDRESS:
        raise BuildError(
            f"--scale address is impossible with --sensor-mode {options.sensor_mode}: lines use different addresses in a "
            "frame, so the factors of addresses would not cancel; use --scale column or none"
        )
    if options.prior_mode is not PriorMode.WRITTEN and options.written_prior is not None:
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
    prob_bits = option("prob_bits", options, BM1Section)
    per_line_codes = options.sensor_mode is SensorMode.THRESHOLD
    try:
        parameters = BM1Parameters(
            lines=model.lines,
            sensor_bits=tuple(prob_bits if per_line_codes else known.bits for known in model.known),
            prior_bits=0 if model.prior_select is None else model.prior_select.bits,
            **machine_options(options, MACHINE_KEYS) | {"replicas": options.replicas or 1},
        )
    except ParameterError as reason:
        raise refused_parameter(reason) from reason
    target_count = parameters.target_count_max if options.target_count is None else options.target_count
    return MachinePlan(
        model=model,
        options=options,
        parameters=parameters,
        target_count=target_count,
        max_cycles=option("max_cycles", options, BM1Section),
    )


def _filter_options(options: BuildOptions) -> BuildOptions:
    """Return the options for the machine of a filter, or raise a BuildError.

    The machine of a filter needs a written prior. By default, its codes have 16 bits. With 8 bits, even the smallest
    code is too large for the small probabilities in a prediction. The error of the posteriors then triples on 400
    lines.
    """
    if options.written_prior is not None:
        flag = "--prior-path" if options.sources is None else f"the prior in {options.sources.toml.path}"
        raise BuildError(f"{flag} cannot be used with a filter, which writes the prior itself: leave it out")
    if options.prior_mode is PriorMode.TABLE:
        raise BuildError(
            "--prior-mode table cannot be used with a filter, which writes the prior: leave it out"
        )
    if options.replicas != 1 or options.sensor_mode is not SensorMode.COLUMN:
        flag = "--replicas" if options.replicas != 1 else f"--sensor-mode {options.sensor_mode}"
        raise BuildError(
            f"{flag} cannot be used with a filter, which is one machine with one reading per variable: leave it out"
        )
    return replace(options, prior_mode=PriorMode.WRITTEN, prob_bits=options.prob_bits or PROB_BITS_MAX)


def whole_machine(plan: MachinePlan, quantised: Quantised) -> BM1Machine:
    """Return the undivided machine with all lines, or raise a BuildError."""
    parameters, table = plan.parameters, plan.options.rng_table
    if table is None and parameters.rng is RngKind.TABLE:
        table = random_table(parameters.prob_bits)
    try:
        return BM1Machine(parameters, quantised.prior, quantised.tables, table)
    except ParameterError as reason:
        raise BuildError(str(reason)) from reason


@dataclass(frozen=True, slots=True)
class LineBlock:
    """The consecutive lines of one board. The first line has the index `offset`."""

    offset: int
    lines: int

    @property
    def end(self) -> int:
        """The index after the last line of the block."""
        return self.offset + self.lines


def partition_lines(lines: int, count: int) -> tuple[LineBlock, ...]:
    """Divide lines in order among `count` boards, or raise a BuildError. The first boards may have one line more."""
    if not 1 <= count <= lines:
        raise BuildError(
            f"{lines} lines cannot be divided among {count} boards: expected 1 to {lines} partitions"
        )
    shorter, longer = divmod(lines, count)
    return tuple(
        LineBlock(board * shorter + min(board, longer), shorter + (board < longer)) for board in range(count)
    )


def split(machine: BM1Machine, count: int) -> tuple[BM1Machine, ...]:
    """Divide a machine among `count` boards, and return each board's machine.

    Raises a BuildError if the machine has fewer than `count` lines.
    """
    return tuple(
        BM1Machine(
            replace(machine.parameters, lines=block.lines),
            np.ascontiguousarray(machine.prior[:, block.offset : block.end]),
            tuple(np.ascontiguousarray(table[:, block.offset : block.end]) for table in machine.tables),
            machine.rng_table,
        )
        for block in partition_lines(machine.parameters.lines, count)
    )


_MOST_SEEDS: Final = 1 << 23
"""Maximum number of seeds on a board, because more would need gigabytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardLayout:
    """The lines of each board, and the size of the register interface. The size is the same for all boards."""

    blocks: tuple[LineBlock, ...]
    """The block of lines of each board. No block is larger than the first."""
    interface: tuple[int, int]
    """Numbers of input words and of result words in a board's registers."""
    reason: str
    """The reason for the size of the interface, as a clause."""


def board_layout(
    parameters: BM1Parameters, partitions: int, interface: tuple[int, int] | None
) -> BoardLayout:
    """Return the layout of a machine's boards, before any table is computed.

    Without an `interface`, the registers have as many inputs and results as the largest board needs, because every word
    takes resources. The interface of the thesis's example has 20 x 1200 words (3.2).

    Raises:
        BuildError: There are more boards than lines, or too many seeds, or the sizes do not fit. A board must fit the
            interface, and the interface must fit the register map.
    """
    blocks = partition_lines(parameters.lines, partitions)
    board = replace(parameters, lines=blocks[0].lines)
    check_seeds(board, "" if board.shared else ", or --shared")
    used = BM1.registers(board)
    what = f"{board.sensors} known variables and {board.lines} lines on it"
    if board.replicas > 1:
        what += f", {board.replicas} times"
    return fitted_layout(blocks, used, interface, what, _advice(parameters, used))


def fitted_layout(
    blocks: tuple[LineBlock, ...],
    used: UsedRegisters,
    asked: tuple[int, int] | None,
    what: str,
    advice: str = "",
) -> BoardLayout:
    """Return the layout of the boards. All boards have an equally large interface.

    `blocks` has the lines of each board. `used` are the registers that the largest board needs. `asked` is the size of
    the interface of every board: the numbers of input words and result words. If `asked` is None, the interface is as
    large as `used` requires.

    Raises a BuildError if `used` exceeds the interface or the register map, or if the interface exceeds the register
    map. `what` describes the largest board in the error. If `used` exceeds the register map, the error ends with
    `advice`.
    """
    needed, room = (used.input_words, used.result_words), interface_room(used)
    sentence = f"a board needs {counted(needed[0], 'input')} and {counted(needed[1], 'result')} ({what})"
    if not _is_within(needed, room):
        raise BuildError(f"{sentence}, but the register map has room for {room[0]} and {room[1]}{advice}")
    if asked is None:
        fitted = max(needed[0], 1), needed[1]  # an interface has at least one input
        return BoardLayout(blocks=blocks, interface=fitted, reason=", which is the size of the largest board")
    if not _is_within(asked, room):
        raise BuildError(
            f"the interface {size_text(asked)} is larger than the register map's {size_text(room)}"
        )
    if not _is_within(needed, asked):
        enough = (max(needed[0], asked[0]), max(needed[1], asked[1]))
        raise BuildError(
            f"the model is larger than the interface {size_text(asked)}: {sentence}; use --interface {size_text(enough)} or leave it out"
        )
    return BoardLayout(blocks=blocks, interface=asked, reason=", as asked for")


def size_text(size: tuple[int, int]) -> str:
    """Return the size of an interface as text, for example `20x1200`."""
    return f"{size[0]}x{size[1]}"


def _is_within(needed: tuple[int, int], room: tuple[int, int]) -> bool:
    return needed[0] <= room[0] and needed[1] <= room[1]


def _advice(parameters: BM1Parameters, used: UsedRegisters) -> str:
    """Return advice on fitting the register map, beginning with a colon; empty if there is none."""
    room = interface_room(used)
    lines = room[1] // parameters.replicas
    if parameters.sensor_mode is not SensorMode.COLUMN and parameters.sensors:
        lines = min(lines, room[0] // (parameters.replicas * parameters.sensors))
    elif parameters.sensors * parameters.replicas > room[0]:
        lines = 0
    ways = [f"--partitions {-(-parameters.lines // lines)} or more"] if lines else []
    words = zip((used.input_words, used.result_words), room, strict=True)
    most = min(place * used.replicas // needed for needed, place in words if needed)
    ways += [f"--replicas {most} or fewer"] if 0 < most < used.replicas else []
    return f": use {', or '.join(ways)}" if ways else ""


def check_seeds(board: BM1Parameters | BM2Parameters, advice: str = "") -> None:
    """Raise a BuildError if a board has too many seeds. The error ends with `advice`."""
    generators = math.prod(board.generator_shape)
    seeds = board.rng_banks * generators
    if seeds > _MOST_SEEDS and board.rng is not RngKind.IDEAL:
        raise BuildError(
            f"--rng-banks {board.rng_banks} needs {seeds} seeds per board; use at most {_MOST_SEEDS // generators}"
            + advice
        )
