"""The publisher: results become posteriors on /BMresults (thesis 3.1, Publisher.jar)."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import stat
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator
from functools import partial
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import typer

from bridge.client import Publication, Ros, State, Subscription, connect
from bridge.errors import BridgeError, DisconnectedError, NoMessageError, SlowPeerError
from machines.bm1 import StopReason
from pcie_shim.host.frame import BoardResult
from posteriors.results import FRAME_TOPIC, FRAME_TYPE, MAX_RESULT
from services.commands import flags as options
from services.errors import InputLineError, SettingsError
from services.pipeline.generations import Generations
from services.pipeline.results import (
    FrameReport,
    Inferred,
    encode_boards,
    posterior_layout,
    times_of,
)
from services.settings import Settings, load_settings
from services.sockets.records import (
    AnyRecord,
    Begin,
    FrameResult,
    Hello,
    Outcome,
    Prepare,
    Publish,
    Published,
    Ready,
    Switch,
    Trouble,
)
from services.sockets.serving import MakeLink, deployment_for, endpoint_from, listening
from services.sockets.status import (
    FrameCounts,
    ProcessStatus,
    connections,
    reasons,
    seconds_since,
    status_served,
    why_not_connected,
)
from services.supervision.parent import end_with_parent
from terminal.command_line import CommandLine
from terminal.errors import exit_code_of
from terminal.logs import get_logger
from terminal.output import say
from terminal.signals import run_async
from toolchain.deployment import Deployment

ROLE = "publisher"
RESULTS_DEPTH = 64
"""Results that may wait for the rosbridge server; the master keeps fewer than that under way."""


LINE_LIMIT = 1 << 24
"""Bytes of the longest line on standard input."""


def same_numbers(received: Any, sent: list[float]) -> bool:
    """Whether an array is the one that was sent: there are servers that lose a double's last bit."""
    return (
        isinstance(received, list)
        and len(received) == len(sent)
        and all(
            isinstance(one, int | float) and math.isclose(one, other, rel_tol=1e-12)
            for one, other in zip(received, sent, strict=True)
        )
    )


class ResultTopics:
    """The deployment's output topics on their servers, advertised."""

    def __init__(self, settings: Settings, deployment: Deployment) -> None:
        self._settings = settings
        self._deployment = deployment
        self._generation = 0
        self._layout = posterior_layout(deployment)
        self._outputs: list[tuple[Ros, Publication]] = []
        self._frames: Publication | None = None
        self._watched: Subscription | None = None
        self._version: Literal[1, 2] = 2
        self._report = FrameReport(deployment, self._version)
        self._previous_out_ns = 0
        self.rosbridges: dict[str, Ros] = {}

    @contextlib.asynccontextmanager
    async def opened(self, on_state: Any = None) -> AsyncIterator[str]:
        """Connect and advertise; gives a sentence that says where.

        Raises:
            BridgeError: a server is not reachable, or is none.
        """
        settings, deployment = self._settings, self._deployment
        async with contextlib.AsyncExitStack() as stack:
            by_uri = self.rosbridges
            for output in deployment.outputs:
                uri = settings.uri or deployment.output_uri(output)
                if uri not in by_uri:
                    by_uri[uri] = await stack.enter_async_context(
                        connect(
                            uri,
                            connect_timeout=settings.connect_timeout,
                            ros_version=settings.ros_version,
                            on_state=None if on_state is None else partial(on_state, uri),
                            max_size=MAX_RESULT,
                        )
                    )
                self._outputs.append((by_uri[uri], await by_uri[uri].advertise(output.topic, output.type)))
            first = self._outputs[0][0]
            self._frames = await first.advertise(FRAME_TOPIC, FRAME_TYPE)
            version: Literal[1, 2] = 1 if settings.ros_version == "1" else 2
            if settings.ros_version == "auto":
                version = await first.detect_ros_version() or 2
            self._version = version
            self._report = FrameReport(self._deployment, version, self._generation)
            topics = ", ".join(output.topic for output in deployment.outputs)
            yield f"publishing on {topics} at {', '.join(by_uri)}"

    def use(self, deployment: Deployment, generation: int) -> None:
        """Say results as those of another deployment, on the same topics."""
        self._deployment = deployment
        self._generation = generation
        self._layout = posterior_layout(deployment)
        self._report = FrameReport(deployment, self._version, generation)

    def served_by(self, uri: str) -> tuple[str, str]:
        """How a sentence names the topics of a server, and the server: nothing and `rosbridge` where it is the only one."""
        if len(self.rosbridges) == 1:
            return "", "rosbridge"
        topics = [publication.topic for ros, publication in self._outputs if ros is self.rosbridges.get(uri)]
        which = f" for {' and '.join(topics)}" if topics else ""
        return which, f"rosbridge at {uri}"

    def watch(self) -> None:
        """Subscribe to the first output, so that a result can be seen on the wire."""
        if self._watched is None:
            output = self._deployment.outputs[0]
            self._watched = self._outputs[0][0].subscribe(output.topic, output.type, queue_size=RESULTS_DEPTH)

    async def _seen(self, data: list[float], timeout: float) -> bool:
        if self._watched is None:
            return False
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            try:
                message = await self._watched.next(timeout=left)
            except NoMessageError:
                return False
            if same_numbers(message.msg.get("data"), data):
                return True
        return False

    @property
    def must_wait(self) -> bool:
        """Whether no server is there, or one that is has not taken what was sent before."""
        there = self._there()
        return not there or any(publication.must_wait for publication in there)

    def _there(self) -> list[Publication]:
        """The outputs whose servers are connected."""
        return [publication for ros, publication in self._outputs if ros.state is State.CONNECTED]

    async def publish(self, publish: Publish, *, look: bool) -> Published:
        """Publish a frame's data and then its posterior, where it has one, once the servers take them.

        Args:
            publish: the result and its frame's times.
            look: wait until the result was seen on the wire, or the settings' time is over.
        """
        inferred = Inferred(publish.result)
        ready = [publication.ready() for publication in self._there()]
        for error in await asyncio.gather(*ready, return_exceptions=True):
            if isinstance(error, BridgeError):
                get_logger(ROLE).warning(str(error), frame=publish.result.number)
            elif error is not None:
                raise error
        published = self.publish_now(publish, inferred)
        if look and published.outcome is Outcome.PUBLISHED and inferred.posterior is not None:
            seen = await self._seen(inferred.posterior.tolist(), self._settings.seen_timeout)
            published = msgspec.structs.replace(published, seen=seen)
        return published

    def publish_now(self, publish: Publish, inferred: Inferred) -> Published:
        """Publish a frame's data and its posterior at once, wherever a server takes them, and say what became of it.

        The frame's data go to the first output's server. A result is published if it went to one output at least.
        """
        started = time.monotonic_ns()
        times = times_of(publish, started, self._previous_out_ns)
        posterior = inferred.posterior
        missed = 0
        with self._outputs[0][0].together():
            told = self._frames is not None and _sent(
                self._frames, self._report.message(publish, inferred, times, time.time_ns())
            )
            if posterior is not None:
                for _, publication in self._outputs:
                    missed += not _sent(publication, {"layout": self._layout, "data": posterior})
        self._previous_out_ns = time.monotonic_ns() - started
        if posterior is None:
            return _became_of(publish, inferred, Outcome.NO_POSTERIOR if told else Outcome.ROSBRIDGE_AWAY)
        if missed == len(self._outputs):
            return _became_of(publish, inferred, Outcome.ROSBRIDGE_AWAY)
        return _became_of(publish, inferred, Outcome.PUBLISHED, missed)

    async def publish_array(self, values: Any) -> None:
        """Publish probabilities (float64, one per line) on every output."""
        for _, publication in self._outputs:
            await publication.publish({"layout": self._layout, "data": values})


def _sent(publication: Publication, message: dict[str, Any]) -> bool:
    """Whether a message went out: its server is there, and takes it at once."""
    try:
        publication.publish_nowait(message)
    except (DisconnectedError, SlowPeerError):
        return False
    return True


def _became_of(publish: Publish, inferred: Inferred, outcome: Outcome, missed: int = 0) -> Published:
    posterior = inferred.posterior
    return Published(
        number=publish.result.number,
        outcome=outcome,
        seen=None,
        best_line=inferred.best,
        best_probability=float(posterior[inferred.best]) if posterior is not None else 0.0,
        cycles=max((board.cycles for board in inferred.boards), default=0),
        total_ns=time.monotonic_ns() - publish.received_tick,
        missed=missed,
    )


class Publisher:
    """Serves a master: publishes each result that it sends."""

    def __init__(self, settings: Settings, deployment: Deployment, link: MakeLink) -> None:
        self._topics = ResultTopics(settings, deployment)
        self._waiting: asyncio.Queue[Publish] = asyncio.Queue(RESULTS_DEPTH)
        self._begun = asyncio.Event()
        self._once = False
        self._busy = True  # there are no topics yet
        self._link = link(self._take)
        self._generations = Generations(deployment, posterior_layout)
        self._follows = settings.log_level == "debug"
        self._log = get_logger(ROLE, settings.log_level)
        self._run_directory = settings.run_directory
        self._where = ""
        self._outcomes: Counter[Outcome] = Counter()
        self._last = (0, 0)

    def status(self) -> ProcessStatus:
        """What this process knows."""
        why = why_not_connected(self._topics.rosbridges)
        if not why and not self._where:
            why = "waiting for its topics to be advertised"
        number, tick = self._last
        outcomes = self._outcomes
        return ProcessStatus(
            ready=not why,
            why=why or self._where,
            deployment=self._generations.deployment.hash,
            generation=self._generations.number,
            connections=connections(self._topics.rosbridges),
            frames=FrameCounts(
                received=outcomes.total() + self._waiting.qsize(),
                completed=outcomes[Outcome.PUBLISHED],
                lost=reasons(
                    {reason: count for reason, count in outcomes.items() if reason is not Outcome.PUBLISHED}
                ),
                last_number=number or None,
                last_age_s=seconds_since(tick),
            ),
        )

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, Begin):
            self._once = record.once
            if self._once:
                self._topics.watch()
            self._begun.set()
        elif isinstance(record, Publish):
            if not (self._once or self._busy or self._topics.must_wait):
                # the usual case: nothing to wait for, and so no other task to wake
                self._tell(self._topics.publish_now(record, Inferred(record.result)))
                return
            self._busy = True  # until the queue is empty again: results stay in order
            try:
                self._waiting.put_nowait(record)
            except asyncio.QueueFull:
                self._outcomes[Outcome.ROSBRIDGE_AWAY] += 1
                self._link.send(Published(record.result.number, Outcome.ROSBRIDGE_AWAY, None, -1, 0.0, 0, 0))
        elif isinstance(record, Hello):
            self._generations.greeted(record)
            self._topics.use(self._generations.deployment, record.generation)
        elif isinstance(record, Prepare):
            self._link.send(self._generations.prepare(record))
        elif isinstance(record, Switch):
            # no result is under way: the master has waited for them
            answer = self._generations.switch(record)
            self._topics.use(self._generations.deployment, self._generations.number)
            self._link.serve(self._generations.deployment)
            self._link.send(answer)

    def _tell(self, published: Published) -> None:
        """What became of a result."""
        self._link.send(published)
        self._outcomes[published.outcome] += 1
        if published.outcome is Outcome.PUBLISHED:
            self._last = (published.number, time.monotonic_ns())
        if self._follows:
            self._log.debug(
                published.outcome,
                frame=published.number,
                probability=f"{published.best_probability:.3g}",
                ms=f"{published.total_ns / 1e6:.2f}",
            )

    def _state_changed(self, uri: str, state: State, reason: str) -> None:
        if state is not State.RECONNECTING:
            return
        topics, rosbridge = self._topics.served_by(uri)
        self._link.notice(
            "warning", f"{rosbridge} is gone ({reason}); results{topics} are lost until it is back"
        )

    async def run(self) -> int:
        """Serve until a signal; raises what ends it."""
        async with self._link, status_served(self._run_directory, ROLE, self.status):
            try:
                async with self._topics.opened(self._state_changed) as where:
                    self._where = where
                    self._link.keep(Ready(where))
                    self._busy = False
                    while True:
                        publish = await self._waiting.get()
                        self._tell(await self._topics.publish(publish, look=self._once))
                        self._busy = not self._waiting.empty()
            except BridgeError as error:
                for _ in range(100):
                    if self._link.send(Trouble(exit_code_of(error), str(error))):
                        break
                    await asyncio.sleep(0.02)
                raise


async def _lines() -> AsyncIterator[bytes]:
    """Lines of standard input, without blocking the loop.

    A pipe or a terminal; regular files are read at once.
    """
    kind = os.fstat(sys.stdin.fileno()).st_mode
    if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind)):
        while line := await asyncio.to_thread(sys.stdin.buffer.readline):
            yield line
        return
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader(limit=LINE_LIMIT)
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    while True:
        try:
            line = await reader.readline()
        except ValueError as error:
            msg = f"a line of standard input is longer than {LINE_LIMIT} bytes; expected one result a line"
            raise InputLineError(msg) from error
        if not line:
            return
        yield line


class _LineBoard(msgspec.Struct):
    counts: list[Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]]
    cycles: Annotated[int, msgspec.Meta(ge=0)]
    reason: StopReason
    replica_cycles: list[Annotated[int, msgspec.Meta(ge=0)]] = []
    replica_reasons: list[StopReason] = []


class _LineResult(msgspec.Struct):
    number: int
    boards: list[_LineBoard]
    stamp_ns: int | None = None


_Line = _LineResult | list[Annotated[float, msgspec.Meta(ge=0)]]  # its JSON knows no infinity


def result_from_line(
    line: bytes, number: int, lines: int, replicas: int = 1
) -> tuple[FrameResult, int | None] | list[float]:
    """What one line of standard input says: `pcie-app`'s result with its reading's stamp, or an array of probabilities.

    Raises:
        InputLineError: neither; says which line.
    """
    expected = f"expected a result of pcie-app or an array of {lines} probabilities"
    try:
        value = msgspec.json.decode(line, type=_Line)
    except (msgspec.MsgspecError, RecursionError) as error:
        msg = f"line {number} of standard input is no result ({error}); {expected}"
        raise InputLineError(msg) from error
    found = len(value) if isinstance(value, list) else sum(len(board.counts) for board in value.boards)
    if found != lines:
        msg = f"line {number} of standard input has {found} values; {expected}"
        raise InputLineError(msg)
    if isinstance(value, list):
        return value
    each = replicas if replicas > 1 else 0
    for board in value.boards:
        if not len(board.replica_cycles) == len(board.replica_reasons) == each:
            msg = (
                f"line {number} of standard input has {len(board.replica_cycles)} replicas' cycles on a board; expected a "
                f"result of {replicas} replica{'s' if replicas > 1 else ''}"
            )
            raise InputLineError(msg)
        if each and len(board.counts) % each:
            msg = f"line {number} of standard input has {len(board.counts)} counts on a board of {each} replicas"
            raise InputLineError(msg)
    boards = [
        BoardResult(
            np.array(board.counts, dtype="<u4").tobytes(),
            board.cycles,
            board.reason,
            tuple(board.replica_cycles),
            tuple(board.replica_reasons),
        )
        for board in value.boards
    ]
    return FrameResult(value.number, encode_boards(boards), 0, 0, 0, 0), value.stamp_ns


async def publish_lines(settings: Settings, deployment: Deployment) -> int:
    """Alone: publish what comes on standard input, one result a line, until it ends."""
    topics = ResultTopics(settings, deployment)
    async with topics.opened() as where:
        say(where)
        number = 0
        outcomes: Counter[Outcome] = Counter()
        async for line in _lines():
            number += 1
            if not line.strip():
                continue
            machine = deployment.machine
            result = result_from_line(line, number, machine.results, machine.replicas)
            if isinstance(result, tuple):
                now, tick = time.time_ns(), time.monotonic_ns()
                counted, stamp_ns = result
                published = await topics.publish(
                    Publish(counted, stamp_ns or now, now, tick, tick, 0), look=False
                )
                outcomes[published.outcome] += 1
            else:
                await topics.publish_array(result)
                outcomes[Outcome.PUBLISHED] += 1
    others = ", ".join(
        f"{count} {outcome}" for outcome, count in outcomes.items() if outcome is not Outcome.PUBLISHED
    )
    say(f"{outcomes[Outcome.PUBLISHED]} published{f'; not published: {others}' if others else ''}")
    return 0


app = CommandLine(
    help="Publish posteriors over rosbridge.\n\n"
    "Alone it reads results from standard input, one JSON value a line (what `pcie-app` prints, or arrays of probabilities):\n\n"
    "`subscriber -d build/boat | pcie-app -d build/boat --boards ... | publisher -d build/boat --uri ws://robot:9090`\n\n"
    "With `--listen ENDPOINT` it serves a master."
)


@app.command(help=app.info.help)
def publisher(
    deployment: options.Deployment = None,
    uri: options.Uri = None,
    listen: options.Listen = None,
    ros_version: options.RosVersion = None,
    connect_timeout: options.ConnectTimeout = None,
    seen_timeout: Annotated[
        float | None, typer.Option(help="Seconds until a result is seen on the wire (2).")
    ] = None,
    log_level: options.LogLevel = None,
) -> int:
    """Publish posteriors over rosbridge."""
    end_with_parent()
    settings = load_settings(
        deployment=deployment,
        uri=uri,
        ros_version=ros_version,
        connect_timeout=connect_timeout,
        seen_timeout=seen_timeout,
        log_level=log_level,
    )
    loaded = deployment_for(settings)
    if listen is not None:
        link = listening(endpoint_from(listen, "--listen"), ROLE, loaded)
        return run_async(Publisher(settings, loaded, link).run())
    if sys.stdin.isatty():
        msg = "the publisher reads results from standard input, which is a terminal: pipe them in, or use --listen (publisher --help)"
        raise SettingsError(msg)
    return run_async(publish_lines(settings, loaded))


def main() -> None:
    """Entry point of the command `publisher`."""
    app()
