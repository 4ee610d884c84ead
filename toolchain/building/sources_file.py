"""The file of `--sources`: which variable comes from which topic of which server."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from toolchain.deployment import Source, Variable, WrittenPrior
from toolchain.deployment.fields import MessagePath, MessageType, Name, Sequence, Topic, WebSocketUri
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
    """The form that the server is asked for: `cbor` pays for messages with long arrays."""
    variables: dict[Name, MessagePath] | None = None
    """Each variable's place in the message, by its name; None for all that no other source has."""
    prior: MessagePath | None = None
    """The place of a written prior in the message, or None."""


class SourcesTables(BaseModel):
    """A sources file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    sources: Sequence[SourceTable] = Field(validation_alias="source", min_length=1, max_length=MOST_SOURCES)


@dataclass(frozen=True, slots=True)
class SourcesFile:
    """A sources file that was read."""

    toml: TomlFile
    """The file."""
    tables: tuple[SourceTable, ...]
    """Its tables; each source has a URI."""

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources as a deployment has them."""
        return tuple(
            Source(
                uri=table.uri or "",
                topic=table.topic,
                type=table.type,
                compression=table.compression,
            )
            for table in self.tables
        )

    @property
    def prior(self) -> WrittenPrior | None:
        """The place that a written prior comes from, or None."""
        return next(
            (
                WrittenPrior(source=at, path=table.prior)
                for at, table in enumerate(self.tables)
                if table.prior is not None
            ),
            None,
        )

    def place(self, variables: tuple[Variable, ...]) -> tuple[Variable, ...]:
        """Return a model's variables, each with its source and its place there; a BuildError if they don't match."""
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
                f"no source has {', '.join(left)}; add them to the variables of a source, or leave 'variables' out of "
                "one, which then has all that no other has",
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
        """Refuse, with a BuildError, mistakes that can be seen without a model."""
        seen: dict[tuple[str | None, str], int] = {}
        priors = [at for at, table in enumerate(self.tables) if table.prior is not None]
        rests = [at for at, table in enumerate(self.tables) if table.variables is None]
        for at, table in enumerate(self.tables):
            if table.uri is None:
                raise self._refused(at, "it has no uri, and no --uri was given", "topic")
            if not table.variables and table.prior is None and at not in rests:
                raise self._refused(at, "nothing is read from it: it has neither variables nor a prior")
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
