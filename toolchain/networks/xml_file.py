"""A reader of XML elements, without external or internal entities and of bounded depth, for network files."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import NetworkFileError

_MAX_DEPTH: Final = 16
_DECIMAL: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Line:
    """A line of an XML file, for errors."""

    path: Path
    number: int

    def error(self, sentence: str) -> NetworkFileError:
        """Return an error with the file and the line before the sentence."""
        return NetworkFileError(sentence, path=self.path, line=self.number)


def decimals(words: Sequence[str], child: str, line: Line) -> NDArray[np.float64]:
    """Return the words of a table as numbers, or raise a NetworkFileError; `1_0`, `nan` and `inf` are not decimal."""
    for word in words:
        if not _DECIMAL.fullmatch(word):
            raise line.error(f"{word[:40]!r} in the table of {child} is not a number")
    return np.array([float(word) for word in words])


class XmlFile:
    """A parser that calls `started(name, attributes)` and `ended(name, text)` for every element.

    The text is that between the last start and the end, so it is complete for elements without others inside.
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
    def here(self) -> Line:
        """The line that is being parsed."""
        return Line(self._path, self._parser.CurrentLineNumber)

    def parse(self, data: bytes) -> None:
        """Parse a whole file, or raise a NetworkFileError with the line."""
        try:
            self._parser.Parse(data, True)
        except expat.ExpatError as reason:
            raise Line(self._path, reason.lineno).error(expat.ErrorString(reason.code)) from None
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
