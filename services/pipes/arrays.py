"""The command `publisher` without a deployment: each line of numbers becomes a message (thesis 3.1, Publisher.jar)."""

import asyncio
import base64
import contextlib
import re
import sys
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

from bridge.client import Ros, Subscription
from bridge.codecs.message_check import SCALAR, Definitions, FieldType, bundled_definitions
from bridge.errors import MessageTooLargeError
from bridge.fields import Place, format_place
from bridge.names import ros1_type, ros_version_of_type
from services.errors import InputLineError, SettingsError
from services.pipeline.connections import (
    AdvertisedTopic,
    NotReceivableError,
    check_types,
    connect_all,
    refusals,
    reported_refusals,
)
from services.pipeline.result_topics import RESULTS_DEPTH, same_numbers
from services.pipes.lines import LINE_LIMIT, decoded, lines
from services.settings import Settings
from terminal.connection import report_waits
from terminal.output import say
from toolchain.deployment import Source

_EXPECTED: Final = "numbers: a JSON array such as [0.1, 0.9], or 0.1 0.9, or 0.1,0.9"
_NUMBER: Final = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_INTEGER: Final = re.compile(rb"[+-]?\d{1,40}")
_MULTI_ARRAY: Final = re.compile(r"std_msgs/((?:Float(?:32|64)|U?Int(?:8|16|32|64)))MultiArray")
_SHOWN: Final = 40
_MAX_FIELDS: Final = 10_000
_LONG: Final = 1 << 16
"""Bytes above which a line is converted in a thread, so that the event loop can still answer pings."""
_AHEAD: Final = 64
"""Maximum number of messages in flight, so that none is dropped from a queue here or in the server."""

# the largest double that rounds to a float32: its usual text, 3.4028235e+38, is above it
_FLOAT32_MAX: Final = float.fromhex("0x1.fffffefffffffp127")
_RANGES: Final[dict[str, tuple[float, float]]] = {
    **{f"int{bits}": (-(1 << bits - 1), (1 << bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, (1 << bits) - 1) for bits in (8, 16, 32, 64)},
    "char": (0, 255),
    **dict.fromkeys(("float32", "float"), (-_FLOAT32_MAX, _FLOAT32_MAX)),
    **dict.fromkeys(("float64", "double"), (-sys.float_info.max, sys.float_info.max)),
}
"""Lowest and highest number of each numeric type; `float` and `double` are the names in rosapi of ROS 2."""


@dataclass(frozen=True, slots=True)
class ArrayField:
    """One field of a message type: an array of numbers."""

    message_type: str
    place: Place
    kind: FieldType

    @property
    def path(self) -> str:
        """Path of the field in a message."""
        return format_place(self.place)

    def numbers(self, line: bytes, number: int) -> list[float]:
        """Convert a line to values of the array's element type, or raise an InputLineError with the line's `number`."""
        where = f"line {number} of standard input"
        text = line.strip()
        found: list[float]
        if text.startswith(b"["):
            found = decoded(text, number, list[int | float], _EXPECTED)
        else:
            found = []
            # not both separators, because "0,5 0,5" are two numbers where the decimal point is a comma
            for token in re.split(rb"\s*,\s*", text) if b"," in text else text.split():
                if not _NUMBER.fullmatch(token):
                    shown = token[:_SHOWN].decode(errors="replace")
                    raise InputLineError(
                        f"{where} has {shown!r}, which is not a number; expected {_EXPECTED}"
                    )
                found.append(int(token) if _INTEGER.fullmatch(token) else float(token))
        if self.kind.length not in (0, len(found)) or not found:
            some = self.kind.length or "one or more"
            raise InputLineError(
                f"{where} has {len(found)} numbers, but {self.path} of {self.message_type} has {some}"
            )
        return [self._fitting(value, where) for value in found]

    def _fitting(self, value: float, where: str) -> float:
        low, high = _RANGES[self.kind.element]
        is_whole = isinstance(low, int)
        # a float of this size may not be the integer that was written
        is_exact = not is_whole or isinstance(value, int) or (value == int(value) and abs(value) < 1 << 53)
        if not low <= value <= high or not is_exact:
            expected = f"an integer from {low} to {high}" if is_whole else f"a number up to {high:.4g}"
            raise InputLineError(
                f"{where} has {repr(value)[:_SHOWN]}, but {self.path} of {self.message_type} is {self.kind}: "
                f"expected {expected}"
            )
        return int(value) if is_whole else float(value)

    def message(self, numbers: list[float]) -> dict[str, Any]:
        """Return a message that contains only this array, filled with `numbers`. The server adds the other fields."""
        octets = self.kind.element in {"uint8", "char"}
        value: Any = bytes(map(int, numbers)) if octets else numbers
        for step in reversed(self.place):
            value = {step: value}
        message: dict[str, Any] = value
        return message

    def holds(self, message: dict[str, Any], numbers: list[float]) -> bool:
        """Return whether the array in a received message equals `numbers`, up to the rounding of a float32."""
        received: Any = message
        for step in self.place:
            received = received.get(step) if isinstance(received, dict) else None
        if isinstance(received, str):  # uint8[]
            with contextlib.suppress(ValueError):
                received = list(base64.b64decode(received))
        return same_numbers(received, numbers, rel_tol=1e-6, abs_tol=1e-37)


def array_field(definitions: Definitions, message_type: str, path: str | None) -> ArrayField:
    """Return the array of numbers at a path in a message type. Without a path, return the only array of the type.

    Raises:
        SettingsError: The type has no array of numbers at the path. Without a path, the type has no array or several.
    """
    arrays: dict[str, ArrayField] = {}
    waiting: list[tuple[Place, str]] = [((), ros1_type(message_type))]
    # bounded, because a server could answer with a type that contains itself
    for _ in range(_MAX_FIELDS):
        if not waiting:
            break
        outer, name = waiting.pop(0)
        for field, kind in definitions.get(name, {}).items():
            place = (*outer, field)
            if kind.length == SCALAR:
                waiting.append((place, kind.element))
            elif kind.element in _RANGES:
                arrays[format_place(place)] = ArrayField(message_type, place, kind)
    if path is None and len(arrays) == 1:
        (path,) = arrays
    if path not in arrays:
        there = ", ".join(f"{found} ({array.kind})" for found, array in arrays.items())
        wanted = "one array of numbers" if path is None else f"array of numbers {path}"
        raise SettingsError(
            f"{message_type} has no {wanted}; "
            + (f"choose with --field from: {there}" if there else "--type needs one with an array")
        )
    return arrays[path]


async def _definitions(ros: Ros, message_type: str) -> Definitions:
    """Return the fields of a type, from rosapi or rosbags (empty if unknown), or of a std_msgs array from its name."""
    name = ros1_type(message_type)
    if match := _MULTI_ARRAY.fullmatch(name):
        return {name: {"data": FieldType(match[1].lower(), 0)}}
    # before rosapi, which compares the names of types literally
    version = await ros.detect_ros_version() or ros_version_of_type(message_type) or 1
    if name in (known := await ros.message_details(message_type)):
        return known
    # in a thread, because loading rosbags would block the event loop for too long
    return await asyncio.to_thread(bundled_definitions, message_type, version)


async def publish_arrays(settings: Settings, source: Source, path: str | None) -> int:
    """Publish each line of standard input as a message of a topic. Wait until the server sends every message back.

    Raises:
        InputLineError: A line does not fit the array, a message is too large, or standard input is empty.
        SettingsError: The fields of the type are unknown, or `path` does not select exactly one array of numbers.
        BridgeError: The topic has another type, the server is unreachable, or a message did not come back.
    """
    async with contextlib.AsyncExitStack() as stack:
        uris, report = [source.uri], report_waits()
        ros = (await connect_all(stack, settings, uris, on_state=report, max_size=LINE_LIMIT))[source.uri]
        await check_types([(ros, source.topic, source.type)])
        if not (definitions := await _definitions(ros, source.type)):
            raise SettingsError(
                f"the fields of {source.type} are not known at {source.uri}: is the type right, and does rosapi run there?"
            )
        field = array_field(definitions, source.type, path)
        publication = await ros.advertise(source.topic, source.type)
        watched = ros.subscribe(source.topic, source.type, queue_size=RESULTS_DEPTH)
        say(f"publishing on {source.topic} at {source.uri}")
        echoes = _Echoes(field, watched, settings.seen_timeout)
        watching = asyncio.create_task(echoes.watch())
        stack.callback(watching.cancel)
        topic = AdvertisedTopic(ros, source.uri, source.topic, source.type)
        count = 0
        async for number, line in lines():
            convert = asyncio.to_thread(field.numbers, line, number) if len(line) > _LONG else None
            numbers = field.numbers(line, number) if convert is None else await convert
            try:
                await publication.publish(field.message(numbers))
            except MessageTooLargeError as error:
                raise InputLineError(f"line {number} of standard input: {error}") from error
            count += 1
            # what the server does not pass on at all is reported at once, and not at the end of an endless input
            if not await echoes.add(number, numbers, most=_AHEAD if count > 1 else 0) and count == 1:
                await _raise_refusal(topic)
        if not count:
            raise InputLineError(f"standard input is empty; expected {_EXPECTED} on each line")
        if not await echoes.at_most(0):
            await _raise_refusal(topic)
    if echoes.lost:
        raise NotReceivableError(
            f"{count} published, of which {len(echoes.lost)} were not seen on the wire within {settings.seen_timeout:g} s, "
            f"first line {echoes.lost[0]} of standard input"
        )
    say(f"{count} published")
    return 0


async def _raise_refusal(topic: AdvertisedTopic) -> None:
    """Raise a NotReceivableError if the server does not pass on the topic and says why."""
    if refused := await refusals([topic], settled=True) | reported_refusals([topic]):
        raise NotReceivableError(refused[topic.name])


class _Echoes:
    """Lines whose messages have not come back yet."""

    def __init__(self, field: ArrayField, watched: Subscription, limit: float) -> None:
        """Store the field to compare, the subscription of the topic, and the seconds after which a message is lost."""
        self._field = field
        self._watched = watched
        self._limit = limit

        # Number and values of each line, in the order of publication. A message comes before those published after
        # it, so the lines before one that is seen are lost.
        self._waiting: deque[tuple[int, list[float]]] = deque()
        self.lost: list[int] = []

        # Set when a message was seen; and whether any ever was: a server that sends none back must not cause waits.
        self._seen = asyncio.Event()
        self._has_seen = False

    async def watch(self) -> None:
        """Compare the topic's messages with the waiting lines, until cancelled."""
        async for received in self._watched:
            for at, (_, numbers) in enumerate(self._waiting):
                if self._field.holds(received.msg, numbers):
                    self.lost += [self._waiting.popleft()[0] for _ in range(at)]
                    self._waiting.popleft()
                    self._has_seen = True
                    self._seen.set()
                    break

    async def add(self, number: int, numbers: list[float], *, most: int) -> bool:
        """Add a published line, and act as `at_most`; wait only for the first line, or if any line ever came back."""
        first = not self._waiting and not self.lost
        self._waiting.append((number, numbers))
        return await self.at_most(most) if first or self._has_seen else not self._give_up(most)

    async def at_most(self, most: int) -> bool:
        """Return True once at most `most` lines are unseen; at a timeout, count the older ones as lost (False)."""
        while len(self._waiting) > most:
            self._seen.clear()
            try:
                async with asyncio.timeout(self._limit):
                    await self._seen.wait()
            except TimeoutError:
                return not self._give_up(most)
        return True

    def _give_up(self, most: int) -> bool:
        """Count all but the last `most` waiting lines as lost; return whether any was lost."""
        lost = [self._waiting.popleft()[0] for _ in range(len(self._waiting) - most)]
        self.lost += lost
        return bool(lost)
