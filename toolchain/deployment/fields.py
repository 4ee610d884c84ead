"""The types of the values in `deployment.toml`: URIs, topics, message types, paths in a message, names, hashes."""

import re
from collections import Counter
from typing import Annotated, Final, TypeVar
from urllib.parse import urlsplit

from pydantic import AfterValidator, FailFast, Field

NAME_MAX: Final = 200
"""Maximum number of characters in a name."""

_TYPE = re.compile(r"[A-Za-z]\w*/(?:msg/)?[A-Za-z]\w*")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_TOPIC = re.compile(r"/?[A-Za-z]\w*(?:/\w+)*")
MESSAGE_PATH = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z_][A-Za-z0-9_]*|\[[0-9]{1,9}\])*")


ROBOT: Final = "robot:"
"""Prefix of a URI that names a robot, which the services look up when they start."""


def websocket_uri(uri: str) -> str:
    """Return a WebSocket URI or `robot:NAME`, or raise a ValueError."""
    if re.fullmatch(rf"{ROBOT}[0-9]+(/.*)?", uri):
        raise ValueError(f"{uri!r} would be a robot whose name is a number; did you mean 'ws://{uri}'?")
    if uri.startswith(ROBOT) and uri.removeprefix(ROBOT).strip() and uri.isprintable():
        return uri
    try:
        is_whole = bool(urlsplit(uri).hostname) and urlsplit(uri).port != 0
    except ValueError:  # a port beyond 65535, half an IPv6 address
        is_whole = False
    if not is_whole or not re.fullmatch(r"wss?://[^\s/?#]+\S*", uri):
        raise ValueError(
            f"{uri!r} is not a WebSocket URI; expected one like 'ws://robot:9090' (or {ROBOT}NAME)"
        )
    return uri


def _topic(topic: str) -> str:
    if not _TOPIC.fullmatch(topic):
        raise ValueError(f"{topic!r} is not a topic name; expected one like '/boat/sensors'")
    if not topic.startswith("/"):
        raise ValueError(
            f"{topic!r} does not begin with a slash; write '/{topic}', which means the same on every server"
        )
    return topic


def _matching(pattern: re.Pattern[str], what: str) -> AfterValidator:
    def check(text: str) -> str:
        if not pattern.fullmatch(text):
            raise ValueError(f"{text!r} is not {what}")
        return text

    return AfterValidator(check)


def _not_zero(step: float) -> float:
    if step == 0:
        raise ValueError("a step of 0 would give every value the same address")
    return step


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError(f"{name!r} has a character that cannot be printed")
    return name


WebSocketUri = Annotated[str, AfterValidator(websocket_uri)]
Topic = Annotated[str, AfterValidator(_topic)]
MessageType = Annotated[
    str, _matching(_TYPE, "a message type; expected one like 'std_msgs/Float64' or 'std_msgs/msg/Float64'")
]
_A_PATH = "a path in a message; expected one like 'pose.position.x', 'ranges[3]' or a field's name"
MessagePath = Annotated[str, _matching(MESSAGE_PATH, _A_PATH)]
PathOrName = Annotated[str, _matching(re.compile(f"(?:{MESSAGE_PATH.pattern})?"), _A_PATH)]
"""A path, or an empty text to search the message for the name of the variable."""
Name = Annotated[str, Field(min_length=1, max_length=NAME_MAX), AfterValidator(_printable)]
"""One printable line, because names also come from network files."""
Sha256 = Annotated[str, _matching(_SHA256, "a SHA-256 hash; expected 64 hexadecimal digits")]
Step = Annotated[float, AfterValidator(_not_zero)]
TOPIC_BYTES_MIN, TOPIC_BYTES_MAX = 1 << 10, 1 << 28
"""Smallest and largest limit of the size of a topic's messages, in bytes."""
TopicBytes = Annotated[int, Field(ge=TOPIC_BYTES_MIN, le=TOPIC_BYTES_MAX)]

Item = TypeVar("Item")
# TOML arrays and strings become tuples and enums; their contents stay strict.
Sequence = Annotated[tuple[Item, ...], Field(strict=False), FailFast()]
Choice = Annotated[Item, Field(strict=False)]
Unit = Annotated[
    str, Field(max_length=NAME_MAX, exclude_if=lambda unit: not unit), AfterValidator(_printable)
]
"""A unit such as m; an empty one is omitted from the file and from its hash."""
# empty states are omitted from the file and from its hash
States = Annotated[tuple[Name, ...], Field(strict=False, exclude_if=lambda states: not states)]


def states_fit(name: str, states: tuple[str, ...], size: int) -> None:
    """Raise a ValueError if the number of state names differs from the number of values."""
    if states and len(states) != size:
        raise ValueError(f"{name} has {size} values, but {len(states)} states are named")


def names_differ(kind: str, names: list[str]) -> None:
    """Raise a ValueError if several entries of one kind have the same name."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise ValueError(f"[[{kind}]] has {twice[0]!r} twice; names must differ")
