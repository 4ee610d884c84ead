"""Text that is safe for a terminal, with control characters and line ends escaped.

A path, a topic name or a server's answer may contain line ends and terminal control sequences.
"""

from typing import Final

_LONGEST: Final = 80
"""Maximum number of characters shown of a value."""


def one_line(text: str) -> str:
    r"""Return a text as one line. Characters that are not printable are escaped, such as `\n` and `\x1b`."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def lines_of(text: str) -> str:
    """Return a text of several lines, such as a traceback, with each line escaped as in `one_line`."""
    return "\n".join(map(one_line, text.split("\n")))


def shown(value: object) -> str:
    """Return a value as text, cut to 80 characters. Empty or unprintable text, or text with outer spaces, is quoted."""
    text = str(value)
    text = text if text.isprintable() and text and text.strip() == text else repr(text)
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "..."
