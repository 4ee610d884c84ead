"""BIF, the Interchange Format for Bayesian networks (version 0.15): `variable` and `probability` blocks."""

import math
from typing import Final

import numpy as np

from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, NetworkBuilder
from toolchain.networks.scanner import Scanner

_COMMENTS: Final = r"//[^\n]*|/\*"


def read_bif(data: bytes, builder: NetworkBuilder) -> None:
    """Read a BIF file.

    In `table`, the child varies slowest and the last parent fastest; `(a, b) ...` defines one row, `default
    ...` all others.

    Raises:
        NetworkFileError: The file is not BIF; the sentence contains the line and the expected token.
    """
    text = Scanner(data, builder.path, comments=_COMMENTS)
    while (block := text.next()) or text.quoted:
        match block:
            case "network":
                builder.name(text.word("the network's name"))
                _properties(text)
            case "variable":
                _variable(text, builder)
            case "probability":
                _probability(text, builder)
            case _:
                raise text.error(f"expected network, variable or probability, found {block[:40]!r}")


def _properties(text: Scanner) -> None:
    text.sign("{")
    while text.peek() != "}":
        text.sign("property")
        text.skip(";")
    text.sign("}")


def _variable(text: Scanner, builder: NetworkBuilder) -> None:
    name = text.word("a variable's name")
    states: list[str] | None = None
    text.sign("{")
    while (entry := text.next()) != "}":
        if entry == "property":
            text.skip(";")
        elif entry == "type":
            text.sign("discrete")
            text.sign("[")
            count = text.count("the number of states", MAX_STATES)
            text.sign("]")
            text.sign("{")
            states = text.words("}", "states", MAX_STATES)
            text.sign(";")
            if len(states) != count:
                raise text.error(f"{name} is to have {count} states, but {len(states)} are named")
        else:
            raise text.error(f"expected type, property or '}}', found {entry[:40] or 'the end'!r}")
    if states is None:
        raise text.error(f"the variable {name} has no type")
    builder.variable(name, states, text)


def _probability(text: Scanner, builder: NetworkBuilder) -> None:
    child, parents = text.scope("a variable's name", MAX_PARENTS)
    shape = builder.shape((child, *parents), text)
    rows = math.prod(shape[1:])
    values = np.full((shape[0], rows), np.nan)
    default = None
    text.sign("{")
    while (entry := text.next()) != "}":
        match entry:
            case "property":
                text.skip(";")
            case "table":
                if not np.isnan(values).all():
                    raise text.error(f"{child} has rows or a table before this one")
                values[:] = text.numbers(";", values.size, f"the table of {child}").reshape(values.shape)
            case "default":
                if default is not None:
                    raise text.error(f"{child} has two defaults")
                default = text.numbers(";", shape[0], f"the default of {child}")
            case "(":
                labels = text.words(")", "the parents' states", MAX_PARENTS)
                if len(labels) != len(parents):
                    raise text.error(f"{len(labels)} states for the {len(parents)} parents of {child}")
                at = 0
                for parent, size, label in zip(parents, shape[1:], labels, strict=True):
                    at = at * size + builder.state(parent, label, text)
                if not np.isnan(values[0, at]):
                    raise text.error(f"{child} has two rows for ({', '.join(labels)})")
                values[:, at] = text.numbers(";", shape[0], f"a row of {child}")
            case _:
                raise text.error(f"expected table, default, a row or '}}', found {entry[:40] or 'the end'!r}")
    missing = np.isnan(values[0])
    if default is not None:
        values[:, missing] = default[:, np.newaxis]
    elif missing.any():
        raise text.error(f"{np.count_nonzero(missing)} of the {rows} rows of {child} are not given")
    builder.distribution(child, parents, values.reshape(shape), text)
