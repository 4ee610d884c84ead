"""The file of `--sources`, which assigns variables to topics and servers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from toolchain.deployment import Source, Variable, WrittenPrior
from toolchain.deployment.fields import (
    MessagePath,
    MessageType,
    Name,
    Sequence,
    Topic,
    TopicBytes,
    WebSocketUri,
)
from toolchain.errors import BuildError, ToolchainError
from toolchain.files.toml_file import TomlFile, nearest_name

MOST_SOURCES: Final = 256


class SourceTable(BaseModel):
    """A `[[source]]` of a sources file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    uri: WebSocketUri | None = None
    """The rosbridge server; None for that of `--uri`."""
    topic: Topic
    """The topic."""
    type: MessageType
    """The type of its messages."""
    compression: Literal["none", "cbor"] = "none"
    topic_bytes: TopicBytes | None = None
    """The requested encoding: `cbor` pays off for messages with long arrays."""
    variables: dict[Name, MessagePath] | None = None
    """The path of each variable in the message, by its name; None for all variables of no other source."""
    prior: MessagePath | None = None
    """The path of a written prior in the message, or None."""


class SourcesTables(BaseModel):
    """A sources file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    sources: Sequence[SourceTable] = Field(validation_alias="source", min_length=1, max_length=MOST_SOURCES)


@dataclass(frozen=True, slots=True)
class SourcesFile:
    """The content of a sources file."""

    toml: TomlFile
    """The file."""
    tables: tuple[SourceTable, ...]
    """Its tables; each source has a URI."""

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources, as in a deployment."""
        return tuple(
            Source(
                uri=table.uri or "",
                topic=table.topic,
                type=table.type,
                compression=table.compression,
                topic_bytes=table.topic_bytes,
            )
            for table in self.tables
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
        seen: dict[tuple[str | None, str], int] = {}
        priors = [at for at, table in enumerate(self.tables) if table.prior is not None]
        rests = [at for at, table in enumerate(self.tables) if table.variables is None]
        for at, table in enumerate(self.tables):
            if table.uri is None:
                raise self._refused(at, "it has no uri, and no --uri was given", "topic")
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
    tables = toml.validated(SourcesTables).sources
    file = SourcesFile(toml, tuple(table.model_copy(update={"uri": table.uri or uri}) for table in tables))
    file.check()
    return file
