"""The command and its page: what it refuses, and one process between a hub and a browser that is a plain WebSocket.

test's robot  -->  hub (a process)  -->  dashboard (a process)  -->  pages and /live, read here
"""

import asyncio
import contextlib
import fnmatch
import http.client
import json
import math
import os
import signal
import socket
import struct
import tomllib
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import AsyncMock

import pytest
import websockets
from fastapi import WebSocketDisconnect

from bridge.client import connect
from bridge.errors import DisconnectedError, TopicLeftOutError
from posteriors.errors import BadResultError
from services.commands.dashboard import app
from services.commands.master import app as master
from services.dashboard.feed import Feed
from services.dashboard.page import Dashboard
from services.dashboard.robot import WatchedRobot, read_landmarks
from services.master.command_lines import dashboard_command
from services.settings import Settings
from tests.casestudies.pretend_stack import certain, frame_message
from tests.command_runner import invoke
from tests.integration.conftest import stage as stage  # noqa: PLC0414  # a fixture
from tests.patience import PROCESS_PATIENCE
from tests.posteriors.messages import posterior_message
from tests.services.dashboard.frames import posterior, report
from tests.toolchain import builders
from toolchain.deployment import BM2Section, BoardSection, Dimension

PROJECT = Path(__file__).parents[3] / "pyproject.toml"
FOLDER = PROJECT.parent / "services" / "dashboard"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--uri", "http://robot:9090"], "ws://"),
        (["--host", "192.0.2.1"], "--insecure"),
        (["--host", "192.0.2.1", "--token-file", "{token}"], "--tls-cert"),
        (["--tls-cert", "nowhere.pem"], "--tls-key"),
        (["--origin", "robot.example"], "--origin"),
        (["--truth", "no topic"], "no topic"),
        (["--port", "{taken}"], "--page-port"),
        (["-d", "nowhere"], "nowhere"),
    ],
)
def test_what_the_command_refuses(tmp_path, arguments, named):
    token = tmp_path / "token"
    token.write_text("a-token-of-sixteen-characters\n")
    token.chmod(0o600)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        ended = invoke(app, [each.format(token=token, taken=port) for each in arguments])
    assert (ended.exit_code, ended.stderr.count("\n")) == (2, 1)
    assert named in ended.stderr


def test_without_the_extra_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr("services.commands.dashboard.find_spec", lambda _name: None)
    ended = invoke(app, [])
    assert ended.exit_code == 2
    assert "rosbayes[dashboard]" in ended.stderr


def test_landmarks_of_a_message_or_none():
    pose = {"position": {"x": 1, "y": 2.5, "z": 0}}
    markers = [
        {"pose": pose, "text": "<b>"},
        {"pose": pose, "id": 3},
        {"pose": {"position": {"x": "1"}}},
        {"pose": {"position": {"x": 10**400, "y": math.nan}}},
        7,
    ]
    assert read_landmarks({"markers": markers}) == [(1.0, 2.5, "<b>"), (1.0, 2.5, "3")]
    for strange in ({}, {"markers": 3}, {"markers": [{"pose": 1}]}):
        assert read_landmarks(strange) == []
    (landmark,) = read_landmarks({"markers": [{"pose": pose, "text": "x" * 1_000_000}]})
    assert len(landmark[2]) == 100, "each page gets it twice a second"


async def nothing(*_arguments):
    pass


def watched(feed=None, deployment=None):
    """A robot that follows nothing but the plain topics."""
    robot = WatchedRobot(
        feed or Feed(), Settings(), deployment, uri="ws://robot:9090", topic="/BMresults", truth="/truth"
    )
    robot._ask_about_world = nothing
    return robot


STATE = 1 | 3 << 2 | 1 << 4 | 52 << 6 | 10 << 13


def samples_message(*states, words=1):
    data = b"".join(state.to_bytes(4 * words, "little") for state in states)
    return {"layout": {"dim": [{"size": len(states)}, {"size": 4 * words}]}, "data": list(data)}


@pytest.fixture
def chain():
    """A deployment whose samples are 22 bits of five variables."""
    boards = (BoardSection(image="boards/board0.bm", image_hash="a" * 64, line_offset=0, lines=1),)
    hidden = (Dimension(label="S", size=3, states=("no", "yes", "<b>")),)
    machine = BM2Section(lines=12, stream=4, variables=("S", "y", "x", "D1", "B1"))
    distance, bearing = builders.BOAT["variables"]
    variables = (distance.replace(unit="m"), bearing)
    return builders.boat(machine=machine, boards=boards, hidden=hidden, variables=variables)


async def samples_shown(deployment, *messages, of="boat"):
    async def subscribe(topic, _kind, **_flow):
        for message in messages if topic == "/bm/samples" else ():
            yield SimpleNamespace(msg=message)

    feed = Feed()
    feed.add(report(1, deployment=of), 0.0)
    robot = watched(feed, deployment)
    robot._follow_frames = nothing
    await robot._follow(SimpleNamespace(subscribe=subscribe))
    return robot.samples


async def test_sampled_states_are_shown_by_name(chain):
    words = "S=yes  y=3  x=1  D1=52 m  B1=10"
    message = samples_message(*[0] * 10, STATE, STATE | 3)
    shown = (await samples_shown(chain, message)).split("\n")
    assert (len(shown), shown[0]) == (8, "S=no  y=-3  x=0  D1=0 m  B1=0")
    assert shown[-2:] == [words, words.replace("S=yes", "S=code 3")]


async def test_states_of_other_machines_are_hexadecimal_words(chain, boat):
    message = samples_message(1 | 2 << 32, 3 | 0xABC << 32, words=2)
    for deployment in (None, boat, chain.replace(hidden=())):
        shown = await samples_shown(deployment, message)
        assert shown == "00000002 00000001\n00000abc 00000003"
    assert await samples_shown(chain, samples_message(STATE), of="garden") == f"{STATE:08x}"
    assert not await samples_shown(chain, message, {"layout": 3, "data": 10**12})
    long = await samples_shown(None, samples_message(1, words=10_000))
    assert len(long) == 1000


def test_units_are_those_of_the_deployment_of_a_frame(chain):
    feed = Feed()
    robot = watched(feed, chain)
    assert robot.words_for(feed.add(report(1, deployment="boat"), 0.0)) == {"D1": ("m", ()), "B1": ("", ())}
    assert robot.words_for(feed.add(report(1, deployment="garden"), 0.0)) == {}


async def test_switches_that_do_not_answer_are_bounded_and_hold_up_nothing():
    asked, poses = [], []
    texts = [json.dumps({"switch": f"/boat/{n}", "on": True}) for n in range(1000)]
    texts += [json.dumps({"pose": [1, 2]}), "."]

    async def switch(name, _on):
        asked.append(name)
        await asyncio.Event().wait()

    async def receive_text():
        await asyncio.sleep(0)
        if not texts:
            raise WebSocketDisconnect
        return texts.pop(0)

    socket_ = SimpleNamespace(receive_text=receive_text, send_bytes=AsyncMock())
    robot = SimpleNamespace(switch=switch, set_pose=lambda *pose: poses.append(pose))
    room = asyncio.Semaphore(0)
    with pytest.raises(WebSocketDisconnect):
        await Dashboard(Feed(), robot)._read(socket_, room)
    assert (len(asked), poses, room.locked()) == (8, [(1.0, 2.0)], False)
    assert socket_.send_bytes.await_count == 992
    assert b"not answered" in socket_.send_bytes.await_args.args[0]


async def test_a_topic_with_too_large_messages_does_not_end_the_page():
    asked = []

    async def subscribe(topic, _kind, **_flow):
        asked.append(topic)
        raise TopicLeftOutError(f"{topic} is left out")
        yield

    robot = watched()
    robot._follow_frames = nothing
    await robot._follow(SimpleNamespace(subscribe=subscribe))
    assert set(asked) == {"/truth", "/boat/beacons", "/bm/samples"}


async def fed(monkeypatch, outcomes, deployment=None):
    """The feed after these frames and errors."""
    next_frame = AsyncMock(side_effect=[*outcomes, DisconnectedError("it is closed")])
    frames = SimpleNamespace(announced_only=0, lost=0, next_frame=next_frame)
    monkeypatch.setattr(
        "services.dashboard.robot.posteriors", lambda *_, **__: contextlib.nullcontext(frames)
    )
    feed = Feed()
    with pytest.raises(DisconnectedError):
        await watched(feed, deployment)._follow_frames(None)
    return feed


async def test_each_reason_of_unreadable_messages_is_reported_once(monkeypatch, capsys):
    errors = [BadResultError(f"it has {number // 2 % 30} values") for number in range(300)]
    feed = await fed(monkeypatch, errors)
    said = capsys.readouterr().err.splitlines()
    assert (len(said), len(set(said))) == (20, 20)
    assert feed.lost == {"unreadable message": 300}


async def test_frames_of_another_deployment_are_not_shown(monkeypatch, boat):
    ours, *others = (
        posterior(1, deployment="boat"),
        posterior(2, deployment="garden"),
        report(3, deployment="garden"),
    )
    feed = await fed(monkeypatch, [*others, ours], boat)
    assert [each.report.number for each in feed.frames] == [1]
    assert feed.lost == {"of another deployment": 2}


def test_every_file_of_the_page_is_in_the_package():
    patterns = tomllib.loads(PROJECT.read_text())["tool"]["setuptools"]["package-data"]["services.dashboard"]
    files = [each.name for each in FOLDER.iterdir() if each.is_file() and each.suffix != ".py"]
    assert {each for each in files if not any(fnmatch.fnmatch(each, one) for one in patterns)} == set()
    assert "live.js" in files


def fetch(port, path, **headers):
    """The status of an answer, and its text."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PROCESS_PATIENCE)
    with contextlib.closing(connection):
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


async def refused(url, **more):
    with pytest.raises(websockets.exceptions.InvalidStatus) as caught:
        async with websockets.connect(url, **more):
            pass
    return caught.value.response.status_code


def wait_as_a_page_without_websocket(port):
    engine = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    sid = json.loads(fetch(port, engine)[1].lstrip("0"))["sid"]
    with contextlib.suppress(http.client.HTTPException, OSError):
        fetch(port, f"{engine}&sid={sid}")


class Browser:
    """A plain WebSocket in a browser's place."""

    def __init__(self, socket):
        self._socket = socket

    async def next(self, kind, wanted):
        """The next message of a kind that is as wanted."""
        async with asyncio.timeout(PROCESS_PATIENCE):
            while True:
                message = await self._socket.recv()
                await self._socket.send(".")
                (length,) = struct.unpack_from("<I", message)
                head = json.loads(message[4 : 4 + length])
                if head["kind"] == kind and wanted(head):
                    return head

    async def say(self, text):
        await self._socket.send(text)

    async def ask(self, **wish):
        await self.say(json.dumps(wish))


async def publish(ros, numbers):
    results = await ros.advertise("/BMresults", "std_msgs/Float64MultiArray")
    reports = await ros.advertise("/bm/frame", "diagnostic_msgs/DiagnosticArray")
    stamp = {"secs": 5, "nsecs": 0}
    for number in numbers:
        await reports.publish(frame_message(stamp, number, published=True))
        await results.publish(posterior_message(certain(33), 32, 32))
    await ros.topics()  # the server has read them


async def check_doors(port):
    """Pages and both sockets are for this server's pages alone, and the page names no other server."""
    status, text = await asyncio.to_thread(fetch, port, "/")
    assert status == 200
    assert "://" not in text.replace("http://www.w3.org/", "")
    engine = "/_nicegui_ws/socket.io/?EIO=4&transport="
    for path in ("/", f"{engine}polling", "/frames.csv"):
        assert (await asyncio.to_thread(fetch, port, path, Origin="http://evil.example"))[0] == 403
        assert (await asyncio.to_thread(fetch, port, path, Host="evil.example"))[0] == 403
    for path in ("/live", f"{engine}websocket"):
        url = f"ws://127.0.0.1:{port}{path}"
        assert await refused(url, origin="http://evil.example") == 403
        assert await refused(url, additional_headers={"Host": "evil.example"}) == 403
    assert (await asyncio.to_thread(fetch, port, "/frames.csv"))[0] == 404, "there is nothing to save yet"


async def use_the_robot(ros, browser, port):
    """Results, a pose, a switch and a file."""
    asked = []

    async def switched(request):
        asked.append(request["data"])
        return {"success": True, "message": ""}

    poses = ros.subscribe("/boat/set_pose", "geometry_msgs/PoseStamped")
    await ros.advertise_service("/boat/noise", "std_srvs/SetBool", switched)
    await publish(ros, range(1, 4))
    head = await browser.next("frame", lambda head: head["number"] == 3)
    assert head["plot"]["axes"][0]["label"] == "y"
    assert head["plot"]["mean"] == [1, 1]

    await browser.next("stats", lambda head: head["can_set_pose"] and head["switches"])
    await browser.ask(pose=[1.5, -2])
    pose = (await poses.next(PROCESS_PATIENCE)).msg["pose"]
    assert pose["position"] == {"x": 1.5, "y": -2.0, "z": 0.0}
    await browser.ask(switch="/boat/noise", on=False)
    await browser.next("stats", lambda head: head["switches"] == {"/boat/noise": False})
    assert asked == [False]
    await browser.ask(switch="/rosapi/topics", on=True)
    await browser.next("notice", lambda head: head["text"])
    await browser.say("[" * 1000)
    await browser.say('{"more":' + "[" * 2000)

    status, text = await asyncio.to_thread(fetch, port, "/frames.csv")
    assert (status, text.count("\n")) == (200, 4)


@pytest.mark.process
async def test_a_page_from_the_first_result_to_the_last(stage):
    hub, uri = await stage.hub()
    port = stage.place()
    environment = {"BM_RUN_DIRECTORY": str(stage.runs)}
    dashboard = stage.start("dashboard", "--port", str(port), "--uri", uri, environment=environment)
    await dashboard.says(rf"open http://127\.0\.0\.1:{port}")
    assert os.sched_getscheduler(dashboard.process.pid) == os.SCHED_BATCH  # it must not preempt the hub
    await check_doors(port)
    async with websockets.connect(
        f"ws://127.0.0.1:{port}/live", origin=f"http://127.0.0.1:{port}"
    ) as socket_:
        browser = Browser(socket_)
        await browser.next("stats", lambda head: head["connected"])
        async with connect(uri, check_types=False) as ros:
            await use_the_robot(ros, browser, port)

        # a server that goes and returns
        hub.send(signal.SIGTERM)
        await hub.end()
        await browser.next("stats", lambda head: not head["connected"])
        await stage.hub(int(uri.rpartition(":")[2]))
        await browser.next("stats", lambda head: head["connected"])
        async with connect(uri, check_types=False) as ros:
            await publish(ros, [9])
            await browser.next("frame", lambda head: head["number"] == 9)

        # a page without a WebSocket waits for its next events
        polling = asyncio.create_task(asyncio.to_thread(wait_as_a_page_without_websocket, port))
        for _ in range(2):  # it waits by then
            await browser.next("stats", lambda head: head["connected"])
        dashboard.send(signal.SIGTERM)
        assert await dashboard.end() == 143
        await polling
    assert "Traceback" not in dashboard.err


def test_a_master_starts_it_for_its_own_results(boat, tmp_path):
    settings = Settings(uri="ws://robot:9090", ca=tmp_path / "ca.pem")
    command = dashboard_command(settings, boat, tmp_path, 8081)
    flags = dict(zip(command[1::2], command[2::2], strict=True))
    assert flags["--deployment"] == str(boat.directory)
    assert (flags["--uri"], flags["--run-directory"]) == ("ws://robot:9090", str(tmp_path))
    assert flags["--page-port"] == "8081"
    assert flags["--ca"] == str(tmp_path / "ca.pem")
    ended = invoke(master, ["--once", "--dashboard", "-d", boat.directory])
    assert ended.exit_code == 2
    assert "--loop" in ended.stderr
