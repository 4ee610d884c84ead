"""Files of bounded size and depth. Errors name the file and the line, and writing replaces the whole file."""

from __future__ import annotations

import difflib
import os
import re
import stat
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Self, TypeVar, get_args

from pydantic import BaseModel, ValidationError

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from toolchain.errors import ToolchainError


_PIECE: Final = 1 << 18


@contextmanager
def file_errors(path: Path, done: str, error: type[ToolchainError], advice: str = "") -> Iterator[None]:
    """Convert an OSError in the block to `error`: "PATH cannot be DONE". `done` is "read" or "written", for example."""
    try:
        yield
    except OSError as reason:
        raise error(f"{path} cannot be {done}: {reason.strerror or reason}{advice}") from None


def open_regular(path: Path, error: type[ToolchainError], most: int | None = None) -> BinaryIO:
    """Open a regular file for reading.

    Other kinds of files are refused, because a FIFO or a device could block or never end.

    Raises:
        error: The file is missing, cannot be read, is not a regular file, or has more than `most` bytes.
    """
    with file_errors(path, "read", error):
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # otherwise, opening a FIFO waits for a writer
    state = os.fstat(number)
    if stat.S_ISREG(state.st_mode) and (most is None or state.st_size <= most):
        return os.fdopen(number, "rb")
    os.close(number)
    if not stat.S_ISREG(state.st_mode):
        raise error(f"{path} is not a regular file")
    raise error(f"{path} has more than {most} bytes, the maximum")


def read_bounded(path: Path, most: int, error: type[ToolchainError]) -> bytes:
    """Return the content of a regular file of at most `most` bytes, or raise `error`."""
    with file_errors(path, "read", error), open_regular(path, error, most) as file:
        pieces, size = [], 0
        while size <= most and (piece := file.read(_PIECE)):  # read(most) would allocate that much at once
            pieces.append(piece)
            size += len(piece)
    if size > most:  # it has grown, or is a file in /proc, which reports the size 0
        raise error(f"{path} has more than {most} bytes, the maximum")
    return b"".join(pieces)


@contextmanager
def whole_file(path: Path, error: type[ToolchainError]) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces the file at `path` at the end of the block.

    If the block fails or removes the temporary file, the file at `path` does not change.
    """
    partial = path.with_name(path.name + ".part")
    try:
        with file_errors(path, "written", error):
            yield partial
            if partial.exists():
                partial.replace(path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


Model = TypeVar("Model", bound=BaseModel)

_MOST_BYTES: Final = 4 << 20
"""Maximum size of a configuration file in bytes; a deployment has a few kilobytes."""
_MOST_SIGNS: Final = 100_000
"""Maximum number of `[`, `{` and `=` in a file, together. The number is limited because tables and keys need a thousand
times as much memory as their text. A deployment of 4,096 boards has 30,000 of these characters.
"""
_MOST_PARTS: Final = 32
"""Maximum number of parts of a dotted key; valid files have at most two."""
_PART: Final = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_DEEP_KEY: Final = re.compile(
    rf"(?:^|[{{,\[])[ \t]*+{_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{_MOST_PARTS},}}+", re.MULTILINE
)
_HEADER: Final = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?$")
_PLACE: Final = re.compile(r"\s*\(at (?:line (\d+), column \d+|end of document)\)$")
_SHOWN: Final = 60
_LISTED: Final = 20


@dataclass(frozen=True, slots=True)
class TomlFile:
    """The content of a TOML file."""

    path: Path
    """Path of the file."""
    error: type[ToolchainError]
    """Type of the errors about the file."""
    text: str
    """Text of the file, for finding the line of a mistake."""
    tables: dict[str, Any]
    """Tables of the file, not yet validated."""

    @classmethod
    def read(cls, path: Path, error: type[ToolchainError]) -> Self:
        """Read a file of bounded size and depth, or raise `error` with the line of the mistake."""
        data = read_bounded(path, _MOST_BYTES, error)
        try:
            text = data.decode()
        except UnicodeDecodeError as reason:
            line = data.count(b"\n", 0, reason.start) + 1
            raise error("not UTF-8 text", path=path, line=line) from None
        if sum(map(text.count, "[{=")) > _MOST_SIGNS:
            raise error("too many tables and keys for a configuration file", path=path)
        if deep := _DEEP_KEY.search(
            text
        ):  # the memory of tomllib grows with the square of the number of parts
            line = text.count("\n", 0, deep.start()) + 1
            raise error(f"a key has more than {_MOST_PARTS} parts", path=path, line=line)
        try:
            return cls(path, error, text, tomllib.loads(text))
        except (tomllib.TOMLDecodeError, RecursionError) as reason:
            found = _PLACE.search(str(reason))
            line = int(found[1]) if found and found[1] else text.count("\n") + 1
            raise error(_PLACE.sub("", str(reason)), path=path, line=line) from None

    def validated(self, model: type[Model]) -> Model:
        """Return the tables as a pydantic model, whose aliases are the keys in the file.

        Errors name the line and the nearest valid key.
        """
        try:
            return model.model_validate(self.tables, by_alias=True, by_name=False)
        except ValidationError as reason:
            details = reason.errors(include_url=False)
            # an unknown key is often the misspelling of a missing one, so report it first
            first = min(details, key=lambda detail: detail["type"] != "extra_forbidden")
            raise self._wrong_value(model, first) from None

    def mistake(self, place: tuple[str | int, ...], sentence: str) -> ToolchainError:
        """Return an error about the key at `place`, with the line of the key."""
        return self.error(sentence, path=self.path, line=self._line_of(place), place=place)

    def _line_of(self, place: Sequence[str | int]) -> int | None:
        """Return the line (from 1) of the key at a place such as `("variable", 2, "bits")`, or of the key's table."""
        table, index, key = _split(place)
        number = -1
        here = not table
        found: int | None = None
        for count, line in enumerate(self.text.splitlines(), start=1):
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

    def _wrong_value(self, model: type[BaseModel], detail: ErrorDetails) -> ToolchainError:
        place, models = _followed(model, detail["loc"])
        if detail["type"] == "union_tag_invalid":
            place.append("type")
        line = self._line_of(place)
        whole_table = line is None and len(place) == 1
        if whole_table:
            line = self._line_of((*place, 0)) or self._line_of((*place, ""))
        table, index, key = _split(place)
        section = f" in [{table}]" if table and index is None else f" in [[{table}]] {(index or 0) + 1}"
        section = section if table else ""
        value = repr(detail["input"])
        value = value if len(value) <= _SHOWN else value[:_SHOWN] + "..."
        match detail["type"]:
            case "extra_forbidden":
                known = _keys(models[0])
                sentence = f"unknown key '{place[-1]}'{section}; {nearest_name(str(place[-1]), known)}"
            case "missing":
                sentence = f"the key '{place[-1]}' is missing{section}"
            case "union_tag_invalid":
                nearest = nearest_name(detail["ctx"]["tag"], [_type_of(each) for each in models])
                sentence = f"type = {detail['ctx']['tag']!r}{section} is not a valid value; {nearest}"
            case "literal_error" | "enum":
                expected = [word.strip("' ") for word in re.split(r",| or ", str(detail["ctx"]["expected"]))]
                nearest = nearest_name(str(detail["input"]), expected)
                sentence = f"{key} = {value}{section} is not a valid value; {nearest}"
            case "value_error":
                subject = f"in [{key}]" if whole_table else f"{key}{section}".lstrip()
                sentence = ": ".join(part for part in (subject, str(detail["ctx"]["error"])) if part)
            case "model_type":
                heading = f"[[{table}]]" if table else f"[{key}]"
                sentence = f"{table or key} = {value} is not a table; begin it with a line {heading}"
            case "tuple_type":
                sentence = f"{key} = {value}{section}: expected a list"
            case _:
                sentence = f"{key or place} = {value}{section}: expected {detail['msg'].removeprefix('Input should be ')}"
        return self.error(sentence, path=self.path, line=line, place=tuple(place))


def _split(place: Sequence[str | int]) -> tuple[str, int | None, str]:
    """Split a place into its table, the index in an array of tables, and the key."""
    match list(place):
        case [str(table), int(index), *rest]:
            return table, index, str(rest[0]) if rest else ""
        case [str(table), str(key), *_]:
            return table, None, key
        case [str(key)]:
            return "", None, key
        case _:
            return "", None, ""


def nearest_name(word: str, known: Sequence[str], *, cutoff: float = 0.5) -> str:
    """Return advice on a wrong name. It names the nearest valid name or, if none is near, valid names."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=cutoff)
    if close:
        return f"did you mean '{close[0]}'?"
    more = f" and {len(known) - _LISTED} more" if len(known) > _LISTED else ""
    return f"expected one of {', '.join(known[:_LISTED]) or 'none'}{more}"


def _keys(model: type[BaseModel]) -> list[str]:
    return [str(field.validation_alias or name) for name, field in model.model_fields.items()]


def _type_of(model: type[BaseModel]) -> str:
    return str(model.model_fields["type"].default)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the models in an annotation: several if the `type` of a section selects one."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for each in get_args(annotation) for model in _models_in(each)]


def _followed(
    model: type[BaseModel], place: Sequence[str | int]
) -> tuple[list[str | int], list[type[BaseModel]]]:
    """Follow the place of a validation error through nested models.

    Returns the place without the steps that name the type of a section, and the models at the end of the place.
    """
    followed: list[str | int] = []
    models = [model]
    for step in place:
        if len(models) > 1:
            models = [each for each in models if _type_of(each) == step]
            continue
        followed.append(step)
        for name, field in models[0].model_fields.items():
            if step in (name, field.validation_alias):
                models = _models_in(field.annotation) or models
    return followed, models
