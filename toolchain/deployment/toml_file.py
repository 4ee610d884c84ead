"""Reads a TOML file into a pydantic model; a mistake is a sentence with file, line and nearest right name."""

from __future__ import annotations

import difflib
import re
import tomllib
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from toolchain.bounded_file import read_bounded

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pydantic_core import ErrorDetails

    from toolchain.errors import ToolchainError

Model = TypeVar("Model", bound=BaseModel)

_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?$")
_PLACE = re.compile(r"\s*\(at (?:line (\d+), column \d+|end of document)\)$")
_SHOWN = 60
_MOST_BYTES = 4 << 20  # a deployment is a few kilobytes; this bounds what a wrong path can make us read


def read_text(path: Path, error: type[ToolchainError]) -> str:
    """Return the file's text.

    Raises:
        error: The file is not there, not readable, too large or not UTF-8.
    """
    data = read_bounded(path, _MOST_BYTES, error, "not a configuration file")
    try:
        return data.decode()
    except UnicodeDecodeError as reason:
        line = data.count(b"\n", 0, reason.start) + 1
        raise error(f"{path}, line {line}: not UTF-8 text") from None


def parse_toml(text: str, path: Path, error: type[ToolchainError]) -> dict[str, Any]:
    """Return the file's tables as they stand.

    Raises:
        error: Not TOML; names the file and the line.
    """
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as reason:
        sentence = str(reason)
        place = _PLACE.search(sentence)
        line = (place and place[1]) or str(text.count("\n") + 1)
        raise error(f"{path}, line {line}: {_PLACE.sub('', sentence)}") from None


def validate(
    model: type[Model], tables: dict[str, Any], text: str, path: Path, error: type[ToolchainError]
) -> Model:
    """Check the file's tables against a pydantic model, by its fields' aliases.

    Raises:
        error: A key or a value is wrong; names the file, the line and the nearest right name.
    """
    try:
        return model.model_validate(tables, by_alias=True, by_name=False)
    except ValidationError as reason:
        details = reason.errors()
        # An unknown key is usually the misspelling behind a missing one: say that first.
        first = min(details, key=lambda detail: detail["type"] != "extra_forbidden")
        raise error(_sentence(model, first, text, path)) from None


def line_of(text: str, place: Sequence[str | int]) -> int | None:
    """Return the line (from 1) of the key at a place like `("variable", 2, "bits")`, or of what holds it."""
    table, index, key = _split(place)
    number = -1
    here = not table
    found: int | None = None
    for count, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            if here:
                return found
            if header[2] == table:
                number += 1
                here = index is None or header[1] == "[" or number == index
                found = count if here else None
        elif (here and key and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*=", line)) or (
            found is None and not here and re.match(rf"\s*{re.escape(table)}\s*=", line)
        ):
            return count
    return found


def _split(place: Sequence[str | int]) -> tuple[str, int | None, str]:
    """Take a place apart into its table, the number in an array of tables, and the key."""
    match list(place):
        case [str(table), int(index), *rest]:
            return table, index, str(rest[0]) if rest else ""
        case [str(table), str(key), *_]:
            return table, None, key
        case [str(key)]:
            return "", None, key
        case _:
            return "", None, ""


def _sentence(model: type[BaseModel], detail: ErrorDetails, text: str, path: Path) -> str:
    place = detail["loc"]
    line = line_of(text, place)
    whole_table = line is None and len(place) == 1
    if whole_table:
        line = line_of(text, (*place, 0)) or line_of(text, (*place, ""))
    where = f"{path}, line {line}" if line is not None else str(path)
    table, index, key = _split(place)
    section = f" in [{table}]" if table and index is None else f" in [[{table}]] {(index or 0) + 1}"
    section = section if table else ""
    value = repr(detail["input"])
    value = value if len(value) <= _SHOWN else value[:_SHOWN] + "..."
    match detail["type"]:
        case "extra_forbidden":
            known = _keys(_model_at(model, place[:-1]))
            return f"{where}: unknown key '{place[-1]}'{section}; {_nearest(str(place[-1]), known)}"
        case "missing":
            return f"{where}: the key '{place[-1]}' is missing{section}"
        case "literal_error" | "enum":
            expected = [word.strip("' ") for word in re.split(r",| or ", str(detail["ctx"]["expected"]))]
            nearest = _nearest(str(detail["input"]), expected)
            return f"{where}: {key} = {value}{section} is not a value it can have; {nearest}"
        case "value_error":
            subject = f"in [{key}]" if whole_table else f"{key}{section}".lstrip()
            return ": ".join(part for part in (where, subject, str(detail["ctx"]["error"])) if part)
        case _:
            what = detail["msg"].removeprefix("Input should be ")
            return f"{where}: {key or place} = {value}{section}: expected {what}"


def _nearest(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"expected one of {', '.join(known)}"


def _keys(model: type[BaseModel]) -> list[str]:
    return [str(field.validation_alias or name) for name, field in model.model_fields.items()]


def _model_at(model: type[BaseModel], place: Sequence[str | int]) -> type[BaseModel]:
    """Follow a place through the models' fields to the model whose keys stand there."""
    for step in place:
        if isinstance(step, int):
            continue
        for name, field in model.model_fields.items():
            if step in (name, field.validation_alias):
                inner = [field.annotation, *get_args(field.annotation)]
                model = next(t for t in inner if isinstance(t, type) and issubclass(t, BaseModel))
    return model
