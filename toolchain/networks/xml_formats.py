"""Readers of network files in XML: GeNIe's XDSL, and XMLBIF. Entities and deep nesting are refused."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import NetworkFileError
from toolchain.networks.builder import NetworkBuilder

_MAX_DEPTH: Final = 16
_MAX_ELEMENTS: Final = 1 << 19
_DECIMAL: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True)
class XmlLine:
    """A line of an XML file, to be named in errors."""

    path: Path
    number: int

    def error(self, sentence: str) -> NetworkFileError:
        """Return an error with the file, the line and `sentence`."""
        return NetworkFileError(sentence, path=self.path, line=self.number)


def _entries(text: str, wanted: int, child: str, line: XmlLine) -> list[str]:
    """Return the words of a child's table, or raise a NetworkFileError if there are not `wanted`."""
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


@dataclass(slots=True)
class Element:
    """An element of an XML file. `text` is the text after the last child, or all text if there are no children."""

    name: str
    attributes: dict[str, str]
    start: XmlLine
    end: XmlLine
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def named(self, name: str) -> list[Element]:
        """Return the children with this name."""
        return [child for child in self.children if child.name == name]

    def texts(self, name: str) -> list[str]:
        """Return the texts of the children with this name."""
        return [child.text for child in self.named(name)]

    def only(self, name: str) -> str:
        """Return the text of the only child with this name, or raise a NetworkFileError if there is not exactly one."""
        found = self.texts(name)
        if len(found) != 1:
            raise self.end.error(f"there are {len(found)} elements {name}, expected one")
        return found[0]


def read_xml(data: bytes, path: Path, root: str) -> Element:
    """Return the root element. Raises a NetworkFileError with the line if the XML is invalid or has entities."""
    parser = expat.ParserCreate()
    parser.buffer_text = True
    top = Element("", {}, XmlLine(path, 1), XmlLine(path, 1))
    opened, count = [top], 0
    # the text since the last tag
    pieces: list[str] = []

    def here() -> XmlLine:
        return XmlLine(path, parser.CurrentLineNumber)

    def refuse(name: str, *_rest: object) -> None:
        raise here().error(
            f"the entity {name[:40]!r}: a network does not need entities, and they are refused"
        )

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > _MAX_ELEMENTS or len(opened) > _MAX_DEPTH:
            raise here().error(f"more than {_MAX_ELEMENTS} elements, or nested more than {_MAX_DEPTH} deep")
        if len(opened) == 1 and name != root:
            raise here().error(f"the file is {name[:40]!r}, expected {root}")
        element = Element(name, attributes, here(), here())
        opened[-1].children.append(element)
        opened.append(element)
        pieces.clear()

    def end(_name: str) -> None:
        element = opened.pop()
        element.text, element.end = "".join(pieces).strip(), here()
        pieces.clear()

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = pieces.append
    parser.EntityDeclHandler = parser.SkippedEntityHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as reason:
        raise XmlLine(path, reason.lineno).error(expat.ErrorString(reason.code)) from None
    except (LookupError, ValueError):
        raise here().error("its encoding is not known") from None
    return top.children[0]


# XDSL, the format of GeNIe: chance and deterministic nodes

_XDSL_NODES: Final = {"cpt": "probabilities", "deterministic": "resultingstates"}
"""The kinds of nodes that can be read, and the element with the table of each."""


def read_xdsl(data: bytes, builder: NetworkBuilder) -> None:
    """Read an XDSL file into `builder`.

    In `probabilities`, the first parent varies slowest, and the child varies fastest. `resultingstates` of a
    deterministic node names one state for each combination of the parents' states.
    """
    smile = read_xml(data, builder.path, "smile")
    builder.name(smile.attributes.get("id", ""))
    nodes = [node for group in smile.named("nodes") for node in group.children]
    for node in nodes:
        if node.name not in _XDSL_NODES:
            raise node.start.error(
                f"a {node.name[:40]} node: only nodes with tables (cpt) and deterministic ones can be read; in "
                "GeNIe, change its type to General"
            )
        if "dynamic" in node.attributes:
            raise node.start.error("a dynamic node: only static networks can be read")
        states = [state.attributes.get("id", "") for state in node.named("state")]
        builder.variable(node.attributes.get("id", ""), states, node.start)
    # after the last node, because the parents of a node may come later
    for node in nodes:
        _xdsl_table(builder, node)


def _xdsl_table(builder: NetworkBuilder, node: Element) -> None:
    child = node.attributes["id"]
    parents = " ".join(node.texts("parents")).split()
    tables = node.named(_XDSL_NODES[node.name])
    if len(tables) > 1:
        raise tables[1].end.error(f"{child[:40]} has two tables")
    line = tables[0].end if tables else node.start
    shape = builder.shape((*parents, child), line)
    wanted = math.prod(shape) if node.name == "cpt" else math.prod(shape[:-1])
    words = _entries(tables[0].text if tables else "", wanted, child, line)
    if node.name == "cpt":
        values = _decimals(words, child, line)
    else:
        chosen = [builder.state(child, word, line) for word in words]
        values = (np.arange(shape[-1]) == np.array(chosen)[:, np.newaxis]).astype(np.float64)
    builder.distribution(child, parents, np.moveaxis(values.reshape(shape), -1, 0), line)


# XMLBIF (version 0.3)


def read_xmlbif(data: bytes, builder: NetworkBuilder) -> None:
    """Read an XMLBIF file into `builder`. In a TABLE, the first GIVEN varies slowest, and the FOR varies fastest."""
    parts = [
        part for network in read_xml(data, builder.path, "BIF").named("NETWORK") for part in network.children
    ]
    for part in parts:
        if part.name == "NAME":
            builder.name(part.text)
        elif part.name == "VARIABLE":
            kind = part.attributes.get("TYPE", "nature")
            if kind != "nature":
                raise part.start.error(f"a variable of the type {kind[:40]!r}: only 'nature' can be read")
            builder.variable(part.only("NAME"), part.texts("OUTCOME"), part.end)
    # after the last variable, because a definition may come before its variable
    for part in parts:
        if part.name == "DEFINITION":
            child, table, parents = part.only("FOR"), part.only("TABLE"), part.texts("GIVEN")
            shape = builder.shape((*parents, child), part.end)
            words = _entries(table, math.prod(shape), child, part.end)
            values = _decimals(words, child, part.end).reshape(shape)
            builder.distribution(child, parents, np.moveaxis(values, -1, 0), part.end)
