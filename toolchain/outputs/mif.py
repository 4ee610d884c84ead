"""Memory initialisation files (MIF), the text files with the initial contents of an FPGA's memories (thesis 3.2).

Files are written in one canonical form, with one hexadecimal entry per line. Files are read in every form of
Quartus, with five radices and both kinds of comments. Runs (`A : D0 D1;`) and ranges (`[A0..A1] : D;`) are read, too.
The random numbers of `rng = table` are generated, or read from a user's MIF.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.bm2 import BM2Machine
from machines.rng import GOLDEN, mix
from toolchain.bounded_files import read_bounded
from toolchain.errors import BuildError, MifError

MOST_BYTES: Final = 1 << 30
"""Maximum size of a file in bytes."""

MOST_WORDS: Final = 1 << 24
"""Maximum number of words in a memory. Without this limit, a short file could declare a memory of any depth."""

MOST_WIDTH: Final = 1 << 20
"""Maximum width of a word in bits, far above the 65,536 bits that 4096 lines with codes of 16 bits need."""

_BASES: Final = {"BIN": 2, "OCT": 8, "DEC": 10, "UNS": 10, "HEX": 16}
_DECIMAL_DIGITS: Final = 4000  # Python refuses longer decimal numbers, because the time is quadratic

_TOKEN: Final = re.compile(
    r"(?P<newline>\n)|(?P<space>[^\S\n]+)|(?P<comment>--[^\n]*|%[^%]*%)|(?P<dots>\.\.)|(?P<sign>[=:;\[\]])"
    r"|(?P<word>[A-Za-z0-9_]+|[+-][0-9]+)|(?P<other>.)",
    re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class Mif:
    """The contents of a memory."""

    width: int
    """Number of bits of a word."""
    words: tuple[int, ...]
    """All words, from address 0. A word at an omitted address is 0, as in Quartus."""


def mif_lines(width: int, depth: int, words: Iterable[int], comments: Iterable[str] = ()) -> Iterator[str]:
    """Yield the lines of a MIF in canonical form, with one hexadecimal entry per line.

    `words` are all words from address 0. `comments` are comment lines for the beginning of the file. Unprintable
    characters in comments are escaped.
    """
    for comment in comments:
        yield f"-- {printable(comment)}\n"
    yield f"WIDTH={width};\nDEPTH={depth};\nADDRESS_RADIX=HEX;\nDATA_RADIX=HEX;\nCONTENT BEGIN\n"
    address_digits, digits = len(f"{depth - 1:X}"), -(-width // 4)
    for address, word in enumerate(words):
        yield f"{address:0{address_digits}X} : {word:0{digits}X};\n"
    yield "END;\n"


def printable(text: str) -> str:
    """Escape a text to one line of printable ASCII, which all tools accept in comments."""
    return text.encode("unicode_escape").decode("ascii")


def read_mif(path: Path, due: tuple[int, int] | None = None) -> Mif:
    """Read the contents of a memory from any form of MIF. A MifError names the line.

    `due` is the expected width and depth. With `due`, the file must have this size, and no address may be missing.
    """
    data = read_bounded(path, MOST_BYTES, MifError)
    return parse_mif(data.decode("latin-1"), str(path), due)


def parse_mif(text: str, name: str = "the MIF", due: tuple[int, int] | None = None) -> Mif:
    """Return the contents of a memory from the text of a MIF. A MifError names the line and the expected token."""
    return _Reader(text, name, due).read()


class _Reader:
    """A reader of a MIF's tokens. `_kind` and `_word` describe the current token, and `_line` is the token's line."""

    def __init__(self, text: str, name: str, due: tuple[int, int] | None) -> None:
        self._name = name
        self._due = {} if due is None else {"WIDTH": due[0], "DEPTH": due[1]}
        self._line = 1
        self._tokens = self._tokenise(text)
        self._kind = self._word = ""
        self._next()

    def read(self) -> Mif:
        width, depth, address_radix, data_radix = self._header()
        words: list[int | None] = [None] * depth
        while not self._at("END"):
            self._entry(words, width, address_radix, data_radix)
        self._next()
        if self._kind:  # the semicolon after END is often omitted
            self._expect(";")
        if self._kind:
            self._refuse("the end of the file after END;")
        if self._due and None in words:
            self._fail(f"address {words.index(None)} is missing; expected 0 to {depth - 1}")
        return Mif(width, tuple(word or 0 for word in words))

    def _header(self) -> tuple[int, int, str, str]:
        sizes: dict[str, int] = {}
        radices = {"ADDRESS_RADIX": "HEX", "DATA_RADIX": "HEX"}
        seen: set[str] = set()
        while not self._at("CONTENT"):
            key = self._word.upper()
            if key not in {"WIDTH", "DEPTH", *radices}:
                self._refuse("WIDTH, DEPTH, ADDRESS_RADIX, DATA_RADIX or CONTENT BEGIN")
            if key in seen:
                self._fail(f"{key} is given twice")
            seen.add(key)
            self._next()
            self._expect("=")
            if key in radices:
                if self._word.upper() not in _BASES:
                    self._refuse(f"one of {', '.join(_BASES)}")
                radices[key] = self._word.upper()
            else:
                sizes[key] = self._number("DEC", f"a number for {key}")
                most = MOST_WIDTH if key == "WIDTH" else MOST_WORDS
                if not 1 <= sizes[key] <= most:
                    self._fail(f"{key} is {sizes[key]}, expected 1 to {most}")
                if sizes[key] != self._due.get(key, sizes[key]):
                    self._fail(f"{key} is {sizes[key]}, but this machine's memory has {self._due[key]}")
            self._next()
            self._expect(";")
        for key in ("WIDTH", "DEPTH"):
            if key not in sizes:
                self._fail(f"{key} is missing before CONTENT")
        self._next()
        if not self._at("BEGIN"):
            self._refuse("BEGIN after CONTENT")
        self._next()
        return sizes["WIDTH"], sizes["DEPTH"], radices["ADDRESS_RADIX"], radices["DATA_RADIX"]

    def _entry(self, words: list[int | None], width: int, address_radix: str, data_radix: str) -> None:
        line, is_range = self._line, self._word == "["
        if is_range:
            self._next()
        first = last = self._address(address_radix, len(words))
        if is_range:
            if self._kind != "dots":
                self._refuse("'..' between the ends of a range")
            self._next()
            last = self._address(address_radix, len(words))
            if last < first:
                self._fail(f"the range ends at address {last}, before it begins at {first}")
            self._expect("]")
        self._expect(":")
        values: list[int] = []
        while self._word != ";":
            values.append(self._data(width, data_radix))
            if len(values) > len(words):
                self._fail(f"the entry of line {line} has more words than the memory, which has {len(words)}")
        if not values:
            self._refuse("a word after ':'")
        end = last if is_range else first + len(values) - 1
        if end >= len(words):
            self._fail(
                f"the entry of line {line} goes on to address {end}, but the last one is {len(words) - 1}"
            )
        for place, address in enumerate(range(first, end + 1)):
            if words[address] is not None:
                self._fail(f"address {address} is given twice, the second time by the entry of line {line}")
            # the words are repeated to fill the range
            words[address] = values[place % len(values)]
        self._next()

    def _address(self, radix: str, depth: int) -> int:
        address = self._number(radix, "an address or END;")
        if not 0 <= address < depth:
            self._fail(f"address {address} is outside the memory, whose last one is {depth - 1}")
        self._next()
        return address

    def _data(self, width: int, radix: str) -> int:
        word = self._number(radix, "a word or ';'")
        low = -(1 << (width - 1)) if radix == "DEC" else 0
        if not low <= word < 1 << width:
            self._fail(f"the word {_short(self._word)} ({radix}) doesn't fit {width} bits")
        self._next()
        return word % (1 << width)

    def _number(self, radix: str, expected: str) -> int:
        base = _BASES[radix]
        if self._kind != "word" or (self._word[0] in "+-" and radix != "DEC") or "_" in self._word:
            self._refuse(expected)
        if base == 10 and len(self._word) > _DECIMAL_DIGITS:
            self._fail(f"a decimal number of {len(self._word)} digits is too long; write wide words in HEX")
        try:
            return int(self._word, base)
        except ValueError:
            self._refuse(f"{expected}, in {radix}")

    def _tokenise(self, text: str) -> Iterator[tuple[str, str]]:
        for match in _TOKEN.finditer(text):
            kind = match.lastgroup
            if kind in {"newline", "comment"}:
                self._line += match[0].count("\n")
            elif kind == "other":
                if match[0] == "%":
                    self._fail("a comment that begins with % does not end")
                self._fail(f"{match[0]!r} is unexpected here")
            elif kind is not None and kind != "space":
                yield kind, match[0]

    def _next(self) -> None:
        self._kind, self._word = next(self._tokens, ("", ""))

    def _at(self, keyword: str) -> bool:
        return self._word.upper() == keyword

    def _expect(self, sign: str) -> None:
        if self._word != sign:
            self._refuse(f"'{sign}'")
        self._next()

    def _refuse(self, expected: str) -> NoReturn:
        found = repr(_short(self._word)) if self._kind else "the end of the file"
        self._fail(f"expected {expected}, found {found}")

    def _fail(self, what: str) -> NoReturn:
        raise MifError(what, path=self._name, line=self._line)


def _short(word: str) -> str:
    return word if len(word) <= 40 else word[:40] + "..."


LENGTH: Final = 1 << 16
"""Length of the table from `random_table`. For every permitted `prob_bits`, it is a multiple of 2**prob_bits."""


def table_length(machine: BM1Machine | BM2Machine) -> int:
    """Return the length of the machine's table of random numbers, or `LENGTH` if the machine has no table."""
    return LENGTH if machine.rng_table is None else machine.rng_table.size


def random_table(prob_bits: int) -> NDArray[np.uint32]:
    """Return all numbers of `prob_bits` bits, equally often and in random order, uint32[65536].

    Over the whole table, the probability of every code is therefore exact. The order comes from splitmix64, and is
    always the same.
    """
    keys = mix(np.arange(1, LENGTH + 1, dtype=np.uint64) * np.uint64(GOLDEN))
    numbers: NDArray[np.uint32] = (np.argsort(keys, kind="stable") % (1 << prob_bits)).astype(np.uint32)
    return numbers


def read_table(path: Path) -> NDArray[np.uint32]:
    """Return the random numbers in a user's MIF, uint32[length].

    Raises a MifError if the file is invalid, or a BuildError if its words have more than 32 bits.
    """
    mif = read_mif(path)
    if mif.width > 32:
        raise BuildError(
            f"{path} has words of {mif.width} bits; expected random numbers of at most 32, the codes' or more"
        )
    return np.array(mif.words, dtype=np.uint32)
