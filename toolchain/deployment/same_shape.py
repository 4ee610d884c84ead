"""Comparison of deployments: whether one can replace another in a run.

The shape of a run must not change: it is synthesised into the boards (lines, partitions, widths, generators,
registers), or processes are connected according to it (servers, topics, types). Tables, priors, seeds, stop
conditions and the conversion of readings to addresses may change. A field that is not listed below as free
must not change, so that a new field is safe by default.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from toolchain.deployment import Deployment

if TYPE_CHECKING:
    from pydantic import BaseModel


_DEPLOYMENT_FREE: Final = {
    *("name", "hash", "tolerance_s", "prior", "directory", "integrity", "integrity_frames"),
}
_VARIABLE_FREE: Final = {
    *("source", "path", "offset", "step", "period", "values", "on_range", "on_missing", "states"),
}
_DIMENSION_FREE: Final = {"offset", "step", "unit", "states"}
_MACHINE_FREE: Final = {"scale", "target_count", "max_cycles", "stop"}
_BOARD_FREE: Final = {"image", "image_hash"}
_TABLES: Final = {"sources", "variables", "searched", "machine", "boards", "outputs"}


@dataclass(frozen=True, slots=True)
class Difference:
    """A field that differs but must not change."""

    field: str
    """Its path in `deployment.toml`."""
    before: str
    """Its value in the deployment in force."""
    after: str
    """Its value in the new deployment."""

    @property
    def is_connection(self) -> bool:
        """True if it concerns servers, topics or addresses of boards, and not the machine."""
        return self.field.startswith(("[[source]]", "[[output]]")) or self.field.endswith(" endpoint")

    def __str__(self) -> str:
        return f"{self.field} is {self.before} in the run and {self.after} in the new one"


def differences(before: Deployment, after: Deployment) -> list[Difference]:
    """Return the differences that prevent `after` from replacing `before`, in the order of `deployment.toml`."""
    old, new = dict(_shape(before)), dict(_shape(after))
    fields = [*old, *(field for field in new if field not in old)]
    found = [
        Difference(field, old.get(field, "not there"), new.get(field, "not there"))
        for field in fields
        if old.get(field) != new.get(field)
    ]
    counts = [difference for difference in found if difference.field.endswith(_COUNTS)]
    # if a table has other rows, do not compare their contents
    tables = tuple(
        f"{difference.field.split(']]')[0]}]]" for difference in counts if "]]" in difference.field
    )
    return [each for each in found if each in counts or not each.field.startswith(tables or ("\0",))]


_COUNTS: Final = ("number", "names")


def _shape(deployment: Deployment) -> Iterator[tuple[str, str]]:
    yield from _fields("", deployment, _DEPLOYMENT_FREE | _TABLES)
    yield from _rows("[[source]]", deployment.sources, set())
    yield "[[variable]] names", _text(sorted(variable.name for variable in deployment.variables))
    for variable in sorted(deployment.variables, key=lambda each: each.name):
        yield from _fields(f"[[variable]] {variable.name} ", variable, _VARIABLE_FREE | {"name", "bits"})
    # columns are fixed; the variable that each one reads may change
    for column, variable in enumerate(deployment.sensors, start=1):
        yield f"[[variable]] bits of column {column}", _text(variable.bits)
    yield from _rows("[[searched]]", deployment.searched, _DIMENSION_FREE)
    yield from _fields("[machine] ", deployment.machine, _MACHINE_FREE)
    yield from _rows("[[board]]", deployment.boards, _BOARD_FREE)
    yield from _rows("[[output]]", deployment.outputs, set())


def _rows(table: str, rows: tuple[BaseModel, ...], free: set[str]) -> Iterator[tuple[str, str]]:
    yield f"{table} number", _text(len(rows))
    for at, row in enumerate(rows):
        yield from _fields(f"{table} {at} ", row, free)


def _fields(before: str, section: BaseModel, free: set[str]) -> Iterator[tuple[str, str]]:
    for name in type(section).model_fields:
        if name not in free:
            yield before + name, _text(getattr(section, name))


def _text(value: object) -> str:
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return str(value) if value != "" else "empty"
