"""The options of a build. A model and these options determine the whole deployment (thesis 3.2, 3.4)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import typer
from pydantic import ValidationError

from machines.errors import ParameterError
from machines.parameters import REPLICAS_MAX, PriorMode, RngKind, RngReset, SampleEvery, SensorMode, Sequencer
from toolchain.building.sources import SourcesFile
from toolchain.deployment import ModelSection, Output, Queue, Scale, Source, Stop, WrittenPrior
from toolchain.errors import BuildError
from toolchain.flags import MAX_CYCLES, STOP, Partitions, StopWhen

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


_FLAGS: Final = {"tolerance_s": "--tolerance", "path": "--prior-path", "shared": "--per-cell"}
"""The flag of each field whose flag has another name than the field."""


URI: Final = typer.Option(help="rosbridge server of the readings.", metavar="ws://HOST:PORT|robot:NAME")
TOPIC: Final = typer.Option(help="Topic of the readings.", metavar="TOPIC")
TYPE: Final = typer.Option(help="Type of the topic.", metavar="PACKAGE/NAME")
OUTPUT: Final = typer.Option(help="Topic of the posteriors.", metavar="TOPIC")
ORDER: Final = typer.Option(help="The sensors that columns 1 to N read, in this order.", metavar="A,B,C")
PATH: Final = typer.Option(help="Path of a variable in the message; repeatable.", metavar="NAME=PATH")
QUEUE: Final = typer.Option(help="If readings arrive too fast: keep only the latest, or all in order.")
TOLERANCE: Final = typer.Option(
    "--tolerance",
    help="Seconds within which readings from several topics belong together.",
    metavar="SECONDS",
)
TARGET_COUNT: Final = typer.Option(
    "--target-count",
    "--samples",
    help="Count that stops a BM1, or samples of a BM2.",
    show_default="the counters' maximum; BM2: 10000",
)


@dataclass(frozen=True, kw_only=True)
class TargetOptions:
    """The flags of a build that say where readings come from and where posteriors go."""

    uri: Annotated[str, URI] = ""
    topic: Annotated[str, TOPIC] = ""
    type: Annotated[str, TYPE] = ""
    output: Annotated[str, OUTPUT] = "/BMresults"
    order: Annotated[str | None, ORDER] = None
    path: Annotated[list[str] | None, PATH] = None
    prior_path: Annotated[
        str | None, typer.Option(help="Path of a written prior in the message.", metavar="PATH")
    ] = None
    queue: Annotated[Queue, QUEUE] = Queue.LATEST
    tolerance_s: Annotated[float, TOLERANCE] = 0.05


@dataclass(frozen=True, kw_only=True)
class DeploymentEdits:
    """The flags of `toolchain regenerate deployment`, which edit `deployment.toml`. None leaves a key unchanged."""

    uri: Annotated[str | None, URI] = None
    topic: Annotated[str | None, TOPIC] = None
    type: Annotated[str | None, TYPE] = None
    output: Annotated[str | None, OUTPUT] = None
    order: Annotated[str | None, ORDER] = None
    path: Annotated[list[str] | None, PATH] = None
    target_count: Annotated[int | None, TARGET_COUNT] = None
    max_cycles: Annotated[int | None, MAX_CYCLES] = None
    stop: Annotated[Stop | None, STOP] = None
    queue: Annotated[Queue | None, QUEUE] = None
    tolerance_s: Annotated[float | None, TOLERANCE] = None


THESIS: Final = {
    "stop": "own",
    "rng_reset": "free",
    "steps_per_clock": 1,
    "interface": "20x1200",
    "partitions": 4,
    "sequencer": "linear",
    "literal": True,
    # `toolchain explore` has a list of steps
    "steps": "1",
}
"""The defaults that `--thesis` gives to other flags, for the machine of the thesis. A command may lack some flags."""


def _use_thesis(context: typer.Context, value: bool) -> bool:
    """Replace the defaults of the other flags by `THESIS`; a flag that the command line also has overrides this."""
    if value:
        context.default_map = {**THESIS, **(context.default_map or {})}
    return value


Thesis: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--thesis",
        help="The machine of the thesis: --stop own, --rng-reset free, one step per clock, --interface 20x1200, "
        "--partitions 4; BM2: --literal, --sequencer linear. A flag given beside it wins.",
        is_eager=True,
        callback=_use_thesis,
    ),
]


class MachineChoice(StrEnum):
    """The values of `--machine`: the kind of machine to build for a model."""

    AUTO = "auto"
    """A BM1 if the known variables are independent given the searched variables, otherwise a BM2."""
    BM1 = "bm1"
    BM2 = "bm2"


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """The flags of a build that both kinds of machine have. None stands for the default of the chosen kind."""

    machine: Annotated[
        MachineChoice,
        typer.Option(
            help="auto: a BM1 if the known variables are independent given the searched ones, or a BM2."
        ),
    ] = MachineChoice.AUTO
    thesis: Thesis = False
    partitions: Partitions = 1
    prob_bits: Annotated[
        int | None, typer.Option(help="Bits of a code.", min=1, max=16, show_default="8; BM2, filter: 16")
    ] = None
    target_count: Annotated[int | None, TARGET_COUNT] = None
    max_cycles: Annotated[
        int | None, typer.Option(help="Maximum number of cycles.", show_default="131072; BM2: 2^28 or more")
    ] = None
    rng: Annotated[
        RngKind,
        typer.Option(
            help="Generators: lfsr8, lfsr16, lfsr24 or lfsr32; table: of random numbers; ideal: only in emulation.",
            metavar="KIND",
        ),
    ] = RngKind.LFSR32
    rng_banks: Annotated[int, typer.Option(help="Number of seed sets, used in turn.")] = 16
    rng_reset: Annotated[
        RngReset,
        typer.Option(help="bank: each frame restarts the generators; free: never, as in the thesis."),
    ] = RngReset.BANK
    steps_per_clock: Annotated[
        int, typer.Option(help="Steps of a generator per cycle; 0: as many as are needed for fresh bits.")
    ] = 0


FILL: Final = 0
"""The number that `--replicas fill` means: a board gets as many replicas as fit its FPGA."""


def replica_count(text: str) -> int:
    """Return the number in the value of `--replicas`, or FILL for `fill`.

    If the flag is not given, Click passes the default, which is an int instead of a text.
    """
    if text == "fill":
        return FILL
    if re.fullmatch(r"\d{1,3}", str(text), re.ASCII) and 1 <= int(text) <= REPLICAS_MAX:
        return int(text)
    raise typer.BadParameter(f"{text} is not in the range 1 to {REPLICAS_MAX}, nor fill")


@dataclass(frozen=True, kw_only=True)
class BM1Options:
    """The flags of a build that only a BM1 has. Flags that name a file or need parsing are not included."""

    scale: Annotated[
        Scale | None,
        typer.Option(
            help="Part of a table that is divided by its maximum before quantising.",
            show_default="address; column if cells have their own readings",
        ),
    ] = None
    prior_mode: Annotated[
        PriorMode | None,
        typer.Option(
            help="table: the prior is in the images; written: the host writes it.",
            show_default="table; written for a filter",
        ),
    ] = None
    counter_bits: Annotated[int, typer.Option(help="Bits of a line's counter.", min=1, max=32)] = 8
    stop: StopWhen = Stop.SLICES
    shared: Annotated[
        bool, typer.Option("--shared/--per-cell", help="One generator per column, or one per cell.")
    ] = True
    sensor_mode: Annotated[
        SensorMode,
        typer.Option(
            help="Input of a cell: its column's reading, its own reading (cell), or its probability (threshold)."
        ),
    ] = SensorMode.COLUMN
    replicas: Annotated[
        int,
        typer.Option(
            parser=replica_count,
            help="Number of machines on each board, which share the generators; fill: as many as fit the --device.",
            metavar="N|fill",
        ),
    ] = 1


@dataclass(frozen=True, kw_only=True)
class BM2Options:
    """The flags of a build that only a BM2 has."""

    sequencer: Annotated[Sequencer, typer.Option(help="Order in which a BM2 samples the bits.")] = (
        Sequencer.LINEAR
    )
    literal: Annotated[
        bool,
        typer.Option(
            "--literal/--no-literal", help="All CDEs of a BM2 must agree, also those without the bit."
        ),
    ] = False
    sample_every: Annotated[SampleEvery, typer.Option(help="A sample of a BM2 after each sweep or move.")] = (
        SampleEvery.SWEEP
    )
    burn_in: Annotated[int, typer.Option(help="Sweeps of a BM2 before its first sample.", min=0)] = 1000
    ops_timeout: Annotated[int, typer.Option(help="Maximum number of cycles of a BM2's move.", min=1)] = 2**20
    stream: Annotated[
        int, typer.Option(help="Samples in the buffer of a BM2's board for /bm/samples; 0: none.", min=0)
    ] = 0


def given_flags(options: CommonOptions, group: type[BM1Options | BM2Options]) -> list[str]:
    """Return the flags in `group` with a value that is neither the default nor the value that `--thesis` sets."""
    preset = THESIS if options.thesis else {}
    return [
        _flag(each.name)
        for each in fields(group)
        if getattr(options, each.name) not in (each.default, preset.get(each.name, each.default))
    ]


@dataclass(frozen=True, kw_only=True)
class MachineOptions(BM2Options, BM1Options, CommonOptions):
    """All flags of a build that describe the machine, except flags that name a file or need parsing."""


@dataclass(frozen=True, kw_only=True)
class BuildOptions(MachineOptions, TargetOptions):
    """The options of a build: the values of its flags, and the contents of the files that flags name."""

    # defaults for a machine that no robot uses, such as one that is only checked or analysed
    uri: str = "ws://127.0.0.1:9090"
    topic: str = "/readings"
    type: str = "std_msgs/Float64MultiArray"
    interface: tuple[int, int] | None = None
    """Numbers of input words and result words of a board's registers. None selects what the largest board needs."""
    rng_table: NDArray[np.uint32] | None = None
    """The random numbers for `rng = table`: uint32[length]. If None, the build generates random numbers."""
    sources: SourcesFile | None = None
    """The content of the file given by `--sources`, or None. The file replaces `uri`, `topic` and `type`."""
    model_flags: ModelSection = field(default_factory=ModelSection)
    """The flags with which the model was read. They become the section `[model]` of the deployment."""
    build_date: str = ""
    """The date of the build in ISO 8601, for the manifests of images. It does not influence the images' hashes."""

    def __post_init__(self) -> None:
        """Refuse a malformed server, topic, type or path before a model is read."""
        try:
            self.all_sources, Output(topic=self.output), self.written_prior
        except ValidationError as reason:
            raise refused_option(reason) from None

    @property
    def scaling(self) -> Scale:
        """The part of a table that is divided by its maximum: `scale` or, if `scale` is None, the default."""
        if self.scale is not None:
            return self.scale
        return Scale.ADDRESS if self.sensor_mode is SensorMode.COLUMN else Scale.COLUMN

    @property
    def all_sources(self) -> tuple[Source, ...]:
        """The sources of readings: those of the sources file, or one made from `uri`, `topic` and `type`."""
        if self.sources is not None:
            return self.sources.sources
        return (Source(uri=self.uri, topic=self.topic, type=self.type),)

    @property
    def written_prior(self) -> WrittenPrior | None:
        """The source and the path of the prior that the host writes, or None if the host writes no prior."""
        if self.sources is not None:
            return self.sources.prior
        return None if self.prior_path is None else WrittenPrior(path=self.prior_path)


def refused_parameter(reason: ParameterError) -> BuildError:
    """Convert an error about parameters to a BuildError that names flags instead of parameters."""
    keys = "|".join(each.name for each in fields(MachineOptions))
    named = re.sub(rf"\b({keys})(?= is | = )", lambda found: _flag(found[1]), str(reason).rstrip("."))
    return BuildError(named.replace(" = true", "").replace(" = ", " "))


def _flag(key: str) -> str:
    return _FLAGS.get(key, "--" + key.replace("_", "-"))


def refused_option(reason: ValidationError) -> BuildError:
    """Convert pydantic's error about an option to a BuildError that names the flag instead of the field."""
    detail = reason.errors(include_url=False)[0]
    key = str(detail["loc"][0]) if detail["loc"] else ""
    flag = {
        "Output": "--output",
        "Variable": "--path",
        "BM2Section": _flag(key).replace("--target-count", "--samples"),
    }.get(reason.title, _flag(key))
    if detail["type"] == "value_error":
        sentence = str(detail["ctx"]["error"])
        return BuildError(f"{flag}: {sentence}" if key else sentence)
    return BuildError(
        f"{flag} is {detail['input']!r}, expected {detail['msg'].removeprefix('Input should be ')}"
    )
