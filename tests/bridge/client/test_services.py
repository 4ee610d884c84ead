"""Services in both directions through the fake server."""

import asyncio
import math

import pytest

from bridge.client import State, connect
from bridge.errors import DisconnectedError, EncodeError, NoAnswerError, ServiceError
from tests.patience import PATIENCE


async def test_calls_and_refusals(fake, ros):
    fake.serve("/add", lambda args: {"sum": args["a"] + args["b"]})
    fake.serve("/no", lambda _args: "not today")
    many = [ros.call("/add", {"a": n, "b": 1}) for n in range(50)]
    assert await asyncio.gather(*many) == [{"sum": n + 1} for n in range(50)]
    with pytest.raises(ServiceError) as caught:
        await ros.call("/no")
    assert caught.value.reason == "not today"
    assert str(caught.value) == f"service /no at {fake.uri} refused the call: not today"
    for args, error in (({"a": math.nan}, EncodeError), ({"a": object()}, EncodeError)):
        with pytest.raises(error):
            await ros.call("/add", args)
    calls = fake.ops("call_service")
    assert len(calls) == len(fake.received) == 52
    # without rosapi, the first call asks for the type in vain, and the others do not ask
    assert [call["service"] for call in calls].count("/rosapi/service_type") == 1


@pytest.mark.parametrize("fake", [{"delay": 0.5}], indirect=True)
async def test_no_answer_in_time(fake, ros):
    fake.serve("/s", lambda args: args)
    with pytest.raises(NoAnswerError) as caught:
        await ros.call("/s", {"n": 1}, timeout=0.1)
    assert str(caught.value) == f"service /s at {fake.uri} did not answer within 0.1 s"
    assert not ros._session.core.calls
    assert await ros.call("/s", {"n": 2}, timeout=PATIENCE) == {"n": 2}
    assert ros.unusable == 0


@pytest.mark.parametrize("end", ["lost", "closed"])
async def test_the_end_of_the_connection_fails_what_waits(fake, ros, end):
    fake.serve("/mute", lambda _args: None)
    call = asyncio.create_task(ros.call("/mute", timeout=PATIENCE))
    await fake.wait_for_op("call_service", service="/mute")
    await (fake.cut() if end == "lost" else ros.close())
    with pytest.raises(DisconnectedError, match="/mute"):
        await asyncio.wait_for(call, PATIENCE)
    if end == "closed":
        with pytest.raises(DisconnectedError):
            await ros.call("/mute")
        assert ros.state is State.CLOSED


async def test_a_service_of_this_client(fake, ros, caller):
    async def double(args):
        await asyncio.sleep(0)
        return {"n": 2 * args["n"]}

    async def nothing(_args):
        pass

    service = await ros.advertise_service("/double", "p/Double", double)
    await ros.advertise_service("nothing", "p/Nothing", nothing)
    await fake.wait_for_op("advertise_service", count=2)
    assert await caller.call("/double", {"n": 4}) == {"n": 8}
    assert await caller.call("/nothing") == {}
    await service.close()
    await fake.wait_for_op("unadvertise_service", service="/double")
    with pytest.raises(ServiceError):
        await caller.call("/double", {"n": 4})
    async with await ros.advertise_service("/double", "p/Double", double):
        await fake.wait_for_op("advertise_service", count=3)
        assert await caller.call("/double", {"n": 5}) == {"n": 10}


@pytest.fixture
async def caller(fake):
    async with connect(fake.uri) as caller:
        yield caller


@pytest.mark.parametrize(
    ("outcome", "said"),
    [
        (ServiceError("no room"), "no room"),
        (ValueError("secret"), "/s failed: ValueError"),
        ({"x": math.nan}, "the answer cannot be sent: values.x is NaN"),
        ({"x": object()}, "the answer cannot be sent: "),
        (None, "/s did not finish within 0.1 s"),
    ],
)
async def test_a_handler_that_fails(fake, ros, caller, outcome, said, caplog):
    async def handler(_args):
        if isinstance(outcome, Exception):
            raise outcome
        if outcome is None:
            await asyncio.sleep(60)
        return outcome

    await ros.advertise_service("/s", "p/T", handler, handler_timeout=0.1 if outcome is None else PATIENCE)
    await fake.wait_for_op("advertise_service")
    assert await caller.call("/s") == {}  # the reference server passes the answer on, whatever its result
    (answer,) = fake.ops("service_response")
    assert (answer["values"], answer["result"]) == ({}, False)
    assert answer["reason"].startswith(said)
    assert "secret" not in answer["reason"]
    assert ("secret" in caplog.text) == isinstance(outcome, ValueError)


async def test_closing_ends_what_is_being_handled(fake, ros, caller):
    began, ended = asyncio.Event(), asyncio.Event()

    async def handler(_args):
        began.set()
        try:
            await asyncio.sleep(60)
        finally:
            ended.set()

    await ros.advertise_service("/s", "p/T", handler)
    await fake.wait_for_op("advertise_service")
    call = asyncio.create_task(caller.call("/s", timeout=0.2))
    await asyncio.wait_for(began.wait(), PATIENCE)
    await ros.close()
    assert ended.is_set()
    with pytest.raises(NoAnswerError):
        await call
