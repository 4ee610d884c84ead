"""Readiness of a case study's process, publications that a server refuses, and a robot's name as `--uri`."""

import asyncio
import json
import re
from unittest.mock import AsyncMock

import pytest

from bridge.discovery import UnknownRobotError
from bridge.errors import MessageTooLargeError
from casestudies import topics
from casestudies.boat.normaliser import app as normaliser
from casestudies.boat.simulator import app as simulator
from casestudies.boat.viewer import app as viewer
from casestudies.mrclam.player import app as player
from casestudies.sprinkler.garden import app as garden
from casestudies.sprinkler.viewer import app as sprinkler_viewer
from casestudies.topics import LossyPublication, connected
from terminal.health import is_ready, read_status, status_socket
from tests.command_runner import invoke
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE

WORK = "a result was shown"


@pytest.fixture
async def readiness(tmp_path, monkeypatch):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))
    async with FakeRosbridge() as fake, connected("boat-viewer", WORK, fake.uri) as (_, readiness):
        yield readiness


async def asked(directory):
    return await asyncio.to_thread(is_ready, status_socket(directory, "boat-viewer"), PATIENCE)


async def test_ready_while_it_works(tmp_path, readiness, monkeypatch):
    monkeypatch.setattr(topics, "RECENT_S", PATIENCE)
    ready, why = await asked(tmp_path)
    assert (ready, why.endswith(WORK)) == (False, True)
    readiness.record()
    ready, why = await asked(tmp_path)
    assert ready
    assert re.fullmatch(WORK + r" [\d.]+ s ago, 1 in all", why)
    monkeypatch.setattr(topics, "RECENT_S", 0.0)
    await asyncio.sleep(0.01)
    assert not (await asked(tmp_path))[0]


async def test_is_a_status_of_the_stack(tmp_path, readiness):
    path = status_socket(tmp_path, "boat-viewer")
    status = json.loads(await asyncio.to_thread(read_status, path, PATIENCE))
    assert (status["name"], status["ready"]) == ("boat-viewer", False)
    assert status["pid"] > 0


TYPE = "boat_msgs/Raw"


class Server:
    def __init__(self, known):
        self._known = known

    async def topic_type(self, _topic):
        return self._known


@pytest.mark.parametrize(
    ("known", "warnings"), [(None, 0), ("", 1), ("boat_msgs/msg/Raw", 0), ("std_msgs/String", 1)]
)
async def test_a_refused_topic_is_reported_as_far_as_rosapi_tells(known, warnings, capsys, monkeypatch):
    monkeypatch.setattr(topics, "SETTLED_S", 0)
    await topics.report_refused(Server(known), "/boat/raw", TYPE)
    assert capsys.readouterr().err.count("warning: ") == warnings


@pytest.fixture
def looked_up(monkeypatch):
    """The names that are looked up; only `Zoë` is announced, at a port where nothing listens."""

    async def resolve(name, _timeout):
        names.append(name)
        if name != "Zoë":
            raise UnknownRobotError(f"no robot called {name}")
        return "ws://127.0.0.1:1"

    names = []
    monkeypatch.setattr("bridge.discovery.resolve", resolve)
    monkeypatch.setattr("bridge.client.session.FIRST_DELAY", 3600)  # the first attempt is the last
    return names


@pytest.mark.parametrize("command", [simulator, normaliser, viewer, garden, sprinkler_viewer])
def test_a_robots_name_stands_for_its_uri(command, looked_up, monkeypatch):
    found = invoke(command, ["--uri", "robot:Zoë"])
    assert (found.exit_code, looked_up) == (3, ["Zoë"])
    assert found.stderr.splitlines()[-1].startswith("error: ")
    assert "ws://127.0.0.1:1" in found.stderr
    assert "Traceback" not in found.stderr
    monkeypatch.setenv("BM_URI", "robot:Adam")
    unknown = invoke(command, [])
    assert (unknown.exit_code, looked_up) == (3, ["Zoë", "Adam"])
    assert unknown.stderr.splitlines() == ["error: no robot called Adam"]


def test_a_player_looks_it_up_too(looked_up):
    assert invoke(player, ["nowhere.csv", "--uri", "robot:Adam"]).exit_code == 3
    assert looked_up == ["Adam"]


@pytest.mark.parametrize(
    ("command", "flag", "name"),
    [(viewer, "--out", "pictures"), (viewer, "--json", "n.json"), (sprinkler_viewer, "--out", "pictures")],
)
def test_a_folder_that_cannot_be_written_is_reported_at_the_start(command, flag, name, tmp_path):
    (tmp_path / "file").write_text("")
    ended = invoke(command, ["--uri", "ws://127.0.0.1:1", flag, tmp_path / "file" / name])
    assert ended.exit_code == 2  # an unreachable server is 3
    assert ended.stderr.startswith(f"error: {tmp_path}/file")


async def test_messages_that_are_too_large_are_dropped_with_one_warning(capsys):
    publication = AsyncMock(topic="/t")
    lossy = LossyPublication(publication)
    for error in (MessageTooLargeError("it has 9 bytes"), MessageTooLargeError("it has 9 bytes"), None):
        publication.publish.side_effect = error
        assert await lossy.publish({}) is (error is None)
    assert [line.partition(": ")[2] or line for line in capsys.readouterr().err.splitlines()] == [
        "it has 9 bytes; it is dropped",
        "/t is published again",
    ]
