"""Readers of network files in plain text: BIF, UAI, and Hugin's NET. All readers use the class `Scanner`."""

import math
import re
from collections.abc import Iterator
from copy import copy
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import NetworkFileError
from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, MAX_VARIABLES, ROUNDING, NetworkBuilder

_SHOWN: Final = 40


class Scanner:
    """A forward scanner. Its methods raise a NetworkFileError for an unexpected token."""

    def __init__(self, data: bytes, path: Path, *, signs: str = "{}()[]|;,", comments: str) -> None:
        """Scan the bytes of a file.

        Each character of `signs` is a token, and ends a word. `comments` is a regular expression that matches a whole
        comment. If a comment begins with `/*`, the expression matches only the `/*`, and the scanner finds the `*/`.
        """
        self._path = path
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as reason:
            line = data.count(b"\n", 0, reason.start) + 1
            raise NetworkFileError("not UTF-8 text", path=path, line=line) from None
        self._text = text
        self._start = self._end = 0
        self._text = self._without(re.compile(rf'"[^"\n]*"|{comments}'))
        signs = re.escape(signs)
        self._signs = re.compile(f"[{signs}]")
        self._token = re.compile(rf'\s*(?:"([^"\n]*)"|([{signs}])|([^\s{signs}"]+)|(\Z)|(.))')
        self.quoted = False
        """True if the last word was quoted."""

    def error(self, sentence: str) -> NetworkFileError:
        """Return an error that names the line of the last token."""
        start = self._end - len(self._text[self._start : self._end].lstrip())
        line = self._text.count("\n", 0, start) + 1
        return NetworkFileError(sentence, path=self._path, line=line)

    def next(self) -> str:
        """Consume and return the next token. Return an empty string at the end of the text.

        A token is a word, a quoted word without its quotes, or a sign such as `{`.
        """
        match = self._token.match(self._text, self._end)
        if match is None:  # the last alternative matches any character
            raise AssertionError
        self._start, self._end = match.span()
        self.quoted = match[1] is not None
        if match[5] is not None:
            raise self.error(f"{match[5]!r} opens a quote that is not closed")
        return match[match.lastindex or 4]

    def peek(self) -> str:
        """Return the next token without consuming it."""
        start, end, quoted = self._start, self._end, self.quoted
        piece = self.next()
        self._start, self._end, self.quoted = start, end, quoted
        return piece

    def sign(self, wanted: str) -> None:
        """Consume a sign or a keyword."""
        found = self.next()
        if found != wanted or self.quoted:
            raise self.error(f"expected {wanted!r}, found {_shown(found)}")

    def word(self, what: str) -> str:
        """Consume and return a word, plain or quoted. Errors call the word `what`."""
        found = self.next()
        if not self.quoted and (not found or self._is_sign(found)):
            raise self.error(f"expected {what}, found {_shown(found)}")
        return found

    def words(self, end: str, what: str, most: int) -> list[str]:
        """Consume words up to the sign `end`, and return them. More than `most` words are an error.

        Commas between words are optional.
        """
        found: list[str] = []
        while True:
            piece = self.next()
            if piece == end and not self.quoted:
                return found
            if piece == "," and not self.quoted and found:
                continue
            if not self.quoted and (not piece or self._is_sign(piece)):
                raise self.error(f"expected {what} or {end!r}, found {_shown(piece)}")
            if len(found) == most:
                raise self.error(f"more than {most} of {what}")
            found.append(piece)

    def scope(self, what: str, most: int) -> tuple[str, list[str]]:
        """Consume `( CHILD | PARENTS )` or `( CHILD )`. Errors call the child `what`."""
        self.sign("(")
        child = self.word(what)
        separator = self.next()
        if separator not in {"|", ")"}:
            raise self.error(f"expected '|' or ')', found {_shown(separator)}")
        return child, self.words(")", "parents", most) if separator == "|" else []

    def count(self, what: str, most: int) -> int:
        """Consume and return a whole number from 0 to `most`."""
        word = self.word(what)
        if not (word.isascii() and word.isdigit() and len(word) <= 9) or int(word) > most:
            raise self.error(f"expected {what}, 0 to {most}, found {_shown(word)}")
        return int(word)

    def numbers(self, end: str, wanted: int, what: str, *, between: str = ",") -> NDArray[np.float64]:
        """Consume and return numbers up to the sign `end`: float64[wanted]. Signs in `between` count as spaces."""
        stop = self._text.find(end, self._end)
        if stop < 0:
            self._start = self._end = len(self._text)
            raise self.error(f"expected {end!r}, found the end of the file")
        piece = self._text[self._end : stop]
        begin, self._start, self._end = self._end, stop, stop + len(end)
        if "(" in between and piece.count("(") != piece.count(")"):
            raise self.error(f"the brackets of {what} don't match")
        for sign in between:
            piece = piece.replace(sign, " ")
        return self._floats(piece.split(maxsplit=wanted), wanted, what, begin)

    def next_numbers(self, wanted: int, what: str) -> NDArray[np.float64]:
        """Consume and return numbers separated by white space: float64[wanted]."""
        begin, words = self._end, []
        for _ in range(wanted):
            word = self.next()
            if not word:
                break
            words.append(word)
        return self._floats(words, wanted, what, begin)

    def skip(self, end: str) -> None:
        """Consume everything up to and including the next sign `end` that is not in brackets or quotes."""
        depth = 0
        while True:
            piece = self.next()
            if self.quoted:
                continue
            if not piece:
                raise self.error(f"expected {end!r}, found the end of the file")
            if piece == end and depth == 0:
                return
            depth += (piece in "({[") - (piece in ")}]")
            if depth < 0:
                raise self.error(f"expected {end!r}, found {piece!r}")

    def _without(self, comments: re.Pattern[str]) -> str:
        """Return the text with comments replaced by spaces, keeping line numbers."""
        parts, end, at = [], 0, 0
        while match := comments.search(self._text, at):
            begin, at = match.span()
            if match[0].startswith('"'):
                continue
            if match[0] == "/*":
                at = self._text.find("*/", at) + 2
                if at < 2:
                    self._start, self._end = begin, begin + 2
                    raise self.error("this comment is not closed")
            parts += [self._text[end:begin], " " + "\n" * self._text.count("\n", begin, at)]
            end = at
        return "".join(parts) + self._text[end:]

    def _is_sign(self, piece: str) -> bool:
        return self._signs.fullmatch(piece) is not None

    def _floats(self, words: list[str], wanted: int, what: str, begin: int) -> NDArray[np.float64]:
        """Return words as numbers, or raise an error if there are not `wanted`; words beyond are not converted."""
        values = []
        for word in words[:wanted]:
            try:
                values.append(_float(word))
            except ValueError:
                at = self._text.find(word, begin)
                self._start, self._end = at, at + 1
                raise self.error(f"{_shown(word)} in {what} is not a number") from None
        if len(words) != wanted:
            count = f"more than {wanted}" if len(words) > wanted else str(len(words))
            raise self.error(f"{what} has {count} numbers, expected {wanted}")
        return np.array(values)


def _float(word: str) -> float:
    number = float(word)
    if "_" in word or math.isnan(number):  # the former is the notation of Python
        raise ValueError
    return number


def _shown(piece: str) -> str:
    if not piece:
        return "the end of the file"
    return repr(piece if len(piece) <= _SHOWN else piece[:_SHOWN] + "...")


# BIF, the Interchange Format for Bayesian networks (version 0.15): `variable` and `probability` blocks

_BIF_COMMENTS: Final = r"//[^\n]*|/\*"


def read_bif(data: bytes, builder: NetworkBuilder) -> None:
    """Read a BIF file into a builder.

    In a `table`, the child varies slowest and the last parent fastest. `(a, b) ...` defines the row for the parents'
    states a and b, and `default ...` all other rows.
    """
    text = Scanner(data, builder.path, comments=_BIF_COMMENTS)
    while (block := text.next()) or text.quoted:
        match block:
            case "network":
                builder.name(text.word("the network's name"))
                text.sign("{")
                while text.peek() != "}":
                    text.sign("property")
                    text.skip(";")
                text.sign("}")
            case "variable":
                _bif_variable(text, builder)
            case "probability":
                _bif_probability(text, builder)
            case _:
                raise text.error(f"expected network, variable or probability, found {block[:40]!r}")


def _bif_variable(text: Scanner, builder: NetworkBuilder) -> None:
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


def _bif_probability(text: Scanner, builder: NetworkBuilder) -> None:
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


# NET, the format of Hugin: `node` blocks with states, `potential` blocks with data

_NET_COMMENTS: Final = r"%[^\n]*"
_OTHER_NODES: Final = {"continuous", "utility", "decision", "function"}


def read_net(data: bytes, builder: NetworkBuilder) -> None:
    """Read a NET file of discrete chance nodes into a builder.

    In a table, the first parent varies slowest and the child fastest.
    """
    text = Scanner(data, builder.path, signs="{}()|;,=", comments=_NET_COMMENTS)
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
                _net_node(text, builder)
            case "node":
                _net_node(text, builder)
            case "potential":
                _net_potential(text, builder)
            case _ if block in _OTHER_NODES:
                raise text.error(f"a {block} node: only discrete chance nodes can be read")
            case _ if in_class:
                text.sign("=")
                text.skip(";")
            case _:
                raise text.error(f"expected net, node or potential, found {block[:40]!r}")
    if in_class:
        raise text.error("expected '}' of the class, found the end of the file")


def _net_keys(text: Scanner) -> Iterator[str]:
    text.sign("{")
    while (key := text.next()) != "}":
        if not key:
            raise text.error("expected '}', found the end of the file")
        text.sign("=")
        yield key


def _net_node(text: Scanner, builder: NetworkBuilder) -> None:
    name = text.word("a node's name")
    states: list[str] | None = None
    for key in _net_keys(text):
        if key == "states":
            text.sign("(")
            states = text.words(")", "states", MAX_STATES)
            text.sign(";")
        else:
            text.skip(";")
    if states is None:
        raise text.error(f"the node {name} has no states")
    builder.variable(name, states, text)


def _net_potential(text: Scanner, builder: NetworkBuilder) -> None:
    child, parents = text.scope("a node's name", MAX_PARENTS)
    shape = builder.shape((*parents, child), text)
    values = None
    for key in _net_keys(text):
        if key == "data":
            numbers = text.numbers(";", int(np.prod(shape)), f"the data of {child}", between="(),")
            values = np.moveaxis(numbers.reshape(shape), -1, 0)
        else:
            text.skip(";")
    if values is None:
        raise text.error(f"the potential of {child} has no data")
    builder.distribution(child, parents, values, text)


# UAI, a network of only numbers, BAYES or MARKOV; its variables are named 0, 1, 2 and so on

_MAX_FACTORS: Final = 4 * MAX_VARIABLES
_UAI_COMMENTS: Final = r"#[^\n]*|(?m:^c\b[^\n]*)"


def read_uai(data: bytes, builder: NetworkBuilder) -> None:
    """Read a UAI file. A preamble (kind, sizes, variables of each factor) is followed by the numbers of each factor.

    In the format, a factor's last variable varies fastest. In a BAYES file, this variable is the child.

    pgmpy 0.1 to 1.1 writes each table with its axes reversed, so that the first variable varies fastest and the child
    slowest. If a table sums to 1 only in that order, the whole file is read in that order. pyagrum 3.3.1 writes the
    first parent fastest; this is not detected.
    """
    text = Scanner(data, builder.path, comments=_UAI_COMMENTS)
    kind = text.word("BAYES or MARKOV")
    if kind not in {"BAYES", "MARKOV"}:
        raise text.error(f"expected BAYES or MARKOV, found {kind[:40]!r}")
    variables = text.count("the number of variables", MAX_VARIABLES)
    for number in range(variables):
        builder.variable(str(number), text.count("a variable's size", MAX_STATES), text)
    factors = text.count("the number of factors", _MAX_FACTORS)
    scopes = []
    for _ in range(factors):
        size = text.count("a factor's number of variables", MAX_PARENTS + 1)
        scopes.append(tuple(str(text.count("a variable", variables - 1)) for _ in range(size)))
    tables: list[tuple[tuple[str, ...], NDArray[np.float64], Scanner]] = []
    for number, scope in enumerate(scopes):
        what = f"factor {number}"
        shape = builder.shape(scope, text)
        given = text.count(f"the number of entries of {what}", 10**9 - 1)
        if given != math.prod(shape):
            raise text.error(f"{what} is to have {given} entries, but its variables make {math.prod(shape)}")
        values = text.next_numbers(given, what).reshape(shape)
        if kind == "BAYES" and scope:
            tables.append((scope, values, copy(text)))  # at the line of its last number, for errors
        else:
            builder.potential(scope, values, text)
    if rest := text.next():
        raise text.error(f"expected the end of the file after the last factor, found {rest[:40]!r}")
    reverses = any(_sums_to_1(_reversed(each), 0) and not _sums_to_1(each, -1) for _, each, _ in tables)
    for scope, values, place in tables:
        child_last = np.transpose(_reversed(values)) if reverses else values
        builder.distribution(scope[-1], scope[:-1], np.moveaxis(child_last, -1, 0), place)


def _reversed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the table as pgmpy wrote it: the same numbers, with the axes of the scope in reverse order."""
    return values.reshape(values.shape[::-1])


def _sums_to_1(values: NDArray[np.float64], axis: int) -> bool:
    return bool(np.allclose(values.sum(axis=axis), 1, rtol=0, atol=ROUNDING))
