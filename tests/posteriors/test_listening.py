"""Listening to a stack's posteriors: in order, over losses, in time, with or without asyncio.

fake server  ->  /bm/frame, /BMresults  ->  posteriors(), listen()
"""

import asyncio
import contextlib
import errno
import subprocess
import sys
import threading

import pytest

from bridge.client import State, connect
from bridge.discovery import UnknownRobotError
from bridge.errors import ConcurrentReadError, DisconnectedError, OptionError, UnreachableError
from posteriors import BadResultError, NoResultError, listen, posteriors
from posteriors.frame_report import FrameReport
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE, PROCESS_PATIENCE
from tests.posteriors.messages import posterior_message, report_message


def report(number, *, published=True, deployment="boat"):
    outcome = "posterior" if published else "no posterior: impossible"
    values = {"number": number, "cycles": 800, "published": str(published).lower(), "compute_us": 12.5}
    return report_message({"sec": number, "nanosec": 0}, outcome, deployment, **values)


def result(*data):
    return posterior_message([value / sum(data) for value in data], 2, 2)


async def say(fake, number, *data, **about):
    published = bool(data)
    await fake.publish("/bm/frame", report(number, published=published, **about))
    if published:
        await fake.publish("/BMresults", result(*data))


@contextlib.asynccontextmanager
async def hearing(**options):
    async with FakeRosbridge() as fake, connect(fake.uri) as ros, posteriors(ros, **options) as heard:
        await fake.wait_for_op("subscribe", topic=options.get("topic", "/BMresults"))
        yield fake, heard


async def test_each_posterior_has_its_frames_data():
    async with hearing() as (fake, heard):
        for number in range(1, 4):
            await say(fake, number, *[1] * number, *[0] * (4 - number))
        numbers = []
        async with asyncio.timeout(PATIENCE):
            async for posterior in heard:
                numbers.append(posterior.number)
                assert posterior.values.shape == (2, 2)
                assert posterior.stamp_ns == posterior.number * 10**9
                assert (posterior.cycles, posterior.stages.compute) == (800, 12.5)
                assert posterior.at(y=0, x=0) == 1 / posterior.number
                if len(numbers) == 3:
                    break
        assert numbers == [1, 2, 3]
        assert (heard.lost, heard.without_posterior, heard.announced_only) == (0, 0, 0)


async def test_frames_without_a_posterior_are_passed_over_or_told_and_one_without_a_report_comes_too():
    async with hearing() as (fake, heard):
        await say(fake, 1)
        await say(fake, 2, 0, 0, 0, 1)
        await say(fake, 3)
        assert (await heard.next(PATIENCE)).number == 2
        assert heard.without_posterior == 1
        frame = await heard.next_frame(PATIENCE)
        assert isinstance(frame, FrameReport)
        assert (frame.number, frame.outcome) == (3, "no posterior: impossible")
        await fake.publish("/BMresults", result(0, 1, 0, 0))
        posterior = await heard.next(PATIENCE)
        assert (posterior.number, posterior.best()) == (None, {"y": 0, "x": 1})


async def test_other_topics_and_other_stacks():
    async with hearing(topic="/here", frame_topic="/frames", deployment="boat") as (fake, heard):
        await fake.publish("/frames", report(70, deployment="car"))
        await fake.publish("/frames", report(5))
        await fake.publish("/here", result(1, 0, 0, 0))
        assert (await heard.next(PATIENCE)).number == 5


async def test_silence_is_named():
    async with hearing() as (fake, heard):
        with pytest.raises(NoResultError):
            await heard.next(0.1)
        await fake.vanish()
        await heard._ros.wait_for_state(State.RECONNECTING, PATIENCE)
        with pytest.raises(NoResultError, match=State.RECONNECTING):
            await heard.next(0.2)


@pytest.mark.parametrize("topic", ["/bm/frame", "/BMresults"])
async def test_nonsense_is_raised_once_and_in_its_place(topic):
    async with hearing() as (fake, heard):
        await say(fake, 1, 1, 0, 0, 0)
        assert (await heard.next(PATIENCE)).number == 1
        await fake.publish(topic, {"data": "nonsense"})
        with pytest.raises(BadResultError, match=topic):
            await heard.next(PATIENCE)
        await say(fake, 2, 1, 0, 0, 0)
        assert (await heard.next(PATIENCE)).number == 2


async def test_a_slow_reader_loses_the_oldest():
    async with hearing(queue_size=2) as (fake, heard):
        for number in range(1, 11):
            await say(fake, number, 1, 0, 0, 0)
        async with asyncio.timeout(PATIENCE):
            while heard.lost < 8:
                await asyncio.sleep(0.01)
        assert [(await heard.next(PATIENCE)).number for _ in range(2)] == [9, 10]


async def test_after_a_reconnection_it_goes_on():
    async with hearing() as (fake, heard):
        await say(fake, 1, 1, 0, 0, 0)
        assert (await heard.next(PATIENCE)).number == 1
        await fake.vanish()
        await fake.come_back()
        await fake.wait_for_op("subscribe", topic="/BMresults", count=2, timeout=PATIENCE)
        await say(fake, 2, 1, 0, 0, 0)
        assert (await heard.next(PATIENCE)).number == 2
        assert heard.blind_seconds > 0


async def test_closing_ends_the_iteration_after_what_waits():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        heard = posteriors(ros)
        await fake.wait_for_op("subscribe", topic="/BMresults")
        await fake.publish("/BMresults", result(1, 0, 0, 0))  # its report never comes
        async with asyncio.timeout(PATIENCE):
            while not heard._pairing.waits:
                await asyncio.sleep(0.01)
        await heard.close()
        assert [posterior.number async for posterior in heard] == [None]
        with pytest.raises(DisconnectedError):
            await heard.next(1)
        await fake.wait_for_op("unsubscribe", topic="/bm/frame")


async def test_two_readers_are_one_too_many_and_closing_the_client_ends_the_first():
    async with hearing() as (_fake, heard):
        first = asyncio.create_task(heard.next(None))
        await asyncio.sleep(0)
        with pytest.raises(ConcurrentReadError):
            await heard.next(1)
        with pytest.raises(OptionError):
            posteriors(heard._ros, queue_size=0)
        await heard._ros.close()
        with pytest.raises(DisconnectedError):
            await asyncio.wait_for(first, PATIENCE)


class Calling:
    """`listen` in a thread of its own, while this one plays the stack."""

    def __init__(self, fake):
        self.fake = fake
        self.server = fake.uri

    async def __call__(self, function, frames=3, **options):
        heard_before = len(self.fake.ops("subscribe", topic="/BMresults"))

        async def play():
            await self.fake.wait_for_op(
                "subscribe", topic="/BMresults", count=heard_before + 1, timeout=PATIENCE
            )
            for number in range(1, frames + 1):
                await say(self.fake, number, 1, 0, 0, 0)

        playing = asyncio.create_task(play())
        try:
            async with asyncio.timeout(PATIENCE):
                return await asyncio.to_thread(listen, self.server, function, **options)
        finally:
            await playing


@pytest.fixture
async def calling():
    async with FakeRosbridge() as fake:
        yield Calling(fake)
    assert not [thread for thread in threading.enumerate() if thread.name == "event loop"]


async def test_a_function_gets_each_in_the_callers_thread(calling):
    got = []
    threads = set()

    def function(posterior):
        got.append(posterior.number)
        threads.add(threading.current_thread().name)

    assert await calling(function, count=3) == 3
    assert got == [1, 2, 3]
    assert "event loop" not in threads


async def test_returning_false_ends_it_and_nothing_or_zero_does_not(calling):
    assert await calling(lambda posterior: posterior.number < 2) == 2
    assert await calling(lambda posterior: 0 if posterior.number == 1 else None, count=2) == 2


async def test_the_functions_exceptions_are_raised_and_a_client_may_be_given_instead_of_a_uri(calling):
    with pytest.raises(ZeroDivisionError):
        await calling(lambda posterior: 1 / 0)
    calling.server = connect(calling.fake.uri, connect_timeout=PATIENCE)
    assert await calling(lambda posterior: None, count=1) == 1


async def test_silence_ends_it(calling):
    with pytest.raises(NoResultError):
        await calling(lambda posterior: None, frames=0, first_timeout=0.2)
    with pytest.raises(NoResultError):
        await calling(lambda posterior: None, frames=1, timeout=0.3)


async def test_no_server():
    with pytest.raises(UnreachableError):
        await asyncio.to_thread(listen, "ws://127.0.0.1:1", print)


CTRL_C = """
import os, signal, sys
from posteriors.listening import listen
def function(posterior):
    print("got", posterior.number, flush=True)
    if "{when}" == "inside":
        signal.raise_signal(signal.SIGINT)
print("ended after", listen("{uri}", function), flush=True)
"""


@pytest.mark.parametrize(
    "when",
    [pytest.param("inside", marks=pytest.mark.thorough), pytest.param("waiting", marks=pytest.mark.process)],
)
@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_ctrl_c_is_an_end_like_any_other(when):
    async with FakeRosbridge() as fake:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", CTRL_C.format(when=when, uri=fake.uri), stdout=asyncio.subprocess.PIPE
        )
        try:
            await fake.wait_for_op("subscribe", topic="/BMresults", timeout=PROCESS_PATIENCE)
            await say(fake, 1, 1, 0, 0, 0)
            assert process.stdout is not None
            async with asyncio.timeout(PROCESS_PATIENCE):
                assert await process.stdout.readline() == b"got 1\n"
                if when == "waiting":
                    process.send_signal(2)
                assert await process.stdout.readline() == b"ended after 1\n"
                assert await process.wait() == 0
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.communicate()


@pytest.mark.thorough
def test_numpy_is_not_imported_before_it_is_wanted():
    code = "import sys, posteriors; sys.exit('numpy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PROCESS_PATIENCE)


def test_a_thread_without_a_loop_raises_in_the_caller(monkeypatch):
    def new_event_loop():
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(asyncio, "new_event_loop", new_event_loop)
    with pytest.raises(OSError, match="Too many"):
        listen("ws://127.0.0.1:1", print)


def test_a_robots_name_is_a_server(monkeypatch):
    async def resolve(name, _timeout):
        raise UnknownRobotError(f"no robot called {name}")

    monkeypatch.setattr("bridge.discovery.resolve", resolve)
    with pytest.raises(UnknownRobotError, match="Zoë"):
        listen("robot:Zoë", print)


async def test_silence_on_a_topic_of_another_type_names_the_type():
    async with FakeRosbridge(rosapi=True) as fake, connect(fake.uri) as ros:
        fake.know("/BMresults", "std_msgs/msg/String")
        async with posteriors(ros) as heard:
            with pytest.raises(NoResultError, match="std_msgs/msg/String"):
                await heard.next(0.1)
