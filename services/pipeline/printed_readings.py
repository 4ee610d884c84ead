"""What `subscriber` prints when it serves no master: variables, or addresses, one JSON object a line."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

from bridge.client import Ros, connect
from bridge.fields import Field
from services.pipeline.frames import FrameAssembler
from services.settings import Settings
from terminal.output import put_json
from toolchain.deployment import Deployment, Source

_RECEIVED_QUEUE = 64


async def print_readings(settings: Settings, source: Source, names: list[str], count: int | None) -> int:
    """Alone, without a deployment: print the named variables of each message, one JSON object a line.

    Raises:
        NoMessageError: no message in time.
        BridgeError: a variable is not there, or the server is not.
    """
    fields = [Field(name) for name in names]
    async with connect(
        source.uri, connect_timeout=settings.connect_timeout, ros_version=settings.ros_version
    ) as ros:
        subscription = ros.subscribe(source.topic, source.type, queue_size=_RECEIVED_QUEUE)
        printed = 0
        timeout: float = settings.first_data_timeout
        while count is None or printed < count:
            message = await subscription.next(timeout=timeout)
            values: dict[str, Any] = {}
            for field in fields:
                present, value = field.value(message.msg)
                if not present:
                    raise field.missing(message.msg)
                values[field.name] = value
            put_json(values or message.msg)
            printed += 1
    return 0


async def print_addresses(settings: Settings, deployment: Deployment, count: int | None) -> int:
    """Alone, with a deployment: print each complete reading as `pcie-app` reads it, one JSON object a line.

    Raises:
        NoMessageError: no message in time.
        VariableError: a variable is missing or unusable.
    """
    assembler = FrameAssembler(deployment)
    printed = 0
    async with contextlib.AsyncExitStack() as stack:
        by_uri: dict[str, Ros] = {}
        for uri in {settings.uri or source.uri: None for source in deployment.sources}:
            by_uri[uri] = await stack.enter_async_context(
                connect(uri, connect_timeout=settings.connect_timeout, ros_version=settings.ros_version)
            )

        async def follow(at: int, source: Source) -> None:
            nonlocal printed
            subscription = by_uri[settings.uri or source.uri].subscribe(
                source.topic, source.type, queue_size=_RECEIVED_QUEUE, compression=source.compression
            )
            while count is None or printed < count:
                message = await subscription.next(timeout=settings.first_data_timeout)
                reading = assembler.take(at, message.msg, message.received_ns, message.received_monotonic_ns)
                if reading is not None and (count is None or printed < count):
                    printed += 1
                    printed_prior = list(memoryview(reading.prior_codes).cast("H"))
                    put_json(
                        {"stamp_ns": reading.stamp_ns, "addresses": reading.addresses}
                        | ({"prior_codes": printed_prior} if printed_prior else {})
                    )

        followers = [
            asyncio.ensure_future(follow(at, source)) for at, source in enumerate(deployment.sources)
        ]
        try:
            ended, _ = await asyncio.wait(followers, return_when=asyncio.FIRST_COMPLETED)
            for each in ended:
                each.result()
        finally:
            for follower in followers:
                follower.cancel()
    return 0
