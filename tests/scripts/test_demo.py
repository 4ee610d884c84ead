"""The demo's `--uri`: a robot's name stands for the URI that it announces."""

import sys

import pytest

from bridge.discovery import UnknownRobotError
from scripts.running import demo


def test_a_robot_is_looked_up_before_anything_starts(tmp_path, monkeypatch, capsys):
    async def resolve(name):
        raise UnknownRobotError(f"no robot called {name}")

    monkeypatch.setattr("bridge.discovery.resolve", resolve)
    monkeypatch.setattr(demo.Process, "start", pytest.fail)
    monkeypatch.setattr(sys, "argv", ["demo", "--uri", "robot:Adam", "--out", str(tmp_path)])
    assert demo.main() == UnknownRobotError.exit_code
    assert "no robot called Adam" in capsys.readouterr().err
