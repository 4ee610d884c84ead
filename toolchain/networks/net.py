"""NET, the format of Hugin: `node` blocks with states, `potential` blocks with data."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, NetworkBuilder
from toolchain.networks.scanner import Scanner

_COMMENTS: Final = r"%[^\n]*"
_OTHER_NODES: Final = {"continuous", "utility", "decision", "function"}


def read_net(data: bytes, builder: NetworkBuilder) -> None:
    """Read a NET file of discrete chance nodes; in `data`, parents are in order and the child is fastest."""
    text = Scanner(data, builder.path, signs="{}()|;,=", comments=_COMMENTS)
    in_class = False
    while (block := text.next()) or text.quoted:
        match block:
            case "class" if not in_class:
                builder.name(text.word("the class's name"))
                text.sign("{")
                in_class = True
            case "}" if in_class:
                in_class = False
            case "net" if text.peek() == "{":
                text.sign("{")
                text.skip("}")
            case "discrete":
                text.sign("node")
                _node(text, builder)
            case "node":
                _node(text, builder)
            case "potential":
                _potential(text, builder)
            case _ if block in _OTHER_NODES:
                raise text.error(f"a {block} node: only discrete chance nodes can be read")
            case _ if in_class:
                text.sign("=")
                text.skip(";")
            case _:
                raise text.error(f"expected net, node or potential, found {block[:40]!r}")
    if in_class:
        raise text.error("expected '}' of the class, found the end of the file")


def _keys(text: Scanner) -> Iterator[str]:
    text.sign("{")
    while (key := text.next()) != "}":
        if not key:
            raise text.error("expected '}', found the end of the file")
        text.sign("=")
        yield key


def _node(text: Scanner, builder: NetworkBuilder) -> None:
    name = text.word("a node's name")
    states: list[str] | None = None
    for key in _keys(text):
        if key == "states":
            text.sign("(")
            states = text.words(")", "states", MAX_STATES)
            text.sign(";")
        else:
            text.skip(";")
    if states is None:
        raise text.error(f"the node {name} has no states")
    builder.variable(name, states, text)


def _potential(text: Scanner, builder: NetworkBuilder) -> None:
    child, parents = text.scope("a node's name", MAX_PARENTS)
    shape = builder.shape((*parents, child), text)
    values = None
    for key in _keys(text):
        if key == "data":
            numbers = text.numbers(";", int(np.prod(shape)), f"the data of {child}", between="(),")
            values = np.moveaxis(numbers.reshape(shape), -1, 0)
        else:
            text.skip(";")
    if values is None:
        raise text.error(f"the potential of {child} has no data")
    builder.distribution(child, parents, values, text)
