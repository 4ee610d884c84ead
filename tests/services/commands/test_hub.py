"""The commands hub and discover: what they refuse, what they print, and a robot's name in place of an address."""

import asyncio
import io
import json
import signal

import pytest
from websockets.asyncio.client import connect

from bridge.discovery import Robot, UnknownRobotError
from services.commands import dashboard, discover, hub, listen, master, publisher, subscriber
from services.errors import SettingsError
from services.settings import load_settings
from terminal.processes import own_command
from tests.command_runner import invoke
from tests.patience import PATIENCE

EVERYWHERE = "0.0.0.0"  # noqa: S104 - the hub must refuse it, or demand tokens
TOKEN = "correct-horse-battery-staple"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--host", EVERYWHERE), "--tls-cert and --tls-key and --token-file, or --insecure"),
        (("--host", "robot.example"), "--insecure"),
        (("--tls-cert", "cert.pem"), "--tls-key"),
        (("--tls-cert", "missing.pem", "--tls-key", "missing.pem"), "missing.pem"),
        (("--token-file", "missing.txt"), "missing.txt"),
        (("--origin", "robot.example"), "--origin robot.example"),
        (("--origin", "https://robot.example/page"), "expected for example"),
        (("--host", "192.0.2.77", "--insecure"), "192.0.2.77"),
        (("--announce", "a.b", "--port", "0"), "a.b"),
    ],
)
def test_what_the_hub_refuses_is_one_sentence(arguments, said):
    ended = invoke(hub.app, arguments)
    assert ended.exit_code == 2
    assert said in ended.stderr.splitlines()[-1]
    assert ended.stdout == ""


@pytest.mark.process
async def test_a_hub_with_tokens_on_another_address(tmp_path):
    """All of it as a user would: a file of tokens, ROS 2, and an address that is not loopback's."""
    tokens = tmp_path / "tokens"
    tokens.write_text(TOKEN + "\n")
    tokens.chmod(0o600)
    options = ("--insecure", "--port", "0", "--ros-version", "2", "--token-file", str(tokens))
    process = await asyncio.create_subprocess_exec(
        *own_command("hub"), "--host", EVERYWHERE, *options, stderr=asyncio.subprocess.PIPE
    )
    try:
        assert process.stderr is not None
        line = (await asyncio.wait_for(process.stderr.readline(), PATIENCE)).decode()
        uri = line.split()[-1].replace(EVERYWHERE, "127.0.0.1")
        async with connect(uri, additional_headers={"Authorization": f"Bearer {TOKEN}"}) as socket:
            await socket.send(json.dumps({"op": "call_service", "service": "/rosapi/get_ros_version"}))
            answer = json.loads(await asyncio.wait_for(socket.recv(), PATIENCE))
            assert answer["values"]["version"] == 2
        process.terminate()
        said = line + (await asyncio.wait_for(process.stderr.read(), PATIENCE)).decode()
        assert TOKEN not in said
        assert await process.wait() == 143
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


@pytest.fixture
def discovered(monkeypatch):
    """The robots on the network."""
    robots = []

    async def found(_timeout):
        return robots

    monkeypatch.setattr("bridge.discovery.discover", found)
    return robots


def test_discover_lists_robots(discovered):
    discovered.append(Robot("Mr. [bold]", "ws://192.0.2.7:9090", 1))
    discovered.append(Robot("Zoë", "wss://zoe.local:9090", None, token=True))
    listed = invoke(discover.app, [])
    assert listed.exit_code == 0
    assert "for 2 s" in listed.stderr
    for shown in ("[bold]", "ws://192.0.2.7:9090", "Zoë", "wanted", "?"):
        assert shown in listed.stdout
    lines = [json.loads(line) for line in invoke(discover.app, ["--json"]).stdout.splitlines()]
    assert lines[1] == {"name": "Zoë", "uri": "wss://zoe.local:9090", "ros_version": None, "token": True}


def test_one_of_the_robots_is_picked_by_its_number(discovered, monkeypatch):
    discovered.extend([Robot("Adam", "ws://192.0.2.7:9090"), Robot("Zoë", "ws://192.0.2.8:9090")])
    monkeypatch.setattr("sys.stdin", io.StringIO("2\n"))
    picked = invoke(discover.app, ["--pick"])
    assert (picked.exit_code, picked.stdout) == (0, "robot:Zoë\n")
    assert "192.0.2.8" in picked.stderr
    for answer in ("3", "0", "two", "", "٢"):
        monkeypatch.setattr("sys.stdin", io.StringIO(answer))
        refused = invoke(discover.app, ["--pick"])
        assert (refused.exit_code, refused.stdout) == (2, "")
        assert f"{answer!r} is not a number from 1 to 2" in refused.stderr
    both = invoke(discover.app, ["--pick", "--json"])
    assert (both.exit_code, both.stdout) == (2, "")
    assert "--pick and --json" in both.stderr


def test_ctrl_c_ends_the_question_for_a_number(discovered, monkeypatch):
    class Interrupted(io.StringIO):
        def readline(self, _size=-1, /):
            signal.raise_signal(signal.SIGINT)
            return "1\n"

    discovered.append(Robot("Adam", "ws://192.0.2.7:9090"))
    monkeypatch.setattr("sys.stdin", Interrupted())
    ended = invoke(discover.app, ["--pick"])
    assert (ended.exit_code, ended.stdout) == (130, "")


@pytest.mark.usefixtures("discovered")
def test_a_network_without_robots_is_one_sentence():
    ended = invoke(discover.app, ["--timeout", "0.2", "--json"])
    assert (ended.exit_code, ended.stdout) == (3, "")
    assert "within 0.2 s" in ended.stderr


@pytest.fixture
def _zoe(monkeypatch):
    """Only this robot is announced."""

    async def resolve(name, timeout):
        await asyncio.sleep(0)
        if name != "Zoë":
            raise UnknownRobotError(f"no robot called {name} within {timeout:g} s")
        return "ws://192.0.2.7:9090"

    monkeypatch.setattr("bridge.discovery.resolve", resolve)


@pytest.mark.usefixtures("_zoe")
@pytest.mark.parametrize("command", [dashboard, listen, master, publisher, subscriber])
def test_every_command_with_a_uri_looks_a_robot_up_in_its_time(command, monkeypatch):
    monkeypatch.setenv("BM_CONNECT_TIMEOUT", "7")
    ended = invoke(command.app, ["--uri", "robot:Adam"])
    assert (ended.exit_code, ended.stderr) == (3, "error: no robot called Adam within 7 s\n")


@pytest.mark.usefixtures("_zoe")
def test_a_robots_name_stands_for_its_uri(monkeypatch):
    assert load_settings(uri="robot:Zoë").uri == "ws://192.0.2.7:9090"
    with pytest.raises(UnknownRobotError):
        load_settings(uri="robot:Adam")
    monkeypatch.setenv("BM_URI", "robot:Zoë")
    assert load_settings(uri=None).uri == "ws://192.0.2.7:9090"
    assert load_settings().uri == "robot:Zoë", "who takes no --uri asks for nobody"
    assert load_settings(uri="ws://127.0.0.1:9090").uri == "ws://127.0.0.1:9090"
    with pytest.raises(SettingsError):
        load_settings(uri="robots:Zoë")
