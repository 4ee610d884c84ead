"""The case studies' `--uri`: a robot's name stands for the URI that it announces."""

import pytest

from bridge.discovery import UnknownRobotError
from casestudies.boat.normaliser import app as normaliser
from casestudies.boat.simulator import app as simulator
from casestudies.boat.viewer import app as viewer
from casestudies.mrclam.player import app as player
from tests.command_runner import invoke


@pytest.fixture
def asked(monkeypatch):
    """The names that are looked up; only `Zoë` is announced, at a port where nothing listens."""

    async def resolve(name):
        names.append(name)
        if name != "Zoë":
            raise UnknownRobotError(f"no robot called {name}")
        return "ws://127.0.0.1:1"

    names = []
    monkeypatch.setattr("bridge.discovery.resolve", resolve)
    monkeypatch.setattr("bridge.client.session.FIRST_DELAY", 3600)  # the first attempt is the last
    return names


@pytest.mark.parametrize("command", [simulator, normaliser, viewer])
def test_a_robots_name_stands_for_its_uri(command, asked, monkeypatch):
    found = invoke(command, ["--uri", "robot:Zoë"])
    assert (found.exit_code, asked) == (3, ["Zoë"])
    assert found.stderr.splitlines()[-1].startswith("error: ")
    assert "ws://127.0.0.1:1" in found.stderr
    assert "Traceback" not in found.stderr
    monkeypatch.setenv("BM_URI", "robot:Adam")
    unknown = invoke(command, [])
    assert (unknown.exit_code, asked) == (3, ["Zoë", "Adam"])
    assert unknown.stderr.splitlines() == ["error: no robot called Adam"]


def test_a_player_looks_it_up_too(asked):
    assert invoke(player, ["nowhere.csv", "--uri", "robot:Adam"]).exit_code == 3
    assert asked == ["Adam"]
