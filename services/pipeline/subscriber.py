"""The subscriber: takes the variables out of a topic's messages (thesis 3.1, Subscriber.jar)."""

from __future__ import annotations

import asyncio
import contextlib
import time
from functools import partial
from typing import Annotated

import msgspec
import typer
from pydantic import ValidationError

from bridge.client import Message, Ros, State, Subscription, connect
from bridge.errors import BridgeError, NoMessageError
from services.commands import flags as options
from services.errors import RosbridgeLostError, SettingsError, VariableError
from services.pipeline.frames import FrameAssembler
from services.pipeline.generations import Generations
from services.pipeline.printed_readings import print_addresses, print_readings
from services.settings import Settings, load_settings
from services.sockets.local_socket import MAX_RECORD
from services.sockets.records import (
    AnyRecord,
    Begin,
    Hello,
    LossReason,
    Notice,
    NotReloaded,
    Prepare,
    Ready,
    Switch,
    Switched,
    Trouble,
    Unusable,
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
from toolchain.deployment import Deployment, Source

ROLE = "subscriber"
_RECEIVED_QUEUE = 64
_BURST_PAUSE = 0.02
"""Seconds of silence after which what a server kept from before the subscription is through."""
_BURST_LIMIT = 0.1
_BACKLOG_LIMIT = min(1 << 18, MAX_RECORD)
"""Bytes that may wait for the master; beyond, readings are passed over (queue = latest) and counted."""


async def newest_now(subscription: Subscription, message: Message) -> tuple[Message, int]:
    """The newest of a subscription's first messages, and how many older ones came with it.

    ROS 2 servers begin with what was published before the subscription, the oldest first, in one burst.
    """
    older = 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_BURST_LIMIT):
            while True:
                async with asyncio.timeout(_BURST_PAUSE):
                    message = await anext(subscription)
                older += 1
    return message, older


class Subscriber:
    """Serves a master: readings of a deployment's topics, as addresses of the machine's columns."""

    def __init__(self, settings: Settings, deployment: Deployment, link: MakeLink) -> None:
        self._settings = settings
        self._generations = Generations(deployment, FrameAssembler)
        self._queue_all = (settings.queue or deployment.queue) == "all"
        self._begun = asyncio.Event()
        self._once = False
        self._follows = settings.log_level == "debug"
        self._log = get_logger(ROLE, settings.log_level)
        self._passed_over = 0
        self._link = link(self._take)
        self._lost: asyncio.Future[None] | None = None
        self._rosbridges: dict[str, Ros] = {}
        self._received = self._completed = self._unusable = self._passed_over_before = 0
        self._last_tick = 0
        self._told_apart = False
        self._unpaired_told = self._unpaired_before = 0

    @property
    def _deployment(self) -> Deployment:
        return self._generations.deployment

    @property
    def _assembler(self) -> FrameAssembler:
        return self._generations.made

    @property
    def _unpaired(self) -> int:
        return self._unpaired_before + self._assembler.unpaired

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, Begin):
            self._once = record.once
            self._begun.set()
        elif isinstance(record, Notice) and self._follows:
            # a frame has its number from the master, once it is neither passed over nor unusable
            self._log.debug(record.sentence)
        elif isinstance(record, Hello):
            self._generations.greeted(record)
        elif isinstance(record, Prepare):
            self._link.send(self._generations.prepare(record))
        elif isinstance(record, Switch):
            self._link.send(self._switch(record))

    def _switch(self, record: Switch) -> Switched | NotReloaded:
        """Make addresses by another deployment."""
        # messages that wait for partners were read by the old one
        self._assembler.forget()
        unpaired = self._unpaired
        answer = self._generations.switch(record)
        self._unpaired_before = unpaired - self._assembler.unpaired
        self._link.serve(self._deployment)
        return answer

    def status(self) -> ProcessStatus:
        """What this process knows."""
        why = why_not_connected(self._rosbridges)
        age = seconds_since(self._last_tick)
        limit = self._settings.ready_timeout
        # before a run there is nothing to hear: what starts the master may wait for us
        if not why and self._begun.is_set() and self._link.has_master and (age is None or age > limit):
            topics = " and ".join(source.topic for source in self._deployment.sources)
            since = "yet" if age is None else f"for {age:.0f} s"
            apart = self._assembler.too_far_apart() or f"waiting for messages on {topics}"
            why = f"no complete reading {since}: {apart}"
        return ProcessStatus(
            ready=not why,
            why=why or f"connected to {', '.join(self._rosbridges)}",
            deployment=self._deployment.hash,
            generation=self._generations.number,
            connections=connections(self._rosbridges),
            frames=FrameCounts(
                received=self._received,
                completed=self._completed,
                lost=reasons(
                    {
                        LossReason.PASSED_OVER: self._passed_over + self._passed_over_before,
                        LossReason.UNUSABLE: self._unusable,
                        LossReason.UNPAIRED: self._unpaired,
                    }
                ),
                last_number=None,
                last_age_s=age,
            ),
        )

    def _state_changed(self, uri: str, state: State, reason: str) -> None:
        if state is State.RECONNECTING:
            self._link.notice("warning", f"rosbridge at {uri} is gone ({reason}); waiting for it")
            if self._once and self._link.has_master and self._lost is not None and not self._lost.done():
                self._lost.set_exception(
                    RosbridgeLostError(f"rosbridge at {uri} went away before a reading came ({reason})")
                )
        elif state is State.CONNECTED and self._begun.is_set():
            self._link.notice("info", f"rosbridge at {uri} is connected again")

    async def run(self) -> int:
        """Serve until a signal; raises what ends it."""
        settings = self._settings
        sources = self._deployment.sources
        self._lost = asyncio.get_running_loop().create_future()
        status = status_served(settings.run_directory, ROLE, self.status)
        async with self._link, status, contextlib.AsyncExitStack() as stack:
            try:
                by_uri = self._rosbridges
                for uri in {settings.uri or source.uri: None for source in sources}:
                    by_uri[uri] = await stack.enter_async_context(
                        connect(
                            uri,
                            connect_timeout=settings.connect_timeout,
                            ros_version=settings.ros_version,
                            on_state=partial(self._state_changed, uri),
                        )
                    )
                self._link.keep(Ready(f"connected to {', '.join(by_uri)}"))
                await self._begun.wait()
                async with asyncio.TaskGroup() as group:
                    lost = group.create_task(self._watch_loss())
                    tasks = [
                        group.create_task(self._follow(by_uri[settings.uri or source.uri], at, source))
                        for at, source in enumerate(sources)
                    ]
                    await asyncio.wait(tasks)
                    lost.cancel()
            except BaseExceptionGroup as group_error:
                error: BaseException = group_error
                while isinstance(error, BaseExceptionGroup):
                    error = error.exceptions[0]
                await self._fail(error)
                raise error from None
            except BridgeError as error:
                await self._fail(error)
                raise
        return 0

    async def _watch_loss(self) -> None:
        if self._lost is not None:
            await self._lost

    async def _fail(self, error: BaseException) -> None:
        code = exit_code_of(error)
        if code != 1 and isinstance(error, Exception):
            # a master that started with us may need a moment to connect
            for _ in range(100):
                if self._link.send(Trouble(code, str(error))):
                    break
                await asyncio.sleep(0.02)

    async def _follow(self, ros: Ros, at: int, source: Source) -> None:
        subscription = ros.subscribe(
            source.topic,
            source.type,
            queue_length=0 if self._queue_all else 1,
            queue_size=_RECEIVED_QUEUE,
            compression=source.compression,
        )
        timeout = self._settings.first_data_timeout
        first = True
        connection: int | None = None
        lost_before = 0
        while True:
            try:
                message = await subscription.next(timeout=timeout)
            except NoMessageError as error:
                if first and ros.state is State.CONNECTED and self._assembler.needs(at):
                    raise
                self._link.notice("warning", str(error))
                continue
            first = False
            self._received += 1
            if connection != ros.reconnections and not self._queue_all:
                connection = ros.reconnections
                message, older = await newest_now(subscription, message)
                self._passed_over += older
            self._passed_over += subscription.lost - lost_before
            lost_before = subscription.lost
            self._forward(at, message)

    def _forward(self, at: int, message: Message) -> None:
        try:
            reading = self._assembler.take(
                at, message.msg, message.received_ns, message.received_monotonic_ns
            )
        except VariableError as error:
            self._unusable += 1
            cause = f"{type(error.__cause__).__name__} {at}"
            self._link.send(Unusable(cause, str(error)))
            return
        if reading is None:
            apart = self._assembler.too_far_apart()
            if apart and not self._told_apart:
                self._link.notice("warning", apart)
            self._told_apart = self._told_apart or bool(apart)
            return
        self._told_apart = False
        self._last_tick = reading.received_tick
        if self._link.backlog > _BACKLOG_LIMIT and not self._queue_all:
            self._passed_over += 1
            return
        unpaired = self._unpaired
        record = msgspec.structs.replace(
            reading,
            sent_tick=time.monotonic_ns(),
            passed_over=self._passed_over,
            unpaired=unpaired - self._unpaired_told,
            generation=self._generations.number,
        )
        if self._link.send(record):
            self._completed += 1
            self._unpaired_told = unpaired
            self._passed_over_before += self._passed_over
            self._passed_over = 0
            self._once = (
                False  # its frame is on its way; what comes later must not end a service that goes on
            )


app = CommandLine(
    help="Take variables out of a ROS topic over rosbridge.\n\n"
    "Alone it prints them, one JSON object a line:\n\n"
    "`subscriber --uri ws://robot:9090 --topic /boat/sensors --type boat_msgs/Sensors --variables D1,B1`\n\n"
    "With `--deployment DIR` it prints addresses as `pcie-app` reads them; "
    "with `--listen ENDPOINT` too, it serves a master."
)


@app.command(help=app.info.help)
def subscriber(
    deployment: options.Deployment = None,
    uri: options.Uri = None,
    topic: Annotated[str | None, typer.Option(help="Topic to subscribe to (without a deployment).")] = None,
    type_: Annotated[str | None, typer.Option("--type", help="Its message type.")] = None,
    variables: Annotated[
        str, typer.Option(help="Names or paths, comma-separated; none prints whole messages.")
    ] = "",
    count: options.Count = None,
    listen: options.Listen = None,
    queue: options.Queue = None,
    ros_version: options.RosVersion = None,
    connect_timeout: options.ConnectTimeout = None,
    first_data_timeout: options.FirstDataTimeout = None,
    log_level: options.LogLevel = None,
) -> int:
    """Take variables out of a ROS topic over rosbridge."""
    end_with_parent()
    settings = load_settings(
        deployment=deployment,
        uri=uri,
        queue=queue,
        ros_version=ros_version,
        connect_timeout=connect_timeout,
        first_data_timeout=first_data_timeout,
        log_level=log_level,
    )
    if settings.deployment is not None and (said := topic or type_ or variables):
        flag = "--topic" if topic else "--type" if type_ else "--variables"
        msg = f"{flag} {said} is for use without a deployment; {settings.deployment} has its own: leave one of them out"
        raise SettingsError(msg)
    if listen is not None:
        loaded = deployment_for(settings)
        link = listening(endpoint_from(listen, "--listen"), ROLE, loaded)
        return run_async(Subscriber(settings, loaded, link).run())
    if settings.deployment is not None:
        loaded = deployment_for(settings)
        for each in loaded.sources:
            say(f"listening on {each.topic} at {settings.uri or each.uri}")
        return run_async(print_addresses(settings, loaded, count))
    if settings.uri is None or topic is None or type_ is None:
        msg = "give --uri, --topic and --type, or --deployment DIR (subscriber --help shows examples)"
        raise SettingsError(msg)
    names = [name.strip() for name in variables.split(",") if name.strip()]
    try:
        source = Source(uri=settings.uri, topic=topic, type=type_)
    except ValidationError as error:
        first = error.errors()[0]
        msg = f"--{first['loc'][0]}: {str(first['msg']).removeprefix('Value error, ')}"
        raise SettingsError(msg) from error
    say(f"listening on {topic} at {settings.uri}")
    return run_async(print_readings(settings, source, names, count))


def main() -> None:
    """Entry point of the command `subscriber`."""
    app()
