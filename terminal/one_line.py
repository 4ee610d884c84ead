"""What a person is told is one line, whatever stands in it: control characters are seen and do nothing.

A path, a topic's name or a server's words may hold line ends, and what a terminal takes for orders.
"""

from __future__ import annotations

from typing import Final

_SHOWN: Final = 80
"""Characters of a value that are shown: what is typed may be anything."""


def one_line(text: str) -> str:
    r"""Return a text as one line in which all that is not printable stands escaped: `\n`, `\x1b`, `\u202e`."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def lines_of(text: str) -> str:
    """Return a text of several lines, such as a traceback, with each of them as `one_line` has it."""
    return "\n".join(map(one_line, text.split("\n")))


def shown(value: object) -> str:
    """Return a value so that it is seen in a sentence: in quotation marks where it is blank or not printable, and cut."""
    text = str(value)
    text = text if text.isprintable() and text and text.strip() == text else repr(text)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."
