"""Services in both directions through the fake server."""

import asyncio
import math
import time
from typing import Any

import pytest

from bridge.client import State, connect
from bridge.errors import (
    DisconnectedError,
    EncodeError,
    NameFormError,
    NoAnswerError,
    ServiceError,
    TypeConflictError,
)
from tests.fake_rosbridge import FakeRosbridge


async def test_a_call():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        fake.serve("/add", lambda args: {"sum": args["a"] + args["b"]})
        assert await ros.call("/add", {"a": 1, "b": 2}) == {"sum": 3}
        many = [ros.call("/add", {"a": n, "b": 0}) for n in range(50)]
        assert await asyncio.gather(*many) == [{"sum": n} for n in range(50)]


async def test_a_refusal_comes_with_its_words():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        fake.serve("/no", lambda _args: "not today")
        with pytest.raises(ServiceError) as caught:
            await ros.call("/no")
        assert caught.value.reason == "not today"
        assert str(caught.value) == f"service /no at {fake.uri} refused the call: not today"
        with pytest.raises(ServiceError, match="Service /nowhere does not exist"):
            await ros.call("/nowhere")


async def test_no_answer():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        fake.serve("/mute", lambda _args: None)
        begun = time.monotonic()
        with pytest.raises(NoAnswerError) as caught:
            await ros.call("/mute", timeout=0.1)
        assert time.monotonic() - begun < 30
        assert str(caught.value) == f"service /mute at {fake.uri} did not answer within 0.1 s"


async def test_a_late_answer_is_nobodys():
    async with FakeRosbridge(delay=0.2) as fake, connect(fake.uri) as ros:
        fake.serve("/s", lambda args: args)
        with pytest.raises(NoAnswerError):
            await ros.call("/s", {"n": 1}, timeout=0.05)
        assert not ros._session.core.calls
        assert await ros.call("/s", {"n": 2}) == {"n": 2}
        assert ros.unusable == 0


async def test_what_cannot_be_asked():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        with pytest.raises(EncodeError):
            await ros.call("/s", {"x": math.nan})
        with pytest.raises(NameFormError):
            await ros.call("/s s")
        assert fake.received == []


async def test_a_lost_connection_fails_what_waits():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        fake.serve("/mute", lambda _args: None)
        call = asyncio.create_task(ros.call("/mute", timeout=30))
        await fake.wait_for_op("call_service")
        await fake.cut()
        with pytest.raises(DisconnectedError, match="/mute"):
            await asyncio.wait_for(call, 120)


async def test_closing_fails_what_waits():
    async with FakeRosbridge() as fake:
        async with connect(fake.uri) as ros:
            fake.serve("/mute", lambda _args: None)
            call = asyncio.create_task(ros.call("/mute", timeout=30))
            await fake.wait_for_op("call_service")
        with pytest.raises(DisconnectedError, match="was closed"):
            await asyncio.wait_for(call, 120)
        with pytest.raises(DisconnectedError, match="this client was closed"):
            await ros.call("/mute")
        assert ros.state is State.CLOSED


# Serving


async def test_a_service_of_this_client():
    async def double(args: dict[str, Any]) -> dict[str, Any]:
        await asyncio.sleep(0)
        return {"n": 2 * args["n"]}

    async def nothing(_args: dict[str, Any]) -> None:
        pass

    async with FakeRosbridge() as fake, connect(fake.uri) as server, connect(fake.uri) as caller:
        service = await server.advertise_service("/double", "p/Double", double)
        await server.advertise_service("nothing", "p/Nothing", nothing)
        with pytest.raises(TypeConflictError):
            await server.advertise_service("/double", "p/Double", double)
        await fake.wait_for_op("advertise_service", count=2)
        assert await caller.call("/double", {"n": 4}) == {"n": 8}
        assert await caller.call("/nothing") == {}
        await service.close()
        await fake.wait_for_op("unadvertise_service", service="/double")
        with pytest.raises(ServiceError, match="does not exist"):
            await caller.call("/double", {"n": 4})
        async with await server.advertise_service("/double", "p/Double", double):
            await fake.wait_for_op("advertise_service", count=3)
            assert await caller.call("/double", {"n": 5}) == {"n": 10}


@pytest.mark.parametrize(
    ("outcome", "said"),
    [
        (ServiceError("no room"), "no room"),
        (ValueError("secret"), "/s failed: ValueError"),
        ({"x": math.nan}, "the answer cannot be sent: values.x is NaN"),
        ({"x": object()}, "the answer cannot be sent: the message cannot be written as JSON"),
        (None, "/s did not finish within 0.1 s"),
    ],
)
async def test_a_handler_that_fails(outcome, said, caplog):
    async def handler(_args: dict[str, Any]) -> Any:
        if isinstance(outcome, Exception):
            raise outcome
        if outcome is None:
            await asyncio.sleep(60)
        return outcome

    async with FakeRosbridge() as fake, connect(fake.uri) as server, connect(fake.uri) as caller:
        limit = 0.1 if outcome is None else 30
        await server.advertise_service("/s", "p/T", handler, handler_timeout=limit)
        await fake.wait_for_op("advertise_service")
        with pytest.raises(ServiceError) as caught:
            await caller.call("/s")
        assert caught.value.reason.startswith(said)
        assert "secret" not in str(caught.value)
        assert ("secret" in caplog.text) == isinstance(outcome, ValueError)


async def test_closing_ends_what_is_being_handled():
    began, ended = asyncio.Event(), asyncio.Event()

    async def handler(_args: dict[str, Any]) -> None:
        began.set()
        try:
            await asyncio.sleep(60)
        finally:
            ended.set()

    async with FakeRosbridge() as fake, connect(fake.uri) as caller:
        async with connect(fake.uri) as server:
            await server.advertise_service("/s", "p/T", handler)
            await fake.wait_for_op("advertise_service")
            call = asyncio.create_task(caller.call("/s", timeout=0.5))
            await asyncio.wait_for(began.wait(), 120)
        await asyncio.wait_for(ended.wait(), 120)
        with pytest.raises(NoAnswerError):
            await call


async def test_more_requests_than_can_be_handled_are_refused():
    release = asyncio.Event()

    async def handler(_args: dict[str, Any]) -> None:
        await release.wait()

    async with FakeRosbridge() as fake, connect(fake.uri) as server, connect(fake.uri) as caller:
        await server.advertise_service("/s", "p/T", handler)
        await fake.wait_for_op("advertise_service")
        calls = [asyncio.create_task(caller.call("/s", timeout=30)) for _ in range(70)]
        await fake.wait_for_op("service_response", count=6)
        release.set()
        results = await asyncio.gather(*calls, return_exceptions=True)
        assert [type(result) for result in results] == [dict] * 64 + [ServiceError] * 6
