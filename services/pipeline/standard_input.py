"""What `pcie-app` does when it serves no master: readings from standard input, counts to standard output, a line each."""

from __future__ import annotations

import sys
from typing import Annotated

import msgspec
import numpy as np
import orjson

from pcie_shim.errors import FrameInputError
from services.errors import InputLineError
from services.pipeline.mini_cluster import Boards
from services.pipeline.results import REASON_WORDS
from services.sockets.records import Addresses, Frame
from terminal.output import say


class LineReading(msgspec.Struct):
    """A reading as `subscriber --deployment` prints it."""

    addresses: Addresses
    stamp_ns: int | None = None
    prior_codes: list[Annotated[int, msgspec.Meta(ge=0, lt=1 << 16)]] = []


def reading_from_line(line: bytes, number: int) -> LineReading:
    """What one line of standard input says.

    Raises:
        InputLineError: it is no reading; says which line.
    """
    try:
        return msgspec.json.decode(line, type=LineReading)
    except (msgspec.MsgspecError, RecursionError) as error:
        msg = f'line {number} of standard input is no reading ({error}); expected {{"addresses": [12, null, 7]}}'
        raise InputLineError(msg) from error


def compute_lines(boards: Boards, banks: int) -> int:
    """Alone: compute the readings that come on standard input, one JSON object a line.

    Raises:
        InputLineError: a line is no reading, or none of this machine.
        BoardError: a board failed.
    """
    say(boards.open())
    try:
        for number, line in enumerate(sys.stdin.buffer, 1):
            if not line.strip():
                continue
            reading = reading_from_line(line, number)
            codes = np.array(reading.prior_codes, "<u2").tobytes()
            frame = Frame(number, reading.addresses, number % banks, codes)
            try:
                output = boards.run(frame)
            except FrameInputError as error:
                msg = f"line {number} of standard input: {error}"
                raise InputLineError(msg) from error
            printed = {
                "number": number,
                "stamp_ns": reading.stamp_ns,
                "boards": [
                    {
                        "counts": np.frombuffer(board.words, "<u4").tolist(),
                        "cycles": board.cycles,
                        "reason": board.reason,
                        "why": REASON_WORDS[board.reason],
                    }
                    | (
                        {
                            "replica_cycles": board.replica_cycles,
                            "replica_reasons": board.replica_reasons,
                        }
                        if board.replica_cycles
                        else {}
                    )
                    for board in output.boards
                ],
            }
            sys.stdout.buffer.write(orjson.dumps(printed) + b"\n")
            sys.stdout.buffer.flush()
    finally:
        boards.close()
    return 0
