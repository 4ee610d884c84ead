"""Topics of readings and paths of variables in messages, from a sources file, `--order` and `--path`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import Field

from toolchain.bounded_files import TomlFile, nearest_name
from toolchain.deployment import Source, Variable, WrittenPrior
from toolchain.deployment.sections import MessagePath, Name, Section, Sequence
from toolchain.errors import BuildError, ToolchainError
from toolchain.flags import key_values, names_in

MOST_SOURCES: Final = 256


class SourceTable(Source):
    """A `[[source]]` of a sources file: a topic and its variables. If the source has no `uri`, `--uri` applies."""

    variables: dict[Name, MessagePath] | None = None
    """Maps a variable's name to its path in the message. None selects all variables that no other source has."""
    prior: MessagePath | None = None
    """The path of the prior in the message, or None if the message contains no prior."""


class SourcesTables(Section):
    """The schema that validates the tables of a sources file."""

    sources: Sequence[SourceTable] = Field(validation_alias="source", min_length=1, max_length=MOST_SOURCES)


@dataclass(frozen=True, slots=True)
class SourcesFile:
    """A sources file: its validated tables, and its TOML text. An error points to a line of the text."""

    toml: TomlFile
    tables: tuple[SourceTable, ...]

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources without their variables, in the form in which a deployment lists them."""
        return tuple(
            Source(**{key: getattr(table, key) for key in Source.model_fields}) for table in self.tables
        )

    @property
    def prior(self) -> WrittenPrior | None:
        """The source and the path of the prior that the host writes, or None if the host writes no prior."""
        paths = [(at, table.prior) for at, table in enumerate(self.tables) if table.prior is not None]
        return WrittenPrior(source=paths[0][0], path=paths[0][1]) if paths else None

    def place(self, variables: tuple[Variable, ...]) -> tuple[Variable, ...]:
        """Return `variables` with sources and paths from this file. Raise a BuildError if the names do not match."""
        places: dict[str, tuple[int, str]] = {}
        names = [variable.name for variable in variables]
        for at, table in enumerate(self.tables):
            for name, path in (table.variables or {}).items():
                if name not in names:
                    raise self._refused(at, f"the model has no '{name}'; {nearest_name(name, names)}")
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
        others = {variable.name: (rest, variable.path) for variable in variables}
        found = ((variable, *(others | places)[variable.name]) for variable in variables)
        return tuple(variable.replace(source=source, path=path) for variable, source, path in found)

    def check(self) -> None:
        """Raise a BuildError if the file has a mistake that can be found without a model."""
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
    """Read a sources file, or raise a BuildError with the line.

    `uri` is the server of each source that names no server. If `uri` is None, every source must name its server.
    """
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
    """Return variables as changed by `--order` and `--path`, or raise a BuildError.

    `order` lists one sensor for each column. The column keeps its own table and conversion to addresses, and takes the
    name, source and path of the listed sensor. An item NAME=PATH in `path` replaces the path of the variable NAME.
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
