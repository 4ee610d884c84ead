"""Flags that several subcommands share, as dataclasses that a command takes whole (thesis 3.4)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
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
