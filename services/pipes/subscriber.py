"""The `subscriber` that runs without a master: it prints variables, or addresses for `pcie-app`."""

import asyncio
import contextlib
import time

from bridge.client import Message
from bridge.fields import Field, all_missing
from services.pipeline.connections import check_types, connect_all, report_unpublished
from services.pipeline.frames import FrameAssembler
from services.pipeline.subscriber import RECEIVED_QUEUE
from services.settings import Settings
from services.sockets.records import Reading
from terminal.connection import report_waits
from terminal.output import print_json_line, say, warn
from terminal.signals import until_one_ends
from toolchain.deployment import Deployment, Source


async def print_variables(settings: Settings, source: Source, names: list[str], count: int | None) -> int:
    """Print the named variables in each message of a topic, or whole messages if `names` is empty.

    Raises:
        NoMessageError: No message came in time.
        BridgeError: A message lacks a variable, the topic has another type, or the server is unreachable.
    """
    fields = [Field(name) for name in names]
    size, report = settings.message_bytes, report_waits()
    async with contextlib.AsyncExitStack() as stack:
        by_uri = await connect_all(stack, settings, [source.uri], on_state=report, max_size=size)
        ros = by_uri[source.uri]
        await check_types([(ros, source.topic, source.type)])
        subscription = ros.subscribe(
            source.topic, source.type, queue_size=RECEIVED_QUEUE, max_bytes=settings.topic_bytes
        )
        say(f"listening on {source.topic} at {source.uri}")
        # cancelled by the first message
        hint = asyncio.ensure_future(report_unpublished(ros, source.topic, warn))
        printed = 0
        try:
            while count is None or printed < count:
                message = await subscription.next(timeout=settings.first_data_timeout)
                hint.cancel()
                # all missing variables in one sentence, instead of one at each attempt
                found = [(field, *field.value(message.msg)) for field in fields]
                # one error for all of them
                if missing := [field for field, present, _ in found if not present]:
                    raise all_missing(missing, message.msg)
                values = {field.name: value for field, _, value in found}
                print_json_line(values or message.msg)
                printed += 1
        finally:
            hint.cancel()
    return 0


async def print_addresses(settings: Settings, deployment: Deployment, count: int | None) -> int:
    """Print each complete reading of a deployment in the form that `pcie-app` reads.

    Raises:
        NoMessageError: No message came in time.
        BridgeError: A topic has another type, or a server is unreachable.
        VariableError: A variable is missing or unusable.
    """
    frames = FrameAssembler(deployment)
    # One queue for all topics, so that readings are formed in the order of arrival by one task.
    arrived: asyncio.Queue[tuple[int, Message]] = asyncio.Queue(RECEIVED_QUEUE)

    async def next_readings() -> list[Reading]:
        """Wait for the next message or the next deadline, and return the readings that are complete then."""
        deadline = frames.deadline
        wait = None if deadline is None else max(deadline - time.monotonic_ns(), 0) / 1e9
        # only a set that waits for a topic that may be missing has a deadline
        try:
            async with asyncio.timeout(wait):
                at, message = await arrived.get()
        except TimeoutError:
            return frames.due(time.monotonic_ns())
        return frames.take(at, message.msg, message.received_ns, message.received_monotonic_ns)

    async def print_all() -> None:
        printed = 0
        while True:
            for reading in await next_readings():
                codes = list(memoryview(reading.prior_codes).cast("H"))
                line = {
                    "stamp_ns": reading.stamp_ns,
                    "addresses": reading.addresses,
                    "values": reading.values,
                }
                print_json_line(line | ({"prior_codes": codes} if codes else {}))
                printed += 1
                if printed == count:
                    return

    size, report = settings.message_bytes, report_waits()
    async with contextlib.AsyncExitStack() as stack:
        uris = [source.uri for source in deployment.sources]
        by_uri = await connect_all(stack, settings, uris, on_state=report, max_size=size)

        async def follow(at: int, source: Source) -> None:
            ros = by_uri[settings.uri or source.uri]
            hint = asyncio.ensure_future(report_unpublished(ros, source.topic, warn))
            stack.callback(hint.cancel)
            subscription = ros.subscribe(
                source.topic,
                source.type,
                queue_size=RECEIVED_QUEUE,
                compression=source.compression,
                max_bytes=settings.topic_bytes or source.topic_bytes,
            )
            while True:
                await arrived.put((at, await subscription.next(timeout=settings.first_data_timeout)))
                hint.cancel()

        needed = [source for at, source in enumerate(deployment.sources) if frames.needs(at)]
        await check_types((by_uri[settings.uri or each.uri], each.topic, each.type) for each in needed)
        for source in deployment.sources:
            say(f"listening on {source.topic} at {settings.uri or source.uri}")
        # the printing ends, or one of them fails
        await until_one_ends(
            print_all(), *(follow(at, source) for at, source in enumerate(deployment.sources))
        )
    return 0
