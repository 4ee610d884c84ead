"""Flags that several subcommands share, as dataclasses that a command takes whole (thesis 3.4)."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias, get_type_hints

import typer

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from terminal.command_line import CommandLine
from toolchain.building.options import OnMissing
from toolchain.deployment import Scale, Stop

Bits: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        help="Address bits of a variable's column, or of the prior it selects; default the model's; repeat for more.",
        metavar="NAME=BITS",
    ),
]
MaxCycles: TypeAlias = Annotated[int, typer.Option(help="Cycles after which a machine stops anyway.")]
ModelPath: TypeAlias = Annotated[
    Path,
    typer.Argument(
        help="Folder that holds model.py, or a network: .bif, .xmlbif, .uai, .net.", metavar="MODEL"
    ),
]
Partitions: TypeAlias = Annotated[int, typer.Option(help="Boards to split the lines over.")]
ReadingColumns: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        help="Where a known variable's readings are; * stands for the same in both. Default: its name.",
        metavar="NAME=COLUMN",
    ),
]
Settings: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="A parameter of the model; repeat for more.", metavar="KEY=VALUE"),
]
StopWhen: TypeAlias = Annotated[
    Stop, typer.Option(help="slices: all boards soon after the first overflow; own: each at its own.")
]
TargetCount: TypeAlias = Annotated[
    int | None, typer.Option(help="Count that stops a machine; default the counters' largest.")
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFlags:
    """Flags for reading a model: a case study's parameters, or the question to a network."""

    settings: Settings = None
    searched: Annotated[
        str, typer.Option(help="Of a network: the variables that are searched, A,B.", metavar="NAMES")
    ] = ""
    known: Annotated[
        str,
        typer.Option(help="Of a network: those with readings, in the order of the columns.", metavar="NAMES"),
    ] = ""
    given: Annotated[
        list[str] | None,
        typer.Option(help="Of a network: what always has this state; repeat for more.", metavar="NAME=STATE"),
    ] = None
    prior_select: Annotated[
        str,
        typer.Option(help="Of a network: the variable with readings that selects the prior.", metavar="NAME"),
    ] = ""
    on_missing: Annotated[OnMissing, typer.Option(help="Of a network: what an absent reading is.")] = (
        OnMissing.ERROR
    )

    @property
    def question(self) -> list[str]:
        """The flags with a value that only a network takes."""
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
    """Flags for turning a model into a machine."""

    partitions: Partitions = 1
    device: Annotated[
        str | None,
        typer.Option(
            help="What a board has, proce-v-d8: as many boards are taken as the lines need, and it says why.",
            metavar="NAME",
        ),
    ] = None
    interface: Annotated[
        str | None,
        typer.Option(
            help="Inputs x results of a board's registers; default 20x1200, or the model's size if larger.",
            metavar="INPUTSxRESULTS",
        ),
    ] = None
    scale: Annotated[
        Scale | None,
        typer.Option(
            help="What is divided by its maximum before quantising; default address, column where cells have readings of their own."
        ),
    ] = None
    prob_bits: Annotated[int, typer.Option(help="Bits of a code, 1 to 16.")] = 8
    bits: Bits = None
    prior_mode: Annotated[
        PriorMode, typer.Option(help="table: the prior is in the images; written: the host writes it.")
    ] = PriorMode.TABLE
    counter_bits: Annotated[int, typer.Option(help="Bits of a line's counter, 1 to 32.")] = 8
    target_count: TargetCount = None
    max_cycles: MaxCycles = 2**17
    stop: StopWhen = Stop.SLICES
    rng: Annotated[
        RngKind,
        typer.Option(
            help="Random number generators; table: a table of random numbers; ideal exists emulated only."
        ),
    ] = RngKind.LFSR32
    rng_table: Annotated[
        Path | None,
        typer.Option(
            help="With --rng table: a MIF of the random numbers; without, they are made.", metavar="MIF"
        ),
    ] = None
    rng_banks: Annotated[int, typer.Option(help="Sets of seeds, used in turn.")] = 16
    rng_reset: Annotated[
        RngReset, typer.Option(help="bank: a frame restarts the generators; free: never (the thesis).")
    ] = RngReset.BANK
    shared: Annotated[
        bool,
        typer.Option("--shared/--per-cell", help="A generator for a whole column, or one for each cell."),
    ] = True
    steps_per_clock: Annotated[
        int,
        typer.Option(
            help="Steps of a generator in a cycle; 1 is the thesis's. Default 0: as many as give fresh bits."
        ),
    ] = 0
    sensor_mode: Annotated[
        SensorMode,
        typer.Option(
            help="What a cell is given: its column's reading, a reading of its own (cell), or its probability (threshold)."
        ),
    ] = SensorMode.COLUMN
    replicas: Annotated[
        int, typer.Option(help="Machines on each board, around the same generators, 1 to 256.")
    ] = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingFlags:
    """Which readings a machine is tried on."""

    readings: Annotated[
        Path | None,
        typer.Option(help="Recorded readings: CSV, MCAP or bag; else they are drawn.", metavar="RECORDING"),
    ] = None
    reading: ReadingColumns = None
    seed: Annotated[int, typer.Option(help="Of the readings that are drawn.", min=0)] = 1
    device: Annotated[str, typer.Option(help="What the boards have: proce-v-d8.")] = "proce-v-d8"


def add_commands(app: CommandLine, *commands: Callable[..., None]) -> None:
    """Add functions to a command line, each under its own name."""
    for command in commands:
        app.command()(expand_flags(command))


def expand_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command one parameter for each field of the dataclasses that it takes.

    Typer reads a command's flags from its signature, so the signature is what is expanded. Every field of such a
    dataclass has a default.
    """
    parameters: list[inspect.Parameter] = []
    groups: dict[str, type[Any]] = {}
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        kind = parameter.annotation
        if not is_dataclass(kind):
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        groups[parameter.name] = kind  # type: ignore[assignment]  # the class, not an instance of it
        hints = get_type_hints(kind, include_extras=True)
        parameters += [
            inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=field.default,
                annotation=hints[field.name],
            )
            for field in fields(kind)
        ]

    @functools.wraps(command)
    def run(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        command(**values)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # inspect.signature() reads it
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run
