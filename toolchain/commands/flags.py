"""Flags that several subcommands have: a question to a network, and how a model becomes a machine (thesis 3.4)."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from toolchain.deployment import Stop
from toolchain.options import OnMissing, Scale

ModelPath: TypeAlias = Annotated[
    Path,
    typer.Argument(
        help="Folder that holds model.py, or a network: .bif, .xmlbif, .uai, .net.", metavar="MODEL"
    ),
]
Settings: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="A parameter of the model; repeat for more.", metavar="KEY=VALUE"),
]
Searched: TypeAlias = Annotated[
    str, typer.Option(help="Of a network: the variables that are searched, A,B.", metavar="NAMES")
]
KnownNames: TypeAlias = Annotated[
    str, typer.Option(help="Of a network: those with readings, in the order of the columns.", metavar="NAMES")
]
Given: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(help="Of a network: what always has this state; repeat for more.", metavar="NAME=STATE"),
]
PriorSelectName: TypeAlias = Annotated[
    str, typer.Option(help="Of a network: the variable with readings that selects the prior.", metavar="NAME")
]
OnMissingFlag: TypeAlias = Annotated[OnMissing, typer.Option(help="Of a network: what an absent reading is.")]
ReadingColumns: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        help="Where a known variable's readings are; * stands for the same in both. Default: its name.",
        metavar="NAME=COLUMN",
    ),
]

Partitions: TypeAlias = Annotated[int, typer.Option(help="Boards to split the lines over.")]
DeviceFlag: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="What a board has, proce-v-d8: as many boards are taken as the lines need, and it says why.",
        metavar="NAME",
    ),
]
Interface: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Inputs x results of a board's registers; default 20x1200, or the model's size if larger.",
        metavar="INPUTSxRESULTS",
    ),
]
ScaleFlag: TypeAlias = Annotated[
    Scale | None,
    typer.Option(
        help="What is divided by its maximum before quantising; default address, column where cells have readings of their own."
    ),
]
ProbBits: TypeAlias = Annotated[int, typer.Option(help="Bits of a code, 1 to 16.")]
Bits: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        help="Address bits of a variable's column, or of the prior it selects; default the model's; repeat for more.",
        metavar="NAME=BITS",
    ),
]
PriorModeFlag: TypeAlias = Annotated[
    PriorMode, typer.Option(help="table: the prior is in the images; written: the host writes it.")
]
CounterBits: TypeAlias = Annotated[int, typer.Option(help="Bits of a line's counter, 1 to 32.")]
TargetCount: TypeAlias = Annotated[
    int | None, typer.Option(help="Count that stops a machine; default the counters' largest.")
]
MaxCycles: TypeAlias = Annotated[int, typer.Option(help="Cycles after which a machine stops anyway.")]
StopFlag: TypeAlias = Annotated[
    Stop, typer.Option(help="slices: all boards soon after the first overflow; own: each at its own.")
]
Rng: TypeAlias = Annotated[
    RngKind,
    typer.Option(
        help="Random number generators; table: a table of random numbers; ideal exists emulated only."
    ),
]
RngTable: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        help="With --rng table: a MIF of the random numbers; without, they are made.", metavar="MIF"
    ),
]
RngBanks: TypeAlias = Annotated[int, typer.Option(help="Sets of seeds, used in turn.")]
RngResetFlag: TypeAlias = Annotated[
    RngReset, typer.Option(help="bank: a frame restarts the generators; free: never (the thesis).")
]
Shared: TypeAlias = Annotated[
    bool, typer.Option("--shared/--per-cell", help="A generator for a whole column, or one for each cell.")
]
StepsPerClock: TypeAlias = Annotated[
    int,
    typer.Option(
        help="Steps of a generator in a cycle; 1 is the thesis's. Default 0: as many as give fresh bits."
    ),
]
SensorModeFlag: TypeAlias = Annotated[
    SensorMode,
    typer.Option(
        help="What a cell is given: its column's reading, a reading of its own (cell), or its probability (threshold)."
    ),
]
Replicas: TypeAlias = Annotated[
    int, typer.Option(help="Machines on each board, around the same generators, 1 to 256.")
]
