"""The `publisher` that runs without a master: it publishes results from standard input."""

import time
from collections import Counter
from typing import Annotated

import msgspec
import numpy as np

from machines.kind import BoardResult
from services.boards.frames import encode_boards
from services.errors import InputLineError
from services.pipeline.result_topics import ResultTopics
from services.pipes.lines import LineResult, decoded, lines
from services.settings import Settings
from services.sockets.records import FrameResult, Outcome, Publish
from terminal.output import say
from toolchain.deployment import Deployment, MachineSection

_Line = LineResult | list[Annotated[float, msgspec.Meta(ge=0)]]  # JSON has no infinity


def result_from_line(line: bytes, number: int, machine: MachineSection) -> Publish | list[float]:
    """Parse a line: either a `pcie-app` result with its reading, or a list of probabilities.

    Any other line raises an InputLineError.
    """
    where = f"line {number} of standard input"
    count, replicas, reasons = machine.results, machine.replicas, machine.kind.reasons
    expected = f"a result of pcie-app or an array of {count} probabilities"
    value = decoded(line, number, _Line, expected)
    found = len(value) if isinstance(value, list) else sum(len(board.counts) for board in value.boards)
    # results of another model with as many cells cannot be detected, because they do not name their deployment
    kept = not isinstance(value, list) and any(board.kept for board in value.boards)
    if found != count and not kept:
        raise InputLineError(f"{where} has {found} values; expected {expected}")
    if isinstance(value, list):
        return value
    # a single machine reports no cycles by replica
    each = replicas if replicas > 1 else 0
    for board in value.boards:
        if not len(board.replica_cycles) == len(board.replica_reasons) == each:
            raise InputLineError(
                f"{where} has {len(board.replica_cycles)} replicas' cycles on a board; expected a result of "
                f"{replicas} replica{'s' if replicas > 1 else ''}"
            )
        for reason in (board.reason, *board.replica_reasons):
            if reason not in reasons:
                raise InputLineError(f"{where} has the stop reason {reason}; expected 0 to {max(reasons)}")
        if each and len(board.counts) % each:
            raise InputLineError(f"{where} has {len(board.counts)} counts on a board of {each} replicas")
    boards = [
        BoardResult(
            np.array(board.counts, dtype="<u4").tobytes(),
            board.cycles,
            board.reason,
            tuple(board.replica_cycles),
            tuple(board.replica_reasons),
            board.kept,
        )
        for board in value.boards
    ]
    if kept:  # only the kind of machine knows how many results that makes
        posterior = machine.kind.infer(boards, machine.variables).posterior
        if posterior is not None and len(posterior) != count:
            raise InputLineError(
                f"{where} is a result of {len(posterior)} probabilities; expected {expected}"
            )
    # the reading was received elsewhere, so the times of its frame begin here
    now, tick = time.time_ns(), time.monotonic_ns()
    return Publish(
        result=FrameResult(value.number, encode_boards(boards), 0, 0, 0, 0),
        stamp_ns=value.stamp_ns or now,
        received_ns=now,
        received_tick=tick,
        reading_sent_tick=tick,
        waited_ns=0,
        addresses=value.addresses,
        values=value.values,
    )


async def publish_lines(settings: Settings, deployment: Deployment) -> int:
    """Publish the results that standard input contains, one per line, until the end of the input.

    Raises:
        InputLineError: A line is not a result of this deployment.
        BridgeError: A server is unreachable.
    """
    topics = ResultTopics(settings, deployment)
    async with topics.opened() as where:
        say(where)
        outcomes: Counter[Outcome] = Counter()
        async for number, line in lines():
            # a line that cannot be used ends the pipe, so that no later result takes its place
            value = result_from_line(line, number, deployment.machine)
            if isinstance(value, list):
                await topics.publish_array(value)
                outcomes[Outcome.PUBLISHED] += 1
                continue
            published = await topics.publish(value, look=False)
            outcomes[published.outcome] += 1
    published_count = outcomes.pop(Outcome.PUBLISHED, 0)
    others = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())
    say(f"{published_count} published{f'; not published: {others}' if others else ''}")
    return 0
