"""Lines of standard input, bounded in length and decoded once; `terminal.output.put_json` writes those of standard output."""

import asyncio
import os
import stat
import sys
from collections.abc import AsyncIterator, Iterator
from typing import Any

import msgspec

from services.errors import InputLineError, SettingsError

LINE_LIMIT = 1 << 24
"""Length of the longest line on standard input, in bytes."""


def require_pipe(command: str, values: str) -> None:
    """Refuse, with a SettingsError, to wait for lines that somebody would have to type."""
    if sys.stdin.isatty():
        raise SettingsError(
            f"{command} reads {values} from standard input, which is a terminal: pipe them in, or use --listen ({command} --help)"
        )


def blocking_lines() -> Iterator[tuple[int, bytes]]:
    """Yield the lines of standard input with their numbers, without blank ones; an InputLineError for too long a line."""
    number = 0
    while line := sys.stdin.buffer.readline(LINE_LIMIT + 1):
        number += 1
        if len(line) > LINE_LIMIT:
            raise _too_long(number)
        if line.strip():
            yield number, line


async def lines() -> AsyncIterator[tuple[int, bytes]]:
    """Yield the same lines as `blocking_lines` without blocking the loop, so that a signal ends the wait for the next one."""
    kind = os.fstat(sys.stdin.fileno()).st_mode
    if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind)):  # the loop can only watch pipes; files never block
        for each in blocking_lines():
            yield each
        return
    reader = asyncio.StreamReader(limit=LINE_LIMIT)
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    number = 0
    while True:
        number += 1
        try:
            line = await reader.readline()
        except ValueError as error:
            raise _too_long(number) from error
        if not line:
            return
        if line.strip():
            yield number, line


def _too_long(number: int) -> InputLineError:
    return InputLineError(
        f"line {number} of standard input is longer than {LINE_LIMIT} bytes; expected one JSON value a line"
    )


def decoded(line: bytes, number: int, kind: Any, expected: str) -> Any:
    """Return a line's JSON value of a type for `msgspec`, or raise an InputLineError with its number and `expected`."""
    try:
        return msgspec.json.decode(line, type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise InputLineError(
            f"line {number} of standard input cannot be used ({error}); expected {expected}"
        ) from error
