"""The command demo: requests that it refuses before anything starts, and its words while it works."""

import asyncio
import re
import socket

import pytest

from bridge.discovery import UnknownRobotError
from casestudies import demo
from tests.command_runner import invoke
from tests.patience import PATIENCE


@pytest.fixture(autouse=True)
def _nothing_may_start(monkeypatch):
    monkeypatch.setattr(demo.Process, "start", pytest.fail)


def test_a_robot_is_looked_up_before_anything_starts(tmp_path, monkeypatch):
    async def resolve(name, _timeout):
        raise UnknownRobotError(f"no robot called {name}")

    monkeypatch.setattr("bridge.discovery.resolve", resolve)
    ended = invoke(demo.app, ["--uri", "robot:Adam", "--out", str(tmp_path)])
    assert ended.exit_code == UnknownRobotError.exit_code
    assert "no robot called Adam" in ended.stderr


@pytest.mark.parametrize("flags", [["--stay"], ["--dashboard", "--uri", "ws://127.0.0.1:1", "--page-port"]])
def test_a_port_that_is_taken_is_named_before_anything_starts(tmp_path, monkeypatch, flags):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        monkeypatch.setattr(demo, "PORT", port)
        given = [*flags, port] if "--page-port" in flags else flags
        ended = invoke(demo.app, [*given, "--out", str(tmp_path / "out")])
    assert ended.exit_code == 2
    assert f"port {port}" in ended.stderr
    assert ("--page-port" if "--page-port" in flags else f"--uri ws://127.0.0.1:{port}") in ended.stderr
    assert not (tmp_path / "out").exists()


def test_one_case_study_is_run_at_a_time(tmp_path):
    ended = invoke(demo.app, ["--sprinkler", "--disparity", "--out", str(tmp_path / "out")])
    assert ended.exit_code == 2
    assert "--sprinkler and --disparity" in ended.stderr


def test_a_missing_page_is_named_before_anything_starts(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "find_spec", lambda _name: None)
    ended = invoke(demo.app, ["--dashboard", "--out", str(tmp_path / "out")])
    assert ended.exit_code == 2
    assert "pip install 'rosbayes[dashboard]'" in ended.stderr
    assert not (tmp_path / "out").exists()


class PretendedScreen:
    """A screen that says nothing, and has an event for the drawing."""

    def __init__(self):
        self.draws = asyncio.Event()

    @property
    def waits_for(self):
        raise NotImplementedError

    @waits_for.setter
    def waits_for(self, words):
        if words == "drawing the pictures":
            self.draws.set()

    def show(self, _text):
        pass

    async def say_what_it_waits_for(self):
        await asyncio.Event().wait()


async def test_it_says_that_the_matcher_draws(tmp_path, monkeypatch):
    """The master of the disparity runs on, and the matcher draws after the line of its last pair."""
    screen = PretendedScreen()

    class PretendedProcess:
        def __init__(self, name, _log, **_):
            self.name = name
            self.ended = asyncio.Event()

        async def start(self, *_):
            pass

        async def line(self, pattern):
            said = ("ws://127.0.0.1:1", "listening", "   1   160", "   2   160")
            return next(filter(None, (re.search(pattern, text) for text in said)))

        async def succeed(self):
            if self.name == "master":
                await self.ended.wait()
            elif self.name == "disparity-matcher":
                async with asyncio.timeout(PATIENCE):
                    await screen.draws.wait()

        async def end(self):
            self.ended.set()

    monkeypatch.setattr(demo, "Screen", lambda: screen)
    monkeypatch.setattr(demo, "Process", PretendedProcess)
    monkeypatch.setattr(demo, "_load_kernels", lambda: asyncio.sleep(0))
    case = demo.disparity(["--rate", "2"])
    assert await demo._run(case, None, 2, tmp_path, page_port=None, options=()) == 0
