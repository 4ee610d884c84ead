"""XMLBIF (version 0.3), a network in XML, without external or internal entities."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final
from xml.parsers import expat

import numpy as np

from toolchain.errors import NetworkFileError
from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, NetworkBuilder

_TEXTS: Final = {"NAME", "OUTCOME", "FOR", "GIVEN", "TABLE"}
_MAX_DEPTH: Final = 16
_DECIMAL: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def read_xmlbif(data: bytes, builder: NetworkBuilder) -> None:
    """Read an XMLBIF file without entities; in a TABLE, the GIVENs are in order and the FOR is fastest."""
    _Reader(builder).read(data)


class _Reader:
    """A reader of elements; definitions are processed after the last variable, which may follow them."""

    def __init__(self, builder: NetworkBuilder) -> None:
        self._builder = builder
        self._parser = expat.ParserCreate()
        self._parser.buffer_text = True
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._characters
        self._parser.EntityDeclHandler = self._entity
        self._parser.SkippedEntityHandler = self._entity
        self._path: list[str] = []
        self._text: list[str] = []
        self._fields: dict[str, list[str]] = {}
        self._definitions: list[tuple[dict[str, list[str]], _Line]] = []

    def read(self, data: bytes) -> None:
        try:
            self._parser.Parse(data, True)
        except expat.ExpatError as reason:
            raise NetworkFileError(
                expat.ErrorString(reason.code), path=self._builder.path, line=reason.lineno
            ) from None
        except (LookupError, ValueError):
            raise self._here.error("its encoding is not known") from None
        for fields, line in self._definitions:
            self._definition(fields, line)

    @property
    def _here(self) -> _Line:
        return _Line(self._builder.path, self._parser.CurrentLineNumber)

    def _entity(self, name: str, *_rest: object) -> None:
        raise self._here.error(
            f"the entity {name[:40]!r}: a network does not need entities, and they are refused"
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self._path) == _MAX_DEPTH:
            raise self._here.error(f"elements are nested more than {_MAX_DEPTH} deep")
        if not self._path and name != "BIF":
            raise self._here.error(f"the file is {name[:40]!r}, expected BIF")
        self._path.append(name)
        self._text = []
        if name in {"VARIABLE", "DEFINITION"}:
            self._fields = {}
            kind = attributes.get("TYPE", "nature")
            if name == "VARIABLE" and kind != "nature":
                raise self._here.error(f"a variable of the type {kind[:40]!r}: only 'nature' can be read")

    def _characters(self, text: str) -> None:
        if self._path[-1] in _TEXTS:
            self._text.append(text)

    def _end(self, name: str) -> None:
        self._path.pop()
        if name in _TEXTS and self._path:
            text = "".join(self._text).strip()
            if self._path[-1] in {"VARIABLE", "DEFINITION"}:
                self._fields.setdefault(name, []).append(text)
            elif name == "NAME" and self._path[-1] == "NETWORK":
                self._builder.name(text)
        elif name == "VARIABLE":
            (variable,) = self._one("NAME", self._fields, self._here)
            states = self._fields.get("OUTCOME", [])
            if len(states) > MAX_STATES:
                raise self._here.error(f"{variable[:40]} has more than {MAX_STATES} states")
            self._builder.variable(variable, states, self._here)
        elif name == "DEFINITION":
            self._definitions.append((self._fields, self._here))

    def _one(self, key: str, fields: dict[str, list[str]], line: _Line) -> list[str]:
        found = fields.get(key, [])
        if len(found) != 1:
            raise line.error(f"there are {len(found)} elements {key}, expected one")
        return found

    def _definition(self, fields: dict[str, list[str]], line: _Line) -> None:
        (child,) = self._one("FOR", fields, line)
        (text,) = self._one("TABLE", fields, line)
        parents = fields.get("GIVEN", [])
        if len(parents) > MAX_PARENTS:
            raise line.error(f"{child[:40]} has more than {MAX_PARENTS} parents")
        shape = self._builder.shape((*parents, child), line)
        entries = int(np.prod(shape))
        words = text.split(maxsplit=entries)
        if len(words) != entries:
            count = f"more than {entries}" if len(words) > entries else str(len(words))
            raise line.error(f"the table of {child} has {count} numbers, expected {entries}")
        for word in words:
            if not _DECIMAL.fullmatch(word):
                raise line.error(f"{word[:40]!r} in the table of {child} is not a number")
        values = np.array([float(word) for word in words]).reshape(shape)
        self._builder.distribution(child, parents, np.moveaxis(values, -1, 0), line)


class _Line:
    """A line of the file; that of a definition is its last one."""

    def __init__(self, path: Path, number: int) -> None:
        self._path = path
        self._number = number

    def error(self, sentence: str) -> NetworkFileError:
        return NetworkFileError(sentence, path=self._path, line=self._number)
