"""The options of a build, which are everything except the model (thesis 3.2, 3.4), and the file of `--sources`."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import typer
from pydantic import Field, ValidationError

from machines.errors import ParameterError
from machines.parameters import REPLICAS_MAX, PriorMode, RngKind, RngReset, SampleEvery, SensorMode, Sequencer
from toolchain.bounded_files import TomlFile, nearest_name
from toolchain.deployment import ModelSection, Output, Queue, Scale, Source, Stop, Variable, WrittenPrior
from toolchain.deployment.sections import MessagePath, Name, Section, Sequence
from toolchain.errors import BuildError, ToolchainError
from toolchain.flags import MAX_CYCLES, STOP, Partitions, StopWhen, key_values, names_in

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


MOST_SOURCES: Final = 256


class SourceTable(Source):
    """A `[[source]]` of a sources file with its variables; without a `uri`, that of `--uri` is used."""

    variables: dict[Name, MessagePath] | None = None
    """Paths in the message by variable; None for all variables that no other source has."""
    prior: MessagePath | None = None
    """The path of a written prior in the message, or None."""


class SourcesTables(Section):
    """A sources file."""

    sources: Sequence[SourceTable] = Field(validation_alias="source", min_length=1, max_length=MOST_SOURCES)


@dataclass(frozen=True, slots=True)
class SourcesFile:
    """The content of a sources file."""

    toml: TomlFile
    """The file."""
    tables: tuple[SourceTable, ...]
    """Its tables."""

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources, as in a deployment."""
        return tuple(
            Source(**{key: getattr(table, key) for key in Source.model_fields}) for table in self.tables
        )

    @property
    def prior(self) -> WrittenPrior | None:
        """The source of a written prior, or None."""
        return next(
            (
                WrittenPrior(source=at, path=table.prior)
                for at, table in enumerate(self.tables)
                if table.prior is not None
            ),
            None,
        )

    def place(self, variables: tuple[Variable, ...]) -> tuple[Variable, ...]:
        """Return the variables of a model with sources and paths, or raise a BuildError if they don't match."""
        places: dict[str, tuple[int, str]] = {}
        names = [variable.name for variable in variables]
        for at, table in enumerate(self.tables):
            for name, path in (table.variables or {}).items():
                if name not in names:
                    raise self._refused(
                        at, f"the model has no variable '{name}'; {nearest_name(name, names)}"
                    )
                if name in places:
                    raise self._refused(at, f"{name} already comes from source {places[name][0] + 1}")
                places[name] = at, path
        rest = next((at for at, table in enumerate(self.tables) if table.variables is None), None)
        left = [name for name in names if name not in places]
        if left and rest is None:
            raise BuildError(
                f"no source has {', '.join(left)}; add them to the variables of a source, or omit 'variables' in "
                "one, which then has all others",
                path=self.toml.path,
            )
        if not left and rest is not None and self.tables[rest].prior is None:
            raise self._refused(rest, "the other sources have all variables; nothing is left for this one")
        return tuple(
            variable.replace(source=places[variable.name][0], path=places[variable.name][1])
            if variable.name in places
            else variable.replace(source=rest)
            for variable in variables
        )

    def check(self) -> None:
        """Raise a BuildError for mistakes that can be found without a model."""
        seen: dict[tuple[str, str], int] = {}
        priors = [at for at, table in enumerate(self.tables) if table.prior is not None]
        rests = [at for at, table in enumerate(self.tables) if table.variables is None]
        for at, table in enumerate(self.tables):
            if not table.variables and table.prior is None and at not in rests:
                raise self._refused(at, "it has neither variables nor a prior")
            first = seen.setdefault((table.uri, table.topic), at)
            if first != at:
                why = f"source {first + 1} is the same topic of the same server: merge their variables"
                raise self._refused(at, why, "topic")
        if len(rests) > 1:
            why = f"source {rests[0] + 1} has no 'variables' either; only one can have all that no other has"
            raise self._refused(rests[1], why, "topic")
        if len(priors) > 1:
            raise self._refused(priors[1], f"source {priors[0] + 1} already has the prior", "prior")

    def _refused(self, at: int, why: str, key: str = "variables") -> ToolchainError:
        return self.toml.mistake(("source", at, key), f"in [[source]] {at + 1}: {why}")


def read_sources(path: Path, uri: str | None) -> SourcesFile:
    """Read a sources file, or raise a BuildError with the line; `uri` is the server of sources that name none."""
    toml = TomlFile.read(path, BuildError)
    tables = toml.tables.get("source")
    for at, table in enumerate(tables if isinstance(tables, list) else ()):
        if uri is not None and isinstance(table, dict):
            table.setdefault("uri", uri)
        elif isinstance(table, dict) and "uri" not in table:
            raise toml.mistake(
                ("source", at, "topic"), f"[[source]] {at + 1} has no uri, and no --uri was given"
            )
    file = SourcesFile(toml, toml.validated(SourcesTables).sources)
    file.check()
    return file


def placed(
    variables: tuple[Variable, ...], order: str | None, path: list[str] | None
) -> tuple[Variable, ...]:
    """Return variables with `--order` and `--path`, or raise a BuildError.

    With an order, a column keeps its table and its conversion to addresses; its name, source and path change.
    """
    columns = {variable.name: variable for variable in variables if variable.kind == "sensor"}
    names = names_in("--order", order or "") or list(columns)
    if unknown := next((name for name in names if name not in columns), None):
        raise BuildError(
            f"--order {order}: there is no sensor '{unknown}'; {nearest_name(unknown, list(columns))}"
        )
    if sorted(names) != sorted(columns):
        raise BuildError(
            f"--order {order}: expected each of {', '.join(columns)} once, in the order of the columns"
        )
    readings = dict(zip(columns, (columns[name] for name in names), strict=True))
    paths, known = key_values(path or (), "--path", "range=data[0]"), [each.name for each in variables]
    if unknown := next((name for name in paths if name not in known), None):
        raise BuildError(
            f"--path {unknown}={paths[unknown]}: there is no variable '{unknown}'; {nearest_name(unknown, known)}"
        )
    found = []
    for variable in variables:
        reading, table = readings.get(variable.name, variable), variable.table_of or variable.name
        found.append(
            variable.replace(
                name=reading.name,
                source=reading.source,
                path=paths.get(reading.name, reading.path),
                table_of=None if table == reading.name else table,
            )
        )
    return tuple(found)


_FLAGS: Final = {"tolerance_s": "--tolerance", "path": "--prior-path", "shared": "--per-cell"}
"""Flags with other names than their fields."""


class OnMissing(StrEnum):
    """The meaning of an absent reading."""

    ERROR = "error"
    """An error: every frame has all readings."""
    MISSING = "missing"
    """A missing reading, which leaves the posterior as it is."""


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
    """The flags of a build about topics."""

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
    """Changes of `deployment.toml`, the flags of `toolchain regenerate deployment`; None leaves a key unchanged."""

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
"""The defaults of `--thesis`: the machine of the thesis, as a value for each flag that a command may have."""


def _use_thesis(context: typer.Context, value: bool) -> bool:
    """Replace the defaults of the other flags, which are read later; a flag of the command line still wins."""
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
    """The machine for a model."""

    AUTO = "auto"
    """A BM1 if the question is a naive fusion, otherwise a BM2."""
    BM1 = "bm1"
    BM2 = "bm2"


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """The flags of a build about machines of every kind; None for the default of the kind."""

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
"""`--replicas fill`: the number of machines follows from the device of the boards."""


def replica_count(text: str) -> int:
    """Return the number of `--replicas`, or FILL; click also gives its default, a number."""
    if text == "fill":
        return FILL
    if re.fullmatch(r"\d{1,3}", str(text), re.ASCII) and 1 <= int(text) <= REPLICAS_MAX:
        return int(text)
    raise typer.BadParameter(f"{text} is not in the range 1 to {REPLICAS_MAX}, nor fill")


@dataclass(frozen=True, kw_only=True)
class BM1Options:
    """The flags of a build about a BM1, except those that name a file or need parsing."""

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
    """The flags of a build about a BM2."""

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
    """Return the flags of a group that do not have their defaults; `--thesis` has some for both machines."""
    preset = THESIS if options.thesis else {}
    return [
        _flag(each.name)
        for each in fields(group)
        if getattr(options, each.name) not in (each.default, preset.get(each.name, each.default))
    ]


@dataclass(frozen=True, kw_only=True)
class MachineOptions(BM2Options, BM1Options, CommonOptions):
    """The flags of a build about the machine, except those that name a file or need parsing."""


@dataclass(frozen=True, kw_only=True)
class BuildOptions(MachineOptions, TargetOptions):
    """The options of a build: the values of its flags, and the contents of files that flags name."""

    interface: tuple[int, int] | None = None
    """Inputs and results of the boards' registers; None for those that the largest board needs."""
    rng_table: NDArray[np.uint32] | None = None
    """uint32[length], the random numbers for `rng = table`; None to generate them."""
    sources: SourcesFile | None = None
    """Several topics and their variables, in place of `uri`, `topic` and `type`; or None."""
    model_flags: ModelSection = field(default_factory=ModelSection)
    """The flags with which the model was read."""
    build_date: str = ""
    """The date of the build, ISO 8601: part of the images' manifests, but not of their hashes."""

    def __post_init__(self) -> None:
        """Refuse a malformed server, topic, type or path before a model is read."""
        try:
            self.all_sources, Output(topic=self.output), self.written_prior
        except ValidationError as reason:
            raise refused_option(reason) from None

    @property
    def scaling(self) -> Scale:
        """The part of a table that is divided by its maximum: `scale`, or its default."""
        if self.scale is not None:
            return self.scale
        return Scale.ADDRESS if self.sensor_mode is SensorMode.COLUMN else Scale.COLUMN

    @property
    def all_sources(self) -> tuple[Source, ...]:
        """The sources of readings, as in a deployment."""
        if self.sources is not None:
            return self.sources.sources
        return (Source(uri=self.uri, topic=self.topic, type=self.type),)

    @property
    def written_prior(self) -> WrittenPrior | None:
        """The source of a written prior, or None."""
        if self.sources is not None:
            return self.sources.prior
        return None if self.prior_path is None else WrittenPrior(path=self.prior_path)


def refused_parameter(reason: ParameterError) -> BuildError:
    """Return the error for parameters of which there is no machine, with flags instead of keys."""
    keys = "|".join(each.name for each in fields(MachineOptions))
    named = re.sub(rf"\b({keys})(?= is | = )", lambda found: _flag(found[1]), str(reason).rstrip("."))
    return BuildError(named.replace(" = true", "").replace(" = ", " "))


def _flag(key: str) -> str:
    return _FLAGS.get(key, "--" + key.replace("_", "-"))


def refused_option(reason: ValidationError) -> BuildError:
    """Return the error for an option that pydantic refuses, with the flag of the field."""
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
