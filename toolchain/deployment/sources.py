"""Several sources of readings: which variable comes from which topic of which server, as a small TOML file says it."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from toolchain.deployment import Source, WrittenPrior
from toolchain.deployment.fields import MessagePath, MessageType, Name, Sequence, Topic, WebSocketUri  # noqa: TC001 - pydantic evaluates annotations
from toolchain.deployment.toml_file import line_of, parse_toml, read_text, validate
from toolchain.errors import BuildError

if TYPE_CHECKING:
    from pathlib import Path

    from toolchain.deployment import Variable

MOST_SOURCES: Final = 256


class SourceTable(BaseModel):
    """`[[source]]` of a sources file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    uri: WebSocketUri | None = None
    """The rosbridge server; None for that of `--uri`."""
    topic: Topic
    """The topic."""
    type: MessageType
    """Its messages' type."""
    compression: Literal["none", "cbor"] = "none"
    """How the server is asked to send them: `cbor` pays where they have long arrays."""
    variables: dict[Name, MessagePath] | None = None
    """By name, where in the message each variable is; None for all that no other source has."""
    prior: MessagePath | None = None
    """Where in the message a written prior is, or None."""


class SourcesTables(BaseModel):
    """A sources file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    sources: Sequence[SourceTable] = Field(validation_alias="source", min_length=1, max_length=MOST_SOURCES)


@dataclass(frozen=True, slots=True)
class SourcesFile:
    """A sources file that was read."""

    path: Path
    """Where it is."""
    text: str
    """What stands in it."""
    tables: tuple[SourceTable, ...]
    """What it says; every source has a URI."""

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
        """Where a written prior comes from, or None."""
        return next(
            (
                WrittenPrior(source=at, path=table.prior)
                for at, table in enumerate(self.tables)
                if table.prior is not None
            ),
            None,
        )

    def place(self, variables: tuple[Variable, ...]) -> tuple[Variable, ...]:
        """Return a model's variables, each with its source and its place there.

        Raises:
            BuildError: A variable that the model has not, that two sources have, or that none has.
        """
        places: dict[str, tuple[int, str]] = {}
        names = [variable.name for variable in variables]
        for at, table in enumerate(self.tables):
            for name, path in (table.variables or {}).items():
                if name not in names:
                    raise self._refused(at, f"the model has no variable {name!r}; {_nearest(name, names)}")
                if name in places:
                    raise self._refused(at, f"{name} comes from source {places[name][0] + 1} already")
                places[name] = at, path
        rest = next((at for at, table in enumerate(self.tables) if table.variables is None), None)
        left = [name for name in names if name not in places]
        if left and rest is None:
            raise BuildError(
                f"{self.path}: no source has {', '.join(left)}; add them to a source's variables, or leave "
                "'variables' out of one, which then has all that no other has"
            )
        if not left and rest is not None and self.tables[rest].prior is None:
            raise self._refused(rest, "the other sources have all variables; nothing is left for this one")
        return tuple(
            variable.model_copy(
                update={"source": places[variable.name][0], "path": places[variable.name][1]}
                if variable.name in places
                else {"source": rest}
            )
            for variable in variables
        )

    def _refused(self, at: int, why: str, key: str = "variables") -> BuildError:
        line = line_of(self.text, ("source", at, key))
        where = f"{self.path}, line {line}" if line is not None else str(self.path)
        return BuildError(f"{where}: in [[source]] {at + 1}: {why}")

    def check(self) -> None:
        """Refuse what can be seen without a model.

        Raises:
            BuildError: A source without a server or without anything to read, two that take what is left, one topic
                twice, two priors.
        """
        seen: dict[tuple[str | None, str], int] = {}
        priors = [at for at, table in enumerate(self.tables) if table.prior is not None]
        rests = [at for at, table in enumerate(self.tables) if table.variables is None]
        for at, table in enumerate(self.tables):
            if table.uri is None:
                raise self._refused(at, "it has no uri, and no --uri was given for those without", "topic")
            if not table.variables and table.prior is None and at not in rests:
                raise self._refused(at, "nothing is read from it: it has neither variables nor a prior")
            first = seen.setdefault((table.uri, table.topic), at)
            if first != at:
                raise self._refused(
                    at,
                    f"source {first + 1} is the same topic of the same server: put their variables together",
                    "topic",
                )
        if len(rests) > 1:
            raise self._refused(
                rests[1],
                f"source {rests[0] + 1} has no 'variables' either; only one can have all that no other has",
                "topic",
            )
        if len(priors) > 1:
            raise self._refused(priors[1], f"source {priors[0] + 1} has the prior already", "prior")


def read_sources(path: Path, uri: str | None) -> SourcesFile:
    """Read a sources file.

    Args:
        path: The file.
        uri: The rosbridge server of the sources that name none.

    Raises:
        BuildError: Not there, not TOML, or a mistake in it (file, line, nearest right name).
    """
    text = read_text(path, BuildError)
    tables = validate(SourcesTables, parse_toml(text, path, BuildError), text, path, BuildError).sources
    file = SourcesFile(
        path, text, tuple(table.model_copy(update={"uri": table.uri or uri}) for table in tables)
    )
    file.check()
    return file


def _nearest(name: str, names: list[str]) -> str:
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"it has {', '.join(names)}" if names else "it has none"
