"""XDSL, GeNIe's format: chance and deterministic nodes in XML, without entities."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, NetworkBuilder
from toolchain.networks.xml_file import Line, XmlFile, decimals

_NODES: Final = {"cpt": "probabilities", "deterministic": "resultingstates"}
"""The kinds of nodes that can be read, and the element with the table of each."""


@dataclass(slots=True)
class _Node:
    """A node while it is read; its table is processed after the last node, because parents may follow."""

    kind: str
    name: str
    line: Line
    states: list[str] = field(default_factory=list)
    parents: list[str] = field(default_factory=list)
    table: str = ""


def read_xdsl(data: bytes, builder: NetworkBuilder) -> None:
    """Read an XDSL file; in `probabilities`, the first parent varies slowest and the child fastest.

    `resultingstates` of a deterministic node has one state for each combination of its parents.

    Raises:
        NetworkFileError: The file is not XDSL, or has nodes of another kind; the sentence contains the line.
    """
    _Reader(builder).read(data)


class _Reader:
    def __init__(self, builder: NetworkBuilder) -> None:
        self._builder = builder
        self._file = XmlFile(builder.path, "smile", started=self._started, ended=self._ended)
        self._nodes: list[_Node] = []

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
                if name not in _NODES:
                    raise here.error(
                        f"a {name[:40]} node: only nodes with tables (cpt) and deterministic ones can be read; in "
                        "GeNIe, change its type to General"
                    )
                if "dynamic" in attributes:
                    raise here.error("a dynamic node: only static networks can be read")
                self._nodes.append(_Node(name, attributes.get("id", ""), here))
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
        elif name == _NODES[node.kind]:
            if node.table:
                raise here.error(f"{node.name[:40]} has two tables")
            node.table, node.line = text, here

    def _define(self, node: _Node) -> None:
        shape = self._builder.shape((*node.parents, node.name), node.line)
        size, entries = shape[-1], math.prod(shape)
        wanted = entries if node.kind == "cpt" else entries // size
        words = node.table.split(maxsplit=wanted)
        if len(words) != wanted:
            count = f"more than {wanted}" if len(words) > wanted else str(len(words))
            raise node.line.error(f"the table of {node.name} has {count} entries, expected {wanted}")
        if node.kind == "cpt":
            values = decimals(words, node.name, node.line)
        else:
            chosen = [self._builder.state(node.name, word, node.line) for word in words]
            values = (np.arange(size) == np.array(chosen)[:, np.newaxis]).astype(np.float64)
        table = np.moveaxis(values.reshape(shape), -1, 0)
        self._builder.distribution(node.name, node.parents, table, node.line)
