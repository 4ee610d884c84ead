"""A scanner for text files: words, quoted words, signs and numbers, with their lines."""

import math
import re
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import NetworkFileError

_SHOWN: Final = 40


class Scanner:
    """A forward scanner; its methods raise a NetworkFileError for an unexpected token."""

    def __init__(self, data: bytes, path: Path, *, signs: str = "{}()[]|;,", comments: str = "") -> None:
        """Scan the bytes of a file.

        `signs` are tokens themselves, and end a word. `comments` is a regular expression for comments, or
        only for the beginning of /* ... */.
        """
        self._path = path
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as reason:
            line = data.count(b"\n", 0, reason.start) + 1
            raise NetworkFileError("not UTF-8 text", path=path, line=line) from None
        self._text = text
        self._start = self._end = 0
        if comments:
            self._text = self._without(re.compile(rf'"[^"\n]*"|{comments}'))
        signs = re.escape(signs)
        self._signs = re.compile(f"[{signs}]")
        self._token = re.compile(rf'\s*(?:"([^"\n]*)"|([{signs}])|([^\s{signs}"]+)|(\Z)|(.))')
        self.quoted = False
        """True if the last word was quoted."""

    def error(self, sentence: str) -> NetworkFileError:
        """Return an error at the line of the last token."""
        start = self._end - len(self._text[self._start : self._end].lstrip())
        line = self._text.count("\n", 0, start) + 1
        return NetworkFileError(sentence, path=self._path, line=line)

    def next(self) -> str:
        """Consume the next token: a word, a quoted word without its quotes, or a sign; empty at the end."""
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
        """Consume a word, plain or quoted; `what` names it in errors."""
        found = self.next()
        if not self.quoted and (not found or self._is_sign(found)):
            raise self.error(f"expected {what}, found {_shown(found)}")
        return found

    def words(self, end: str, what: str, most: int) -> list[str]:
        """Consume at most `most` words up to a sign and the sign, with or without commas."""
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
        """Consume `( CHILD | PARENTS )` or `( CHILD )`; `what` names the child in errors."""
        self.sign("(")
        child = self.word(what)
        separator = self.next()
        if separator not in {"|", ")"}:
            raise self.error(f"expected '|' or ')', found {_shown(separator)}")
        return child, self.words(")", "parents", most) if separator == "|" else []

    def count(self, what: str, most: int) -> int:
        """Consume a whole number from 0 to `most`."""
        word = self.word(what)
        if not (word.isascii() and word.isdigit() and len(word) <= 9) or int(word) > most:
            raise self.error(f"expected {what}, 0 to {most}, found {_shown(word)}")
        return int(word)

    def numbers(self, end: str, wanted: int, what: str, *, between: str = ",") -> NDArray[np.float64]:
        """Consume numbers up to a sign and the sign, ignoring the signs `between`: float64[wanted]."""
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
        """Consume this many numbers separated by white space: float64[wanted]."""
        begin, words = self._end, []
        for _ in range(wanted):
            word = self.next()
            if not word:
                break
            words.append(word)
        return self._floats(words, wanted, what, begin)

    def skip(self, end: str) -> None:
        """Consume everything up to a sign and the sign, except for signs in brackets and quotes."""
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
        """Return words as numbers; the last one may be the rest of the text, and is only counted."""
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
