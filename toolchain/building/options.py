"""The options of a build, everything except the model (thesis 3.2, 3.4), and the file of `--sources`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pydantic import Field, ValidationError

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from toolchain.bounded_files import TomlFile, nearest_name
from toolchain.deployment import Output, Queue, Scale, Source, Stop, Variable, WrittenPrior
from toolchain.deployment.sections import MessagePath, Name, Section, Sequence
from toolchain.errors import BuildError, ToolchainError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


MOST_SOURCES: Final = 256


class SourceTable(Source):
    """A `[[source]]` of a sources file, and what it has; without a `uri`, that of `--uri` is used."""

    variables: dict[Name, MessagePath] | None = None
    """The path of each variable in the message, by its name; None for all variables of no other source."""
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
    """Read a sources file; `uri` is the server of sources that name none. A BuildError names the line."""
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


_FLAGS: Final = {"tolerance_s": "--tolerance", "path": "--prior-path"}
"""Flags with other names than their fields."""


class OnMissing(StrEnum):
    """The meaning of an absent reading."""

    ERROR = "error"
    """An error: every frame has all readings."""
    MISSING = "missing"
    """A missing reading, which leaves the posterior as it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildOptions:
    """The options of a build."""

    uri: str
    """The rosbridge server of the readings."""
    topic: str
    """The topic of the readings."""
    type: str
    """That topic's type."""
    output: str = "/BMresults"
    """The topic of the posteriors."""
    partitions: int = 1
    """The number of boards."""
    interface: tuple[int, int] | None = None
    """Inputs and results of the boards' registers; None for the thesis's 20 x 1200, or the size of the model
    if larger.
    """
    scale: Scale | None = None
    """The part of a table that is divided by its maximum before quantising; None for addresses if the lines
    of a column share them, otherwise for whole columns.
    """
    prob_bits: int = 8
    """Bits of a code (W)."""
    prior_mode: PriorMode = PriorMode.TABLE
    """Source of the prior: a table in the images, or the host."""
    prior_path: str | None = None
    """The path of a written prior in the message, with one number per line; None if it comes from elsewhere.
    """
    counter_bits: int = 8
    """Bits of a line's counter."""
    target_count: int | None = None
    """The count that stops a machine; None for the maximum of the counters."""
    max_cycles: int = 2**17
    """Maximum number of cycles."""
    stop: Stop = Stop.SLICES
    """Stop rule: all boards together after a slice, or each at its own overflow."""
    rng: RngKind = RngKind.LFSR32
    """Kind of the random number generators."""
    rng_table: NDArray[np.uint32] | None = None
    """uint32[length], the random numbers for `rng = table`; None to generate them."""
    shared: bool = True
    """One generator per column, shared by its lines; otherwise one per cell."""
    steps_per_clock: int = 0
    """Steps of a generator per cycle; 0 for as many as are needed for fresh bits."""
    sensor_mode: SensorMode = SensorMode.COLUMN
    """The input of a cell: the reading of its column, its own reading, or its own code (`threshold`)."""
    replicas: int = 1
    """Number of machines on a board, which share the generators."""
    rng_banks: int = 16
    """Number of seed sets."""
    rng_reset: RngReset = RngReset.BANK
    """Reset rule of the generators: whether each frame restarts them."""
    queue: Queue = Queue.LATEST
    """The readings that wait if they arrive faster than frames are computed."""
    tolerance_s: float = 0.05
    """Maximum time in seconds between readings of several topics that belong together."""
    sources: SourcesFile | None = None
    """Several topics and their variables, in place of `uri`, `topic` and `type`; or None."""
    build_date: str = ""
    """The date of the build, ISO 8601: part of the images' manifests, but not of their hashes."""

    def __post_init__(self) -> None:
        """Refuse a server, topic, type or path that is none, before a model is read."""
        try:
            Output(topic=self.output), self.all_sources, self.written_prior
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


def refused_option(reason: ValidationError) -> BuildError:
    """Return a pydantic error as an error with the flag of the field."""
    detail = reason.errors(include_url=False)[0]
    key = str(detail["loc"][0]) if detail["loc"] else ""
    flag = "--output" if reason.title == "Output" else _FLAGS.get(key, "--" + key.replace("_", "-"))
    if detail["type"] == "value_error":
        sentence = str(detail["ctx"]["error"])
        return BuildError(f"{flag}: {sentence}" if key else sentence)
    return BuildError(
        f"{flag} is {detail['input']!r}, expected {detail['msg'].removeprefix('Input should be ')}"
    )
