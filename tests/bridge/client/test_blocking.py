"""The blocking client: errors, Ctrl-C and the exit end waits for the asyncio client on its thread."""

import asyncio
import logging
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from bridge.client import State
from bridge.client.blocking import BlockingRos, connect
from bridge.errors import (
    DisconnectedError,
    GoalError,
    MessageTypeError,
    NoMessageError,
    OptionError,
    ServiceError,
    UnreachableError,
    UriError,
)
from tests.bridge.hub.sockets import running_hub
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE, PROCESS_PATIENCE


async def against_a_hub(program: Callable[[BlockingRos], Any]) -> Any:
    """Run a blocking program on another thread than the hub."""

    def run(uri: str) -> Any:
        with connect(uri) as ros:
            return program(ros)

    async with running_hub(ros_version=2) as port:
        return await asyncio.wait_for(asyncio.to_thread(run, f"ws://127.0.0.1:{port}"), PATIENCE)


async def test_topics_with_an_iterator_and_with_a_callback():
    def program(ros: BlockingRos) -> None:
        heard: list[Any] = []
        done = threading.Event()

        def hear(message: Any) -> None:
            heard.append(message.msg["data"])
            assert (
                ros.topic_type("/words", PATIENCE) == "std_msgs/msg/String"
            )  # a callback may call the client
            if len(heard) == 3:
                done.set()

        ros.subscribe("/words", "std_msgs/String", hear)
        subscription = ros.subscribe("/words", "std_msgs/String", timeout=PATIENCE)
        publication = ros.advertise("/words", "std_msgs/String")
        for word in "abc":
            publication.publish({"data": word})
        assert [next(subscription).msg["data"] for _ in range(3)] == ["a", "b", "c"]
        assert done.wait(PATIENCE)
        assert heard == ["a", "b", "c"]
        with pytest.raises(MessageTypeError):
            publication.publish({"date": "x"})
        with pytest.raises(NoMessageError):
            subscription.next(0.05)
        subscription.close()
        assert list(subscription) == []

    await against_a_hub(program)


async def test_a_callback_that_fails_is_reported_and_called_again(caplog):
    def program(ros: BlockingRos) -> None:
        second = threading.Event()

        def fail(message: Any) -> None:
            if message.msg["data"] == "second":
                second.set()
            raise RuntimeError("of the callback")

        ros.subscribe("/words", "std_msgs/String", fail)
        publication = ros.advertise("/words", "std_msgs/String")
        publication.publish({"data": "first"})
        publication.publish({"data": "second"})
        assert second.wait(PATIENCE)

    with caplog.at_level(logging.ERROR, "bridge"):
        await against_a_hub(program)
    errors = [record.exc_info[0] for record in caplog.records if record.exc_info]
    assert errors[0] is RuntimeError


async def test_services():
    def program(ros: BlockingRos) -> None:
        def add(args: dict[str, Any]) -> dict[str, Any]:
            if "a" not in args:
                raise ServiceError("a is needed")
            return {"sum": args["a"] + ros.call("/one")["one"]}  # a handler may call the client

        ros.advertise_service("/one", "p/One", lambda _args: {"one": 1})
        with ros.advertise_service("/add", "p/Add", add):
            assert ros.call("/add", {"a": 2}, timeout=PATIENCE) == {"sum": 3}
            with pytest.raises(ServiceError) as caught:
                ros.call("/add", {"b": 2})
            assert caught.value.reason == "a is needed"
        assert "/add" not in (ros.services() or [])

    await against_a_hub(program)


async def test_a_goal_of_an_action_that_is_not_there():
    def program(ros: BlockingRos) -> None:
        with ros.send_goal("/fly", "p/action/Fly", {}) as goal:
            with pytest.raises(GoalError):
                goal.result(PATIENCE)
            assert goal.done

    await against_a_hub(program)


def test_a_server_that_is_not_there_is_an_error_at_once_and_leaves_no_thread(unused_tcp_port):
    before = threading.active_count()
    with pytest.raises(UnreachableError):
        connect(f"ws://127.0.0.1:{unused_tcp_port}")
    assert threading.active_count() == before


async def test_closing_twice_and_from_callbacks():
    def program(ros: BlockingRos) -> None:
        subscription = ros.subscribe("/words", "std_msgs/String", lambda _message: ros.close())
        ros.advertise("/words", "std_msgs/String").publish({"data": "close"})
        deadline = time.monotonic() + PATIENCE
        while ros.state is not State.CLOSED:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        ros.close()
        ros.close()
        subscription.close()
        with pytest.raises(DisconnectedError):
            ros.call("/rosapi/topics")
        with pytest.raises(DisconnectedError):
            subscription.next(1)

    await against_a_hub(program)


async def test_closing_ends_a_wait_of_another_thread():
    def program(ros: BlockingRos) -> None:
        subscription = ros.subscribe("/silent", "std_msgs/String")
        threading.Timer(0.05, ros.close).start()
        with pytest.raises(DisconnectedError):
            subscription.next(3600)

    await against_a_hub(program)


@pytest.mark.parametrize(
    ("uri", "options", "error"),
    [("ws://127.0.0.1:1", {"ping_interval": -1}, OptionError), ("http://127.0.0.1", {}, UriError)],
)
def test_refused_options_leave_no_thread_behind(uri, options, error):
    before = set(threading.enumerate())
    with pytest.raises(error):
        connect(uri, on_state=lambda _state, _reason: None, **options)
    assert set(threading.enumerate()) == before


async def test_on_state_runs_on_a_thread_of_its_own_and_may_close():
    opened, closed = threading.Event(), threading.Event()

    def run(uri: str) -> None:
        def on_state(state: State, _reason: str) -> None:
            if state is State.RECONNECTING:
                ros.close()
            if state is State.CLOSED:
                closed.set()

        ros = connect(uri, on_state=on_state)
        opened.set()
        assert closed.wait(PATIENCE)

    async with FakeRosbridge() as fake:
        running = asyncio.create_task(asyncio.to_thread(run, fake.uri))
        assert await asyncio.to_thread(opened.wait, PATIENCE)
        await fake.cut()
        await asyncio.wait_for(running, PATIENCE)


@pytest.mark.parametrize(
    ("body", "interrupt", "code"),
    [
        pytest.param(  # without close
            "ros.advertise('/words', 'std_msgs/String').publish({'data': 'last'})",
            *(False, 0),
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            "ros.subscribe('/s', 'p/T', print); raise SystemExit(5)", False, 5, marks=pytest.mark.thorough
        ),
        pytest.param(
            "ros.advertise_service('/s', 'p/S', lambda args: time.sleep(3600)); ros.call('/s', timeout=0.2)",
            *(False, 1),
            marks=pytest.mark.process,
        ),
        pytest.param(
            "s = ros.subscribe('/s', 'p/T'); print('waiting', flush=True); s.next(3600)",
            *(True, -signal.SIGINT),
            marks=pytest.mark.process,
        ),
    ],
)
@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_exit_and_ctrl_c_do_not_hang(body, interrupt, code):
    async with running_hub(ros_version=2) as port:
        script = f"import time\nfrom bridge.client.blocking import connect\nros = connect('ws://127.0.0.1:{port}')\n{body}\n"
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", script, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        try:
            if interrupt:
                assert process.stdout is not None
                await process.stdout.readline()
                process.send_signal(signal.SIGINT)
            _out, errors = await asyncio.wait_for(process.communicate(), PROCESS_PATIENCE)
        finally:
            if process.returncode is None:
                process.kill()
                await process.communicate()
        assert process.returncode == code, errors.decode()
