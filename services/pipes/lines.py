"""Pipes between commands: lines of limited length from standard input, and the JSON objects that the lines contain.

`terminal.output.print_json_line` writes lines to standard output.
"""

import asyncio
import os
import stat
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from typing import Annotated, Any

import msgspec

from services.errors import InputLineError, SettingsError
from services.sockets.records import Addresses, Values

LINE_LIMIT = 1 << 24
"""Maximum length of a line on standard input, in bytes."""
_Unsigned = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]  # a record has no wider integers


class LineReading(msgspec.Struct):
    """A reading, sent from `subscriber --deployment` to `pcie-app`."""

    addresses: Addresses
    stamp_ns: int | None = None
    values: Values = []
    prior_codes: list[Annotated[int, msgspec.Meta(ge=0, lt=1 << 16)]] = []


class LineBoard(msgspec.Struct, omit_defaults=True):
    """The result of a board. `reason` is the number of its stop reason, and `why` is the name of this reason."""

    counts: list[Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]]
    cycles: _Unsigned
    reason: int
    why: str = ""
    replica_cycles: Sequence[_Unsigned] = ()
    replica_reasons: Sequence[int] = ()
    kept: bytes = b""


class LineResult(msgspec.Struct, kw_only=True):
    """A result with its reading, sent from `pcie-app` to `publisher`. A reading that is an array has the address -1."""

    number: _Unsigned
    stamp_ns: int | None = None
    addresses: list[int | None] = []
    values: Values = []
    boards: list[LineBoard]


def require_pipe(command: str, values: str) -> None:
    """Raise a SettingsError if standard input is a terminal."""
    if sys.stdin.isatty():
        raise SettingsError(
            f"{command} reads {values} from standard input, which is a terminal: pipe them in, or use --listen ({command} --help)"
        )


def blocking_lines() -> Iterator[tuple[int, bytes]]:
    """Yield number and text of each non-blank line of standard input. Raises an InputLineError for a long line."""
    number = 0
    # one byte more than permitted tells a line that is too long from one that just fits
    while line := sys.stdin.buffer.readline(LINE_LIMIT + 1):
        number += 1
        if len(line) > LINE_LIMIT:
            raise _too_long(number)
        if line.strip():
            yield number, line


async def lines() -> AsyncIterator[tuple[int, bytes]]:
    """Yield the items of `blocking_lines` without blocking the event loop, so that a signal can end the wait."""
    kind = os.fstat(sys.stdin.fileno()).st_mode
    # the loop supports only pipes, and files never block
    if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind)):
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
        f"line {number} of standard input is longer than {LINE_LIMIT} bytes; expected one JSON value per line"
    )


def decoded(line: bytes, number: int, kind: Any, expected: str) -> Any:
    """Decode a line of JSON as the type `kind`, or raise an InputLineError with the line's `number` and `expected`."""
    try:
        return msgspec.json.decode(line, type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise InputLineError(
            f"line {number} of standard input cannot be used ({error}); expected {expected}"
        ) from error
