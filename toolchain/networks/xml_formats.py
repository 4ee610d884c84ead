"""Readers of network files in XML: GeNIe's XDSL and XMLBIF, without entities and of bounded depth."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import NetworkFileError
from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, NetworkBuilder

_MAX_DEPTH: Final = 16
_DECIMAL: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True)
class XmlLine:
    """A line of an XML file, for errors."""

    path: Path
    number: int

    def error(self, sentence: str) -> NetworkFileError:
        """Return an error with the file and the line before the sentence."""
        return NetworkFileError(sentence, path=self.path, line=self.number)


def _entries(text: str, wanted: int, child: str, line: XmlLine) -> list[str]:
    """Return the words of a table, or raise a NetworkFileError if there are not as many as wanted."""
    words = text.split(maxsplit=wanted)
    if len(words) != wanted:
        count = f"more than {wanted}" if len(words) > wanted else str(len(words))
        raise line.error(f"the table of {child} has {count} entries, expected {wanted}")
    return words


def _decimals(words: Sequence[str], child: str, line: XmlLine) -> NDArray[np.float64]:
    """Return the words of a table as numbers, or raise a NetworkFileError; `1_0`, `nan` and `inf` are not decimal."""
    for word in words:
        if not _DECIMAL.fullmatch(word):
            raise line.error(f"{word[:40]!r} in the table of {child} is not a number")
    return np.array([float(word) for word in words])


class XmlFile:
    """A parser that calls `started(name, attributes)` and `ended(name, text)` for every element.

    The text is that between the last start tag and the end tag, so it is complete for elements without children.
    `open` are the names of the open elements; `ended` is called after its element was removed.
    """

    def __init__(
        self,
        path: Path,
        root: str,
        *,
        started: Callable[[str, dict[str, str]], None],
        ended: Callable[[str, str], None],
    ) -> None:
        self._path = path
        self._root = root
        self._started = started
        self._ended = ended
        self.open: list[str] = []
        self._text: list[str] = []
        self._parser = expat.ParserCreate()
        self._parser.buffer_text = True
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._characters
        self._parser.EntityDeclHandler = self._entity
        self._parser.SkippedEntityHandler = self._entity

    @property
    def here(self) -> XmlLine:
        """The line that is being parsed."""
        return XmlLine(self._path, self._parser.CurrentLineNumber)

    def parse(self, data: bytes) -> None:
        """Parse a whole file, or raise a NetworkFileError with the line."""
        try:
            self._parser.Parse(data, True)
        except expat.ExpatError as reason:
            raise XmlLine(self._path, reason.lineno).error(expat.ErrorString(reason.code)) from None
        except (LookupError, ValueError):
            raise self.here.error("its encoding is not known") from None

    def _entity(self, name: str, *_rest: object) -> None:
        raise self.here.error(
            f"the entity {name[:40]!r}: a network does not need entities, and they are refused"
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self.open) == _MAX_DEPTH:
            raise self.here.error(f"elements are nested more than {_MAX_DEPTH} deep")
        if not self.open and name != self._root:
            raise self.here.error(f"the file is {name[:40]!r}, expected {self._root}")
        self.open.append(name)
        self._text = []
        self._started(name, attributes)

    def _characters(self, text: str) -> None:
        self._text.append(text)

    def _end(self, name: str) -> None:
        self.open.pop()
        self._ended(name, "".join(self._text).strip())
        self._text = []


# XDSL, the format of GeNIe: chance and deterministic nodes

_XDSL_NODES: Final = {"cpt": "probabilities", "deterministic": "resultingstates"}
"""The kinds of nodes that can be read, and the element with the table of each."""


@dataclass(slots=True)
class _XdslNode:
    """A node while it is read; its table is processed after the last node, because its parents may come later."""

    kind: str
    name: str
    line: XmlLine
    states: list[str] = field(default_factory=list)
    parents: list[str] = field(default_factory=list)
    table: str = ""


def read_xdsl(data: bytes, builder: NetworkBuilder) -> None:
    """Read an XDSL file; in `probabilities`, the first parent varies slowest and the child fastest.

    `resultingstates` of a deterministic node has one state for each combination of its parents.
    """
    _XdslReader(builder).read(data)


class _XdslReader:
    def __init__(self, builder: NetworkBuilder) -> None:
        self._builder = builder
        self._file = XmlFile(builder.path, "smile", started=self._started, ended=self._ended)
        self._nodes: list[_XdslNode] = []

    def read(self, data: bytes) -> None:
        self._file.parse(data)
        for node in self._nodes:
            self._builder.variable(node.name, node.states, node.line)
        for node in self._nodes:
            self._define(node)

    def _started(self, name: str, attributes: dict[str, str]) -> None:
        here = self._file.here
        match self._file.open:
            case ["smile"]:
                self._builder.name(attributes.get("id", ""))
            case ["smile", "nodes", _]:
                if name not in _XDSL_NODES:
                    raise here.error(
                        f"a {name[:40]} node: only nodes with tables (cpt) and deterministic ones can be read; in "
                        "GeNIe, change its type to General"
                    )
                if "dynamic" in attributes:
                    raise here.error("a dynamic node: only static networks can be read")
                self._nodes.append(_XdslNode(name, attributes.get("id", ""), here))
            case ["smile", "nodes", _, "state"]:
                states = self._nodes[-1].states
                if len(states) == MAX_STATES:
                    raise here.error(f"{self._nodes[-1].name[:40]} has more than {MAX_STATES} states")
                states.append(attributes.get("id", ""))

    def _ended(self, name: str, text: str) -> None:
        if len(self._file.open) != 3 or self._file.open[:2] != ["smile", "nodes"]:
            return
        node, here = self._nodes[-1], self._file.here
        if name == "parents":
            node.parents = text.split(maxsplit=MAX_PARENTS)
            if len(node.parents) > MAX_PARENTS:
                raise here.error(f"{node.name[:40]} has more than {MAX_PARENTS} parents")
        elif name == _XDSL_NODES[node.kind]:
            if node.table:
                raise here.error(f"{node.name[:40]} has two tables")
            node.table, node.line = text, here

    def _define(self, node: _XdslNode) -> None:
        shape = self._builder.shape((*node.parents, node.name), node.line)
        size, entries = shape[-1], math.prod(shape)
        wanted = entries if node.kind == "cpt" else entries // size
        words = _entries(node.table, wanted, node.name, node.line)
        if node.kind == "cpt":
            values = _decimals(words, node.name, node.line)
        else:
            chosen = [self._builder.state(node.name, word, node.line) for word in words]
            values = (np.arange(size) == np.array(chosen)[:, np.newaxis]).astype(np.float64)
        table = np.moveaxis(values.reshape(shape), -1, 0)
        self._builder.distribution(node.name, node.parents, table, node.line)


# XMLBIF (version 0.3)

_XMLBIF_TEXTS: Final = {"NAME", "OUTCOME", "FOR", "GIVEN", "TABLE"}


def read_xmlbif(data: bytes, builder: NetworkBuilder) -> None:
    """Read an XMLBIF file without entities; in a TABLE, the GIVENs are in order and the FOR varies fastest."""
    _XmlbifReader(builder).read(data)


class _XmlbifReader:
    """A reader of elements; definitions are processed at the end, because their variables may come later."""

    def __init__(self, builder: NetworkBuilder) -> None:
        self._builder = builder
        self._file = XmlFile(builder.path, "BIF", started=self._started, ended=self._ended)
        self._fields: dict[str, list[str]] = {}
        self._definitions: list[tuple[dict[str, list[str]], XmlLine]] = []

    def read(self, data: bytes) -> None:
        self._file.parse(data)
        for fields, line in self._definitions:
            self._definition(fields, line)

    def _started(self, name: str, attributes: dict[str, str]) -> None:
        if name in {"VARIABLE", "DEFINITION"}:
            self._fields = {}
            kind = attributes.get("TYPE", "nature")
            if name == "VARIABLE" and kind != "nature":
                raise self._file.here.error(
                    f"a variable of the type {kind[:40]!r}: only 'nature' can be read"
                )

    def _ended(self, name: str, text: str) -> None:
        inside, here = self._file.open, self._file.here
        if name in _XMLBIF_TEXTS and inside:
            if inside[-1] in {"VARIABLE", "DEFINITION"}:
                self._fields.setdefault(name, []).append(text)
            elif name == "NAME" and inside[-1] == "NETWORK":
                self._builder.name(text)
        elif name == "VARIABLE":
            variable = self._one("NAME", self._fields, here)
            states = self._fields.get("OUTCOME", [])
            if len(states) > MAX_STATES:
                raise here.error(f"{variable[:40]} has more than {MAX_STATES} states")
            self._builder.variable(variable, states, here)
        elif name == "DEFINITION":
            self._definitions.append((self._fields, here))

    def _one(self, key: str, fields: dict[str, list[str]], line: XmlLine) -> str:
        found = fields.get(key, [])
        if len(found) != 1:
            raise line.error(f"there are {len(found)} elements {key}, expected one")
        return found[0]

    def _definition(self, fields: dict[str, list[str]], line: XmlLine) -> None:
        child = self._one("FOR", fields, line)
        text = self._one("TABLE", fields, line)
        parents = fields.get("GIVEN", [])
        if len(parents) > MAX_PARENTS:
            raise line.error(f"{child[:40]} has more than {MAX_PARENTS} parents")
        shape = self._builder.shape((*parents, child), line)
        words = _entries(text, math.prod(shape), child, line)
        values = _decimals(words, child, line).reshape(shape)
        self._builder.distribution(child, parents, np.moveaxis(values, -1, 0), line)
