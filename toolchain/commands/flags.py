"""Flags that several subcommands share, as dataclasses that a command takes whole (thesis 3.4)."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias, get_type_hints

import typer

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from terminal.command_line import CommandLine
from toolchain.building.options import OnMissing
from toolchain.deployment import Scale, Stop

MODEL: Final = "The model"
NETWORK: Final = "A network: what is asked"
BOARDS: Final = "Boards"
TABLES: Final = "Tables of codes"
STOPPING: Final = "Counters and stopping"
RANDOM: Final = "Random numbers"
MESSAGES: Final = "Readings and results"
"""Groups of flags in `--help`."""

Bits: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        help="Address bits of a variable's column, or of the prior it selects; repeat for more.",
        show_default="the model's",
        metavar="NAME=BITS",
        rich_help_panel=MODEL,
    ),
]
MaxCycles: TypeAlias = Annotated[
    int, typer.Option(help="Cycles after which a machine stops anyway.", rich_help_panel=STOPPING)
]
ModelPath: TypeAlias = Annotated[
    Path,
    typer.Argument(
        help="Folder that holds model.py, or a network: .bif, .xmlbif, .uai, .net.", metavar="MODEL"
    ),
]
Partitions: TypeAlias = Annotated[
    int, typer.Option(help="Boards to split the lines over.", rich_help_panel=BOARDS)
]
ReadingColumns: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        help="Where a known variable's readings are; * stands for the same in both; repeat for more.",
        show_default="its name",
        metavar="NAME=COLUMN",
    ),
]
Settings: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="A parameter of the model; repeat for more.", metavar="KEY=VALUE", rich_help_panel=MODEL
    ),
]
StopWhen: TypeAlias = Annotated[
    Stop,
    typer.Option(
        help="slices: all boards soon after the first overflow; own: each at its own.",
        rich_help_panel=STOPPING,
    ),
]
TargetCount: TypeAlias = Annotated[
    int | None,
    typer.Option(
        help="Count that stops a machine.", show_default="the counters' largest", rich_help_panel=STOPPING
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFlags:
    """Flags for reading a model: a case study's parameters, or the question to a network."""

    settings: Settings = None
    searched: Annotated[
        str, typer.Option(help="The variables that are searched.", metavar="A,B", rich_help_panel=NETWORK)
    ] = ""
    known: Annotated[
        str,
        typer.Option(
            help="Those with readings, in the order of the columns.", metavar="A,B", rich_help_panel=NETWORK
        ),
    ] = ""
    given: Annotated[
        list[str] | None,
        typer.Option(
            help="What always has this state; repeat for more.", metavar="NAME=STATE", rich_help_panel=NETWORK
        ),
    ] = None
    prior_select: Annotated[
        str,
        typer.Option(
            help="The variable with readings that selects the prior.", metavar="NAME", rich_help_panel=NETWORK
        ),
    ] = ""
    on_missing: Annotated[
        OnMissing, typer.Option(help="What an absent reading is.", rich_help_panel=NETWORK)
    ] = OnMissing.ERROR

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
            help="What a board has: as many boards are taken as the lines need, and it says why.",
            metavar="proce-v-d8",
            rich_help_panel=BOARDS,
        ),
    ] = None
    interface: Annotated[
        str | None,
        typer.Option(
            help="Inputs x results of a board's registers.",
            show_default="20x1200, or the model's size if larger",
            metavar="INPUTSxRESULTS",
            rich_help_panel=BOARDS,
        ),
    ] = None
    scale: Annotated[
        Scale | None,
        typer.Option(
            help="What is divided by its maximum before quantising.",
            show_default="address; column where cells have readings of their own",
            rich_help_panel=TABLES,
        ),
    ] = None
    prob_bits: Annotated[int, typer.Option(help="Bits of a code, 1 to 16.", rich_help_panel=TABLES)] = 8
    bits: Bits = None
    prior_mode: Annotated[
        PriorMode,
        typer.Option(
            help="table: the prior is in the images; written: the host writes it.", rich_help_panel=TABLES
        ),
    ] = PriorMode.TABLE
    counter_bits: Annotated[
        int, typer.Option(help="Bits of a line's counter, 1 to 32.", rich_help_panel=STOPPING)
    ] = 8
    target_count: TargetCount = None
    max_cycles: MaxCycles = 2**17
    stop: StopWhen = Stop.SLICES
    rng: Annotated[
        RngKind,
        typer.Option(
            help="Generators: lfsr8, lfsr16, lfsr24 or lfsr32; table: of random numbers; ideal: emulated only.",
            metavar="KIND",
            rich_help_panel=RANDOM,
        ),
    ] = RngKind.LFSR32
    rng_table: Annotated[
        Path | None,
        typer.Option(
            help="With --rng table: the random numbers; without, they are made.",
            metavar="MIF",
            rich_help_panel=RANDOM,
        ),
    ] = None
    rng_banks: Annotated[int, typer.Option(help="Sets of seeds, used in turn.", rich_help_panel=RANDOM)] = 16
    rng_reset: Annotated[
        RngReset,
        typer.Option(
            help="bank: a frame restarts the generators; free: never (the thesis).", rich_help_panel=RANDOM
        ),
    ] = RngReset.BANK
    shared: Annotated[
        bool,
        typer.Option(
            "--shared/--per-cell",
            help="A generator for a whole column, or one for each cell.",
            rich_help_panel=RANDOM,
        ),
    ] = True
    steps_per_clock: Annotated[
        int,
        typer.Option(
            help="Steps of a generator in a cycle; 1 is the thesis's; 0: as many as give fresh bits.",
            rich_help_panel=RANDOM,
        ),
    ] = 0
    sensor_mode: Annotated[
        SensorMode,
        typer.Option(
            help="What a cell is given: its column's reading, one of its own (cell), or its probability (threshold).",
            rich_help_panel=TABLES,
        ),
    ] = SensorMode.COLUMN
    replicas: Annotated[
        int,
        typer.Option(
            help="Machines on each board, around the same generators, 1 to 256.", rich_help_panel=BOARDS
        ),
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
    device: Annotated[str, typer.Option(help="What the boards have.", metavar="proce-v-d8")] = "proce-v-d8"


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
