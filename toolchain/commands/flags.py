"""Flags shared by several subcommands, as dataclasses that are parameters of commands (thesis 3.4)."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias, get_type_hints

import typer

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from terminal.command_line import CommandLine
from terminal.flags import Group, expanded
from toolchain.building.options import OnMissing
from toolchain.deployment import Scale, Stop

Bits: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        help="Address bits of a variable's column, or of the prior it selects; repeatable.",
        show_default="the model's",
        metavar="NAME=BITS",
    ),
]
MaxCycles: TypeAlias = Annotated[int, typer.Option(help="Maximum number of cycles.")]
ModelPath: TypeAlias = Annotated[
    Path,
    typer.Argument(
        help="Folder with model.py, or a network file: .bif, .xmlbif, .uai, .net, .xdsl (.gz).",
        metavar="MODEL",
    ),
]
Partitions: TypeAlias = Annotated[int, typer.Option(help="Number of boards.")]
ReadingColumns: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        help="Column of a known variable's readings; * stands for the same text in both; repeatable.",
        show_default="its name",
        metavar="NAME=COLUMN",
    ),
]
Settings: TypeAlias = Annotated[
    list[str] | None, typer.Option("--set", help="A parameter of the model; repeatable.", metavar="KEY=VALUE")
]
StopWhen: TypeAlias = Annotated[
    Stop,
    typer.Option(help="slices: all boards shortly after the first overflow; own: each at its own overflow."),
]
TargetCount: TypeAlias = Annotated[
    int | None, typer.Option(help="Count that stops a machine.", show_default="the counters' maximum")
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFlags:
    """Flags for reading a model: parameters of model.py, or variables of a network."""

    settings: Settings = None
    searched: Annotated[str, typer.Option(help="Searched variables.", metavar="A,B")] = ""
    known: Annotated[
        str, typer.Option(help="Variables with readings, in the order of the columns.", metavar="A,B")
    ] = ""
    given: Annotated[
        list[str] | None,
        typer.Option(help="A variable with a fixed state; repeatable.", metavar="NAME=STATE"),
    ] = None
    prior_select: Annotated[
        str, typer.Option(help="Variable whose readings select the prior.", metavar="NAME")
    ] = ""
    on_missing: Annotated[OnMissing, typer.Option(help="Meaning of an absent reading.")] = OnMissing.ERROR

    @property
    def question(self) -> list[str]:
        """The given flags that are only for networks."""
        values = {
            "--searched": self.searched,
            "--known": self.known,
            "--given": self.given,
            "--prior-select": self.prior_select,
            "--on-missing": self.on_missing is not OnMissing.ERROR,
        }
        return [flag for flag, value in values.items() if value]


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildFlags(ModelFlags):
    """Flags for building a machine from a model."""

    partitions: Partitions = 1
    device: Annotated[
        str | None,
        typer.Option(
            help="FPGA of a board: the build uses as many boards as the lines need, and gives the reason.",
            metavar="proce-v-d8",
        ),
    ] = None
    interface: Annotated[
        str | None,
        typer.Option(
            help="Inputs x results of a board's registers.",
            show_default="20x1200, or the model's size if larger",
            metavar="INPUTSxRESULTS",
        ),
    ] = None
    scale: Annotated[
        Scale | None,
        typer.Option(
            help="Part of a table that is divided by its maximum before quantising.",
            show_default="address; column if cells have their own readings",
        ),
    ] = None
    prob_bits: Annotated[int, typer.Option(help="Bits of a code.", min=1, max=16)] = 8
    bits: Bits = None
    prior_mode: Annotated[
        PriorMode, typer.Option(help="table: the prior is in the images; written: the host writes it.")
    ] = PriorMode.TABLE
    counter_bits: Annotated[int, typer.Option(help="Bits of a line's counter.", min=1, max=32)] = 8
    target_count: TargetCount = None
    max_cycles: MaxCycles = 2**17
    stop: StopWhen = Stop.SLICES
    rng: Annotated[
        RngKind,
        typer.Option(
            help="Generators: lfsr8, lfsr16, lfsr24 or lfsr32; table: of random numbers; ideal: only in emulation.",
            metavar="KIND",
        ),
    ] = RngKind.LFSR32
    rng_table: Annotated[
        Path | None,
        typer.Option(
            help="With --rng table: the random numbers; without it, they are generated.", metavar="MIF"
        ),
    ] = None
    rng_banks: Annotated[int, typer.Option(help="Number of seed sets, used in turn.")] = 16
    rng_reset: Annotated[
        RngReset,
        typer.Option(help="bank: each frame restarts the generators; free: never, as in the thesis."),
    ] = RngReset.BANK
    shared: Annotated[
        bool, typer.Option("--shared/--per-cell", help="One generator per column, or one per cell.")
    ] = True
    steps_per_clock: Annotated[
        int,
        typer.Option(
            help="Steps of a generator per cycle; 1 as in the thesis; 0: as many as are needed for fresh bits."
        ),
    ] = 0
    sensor_mode: Annotated[
        SensorMode,
        typer.Option(
            help="Input of a cell: its column's reading, its own reading (cell), or its probability (threshold)."
        ),
    ] = SensorMode.COLUMN
    replicas: Annotated[
        int,
        typer.Option(help="Number of machines on each board, which share the generators.", min=1, max=256),
    ] = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingFlags:
    """Flags for the readings of a machine."""

    readings: Annotated[
        Path | None,
        typer.Option(
            help="Recorded readings: CSV, MCAP or bag; without it, readings are drawn.", metavar="RECORDING"
        ),
    ] = None
    reading: ReadingColumns = None
    seed: Annotated[int, typer.Option(help="Seed of drawn readings.", min=0)] = 1
    device: Annotated[str, typer.Option(help="FPGA of the boards.", metavar="proce-v-d8")] = "proce-v-d8"


def add_commands(app: CommandLine, *commands: Callable[..., None]) -> None:
    """Add functions to a command line, each under its own name."""
    for command in commands:
        app.command()(expand_flags(command))


def expand_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the dataclass parameters of a command by one flag per field, each of which has a default."""
    kinds = {
        name: each.annotation for name, each in inspect.signature(command, eval_str=True).parameters.items()
    }
    return expanded(command, {name: _group(kind) for name, kind in kinds.items() if is_dataclass(kind)})


def _group(kind: Any) -> Group:
    hints = get_type_hints(kind, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    flags = [
        inspect.Parameter(each.name, keyword, default=each.default, annotation=hints[each.name])
        for each in fields(kind)
    ]
    return Group(flags, kind)
