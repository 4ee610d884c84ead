"""A machine that samples, in the processes of a run: a reading goes out, its posterior and samples come back.

robot ──▶ hub ──▶ subscriber, master, pcie-app, two boards, publisher ──▶ hub ──▶ robot
"""

import json

import pytest

from posteriors import posterior
from posteriors.frame_report import read_frame_report
from tests.services.pipeline.test_samples import built


@pytest.mark.process
async def test_once_publishes_the_posterior_of_two_chains(stage, robot, tmp_path):
    target = {"topic": "/boat/sensors", "type": "boat_msgs/Sensors"}
    folder = built(tmp_path, stream=100, **target).directory
    await robot.keep_publishing(grass="wet")
    master = stage.start("master", "--once", "-d", str(folder), "--uri", robot.uri, "--json")
    assert await master.end() == 0, master.err
    assert json.loads(master.out)["seen"] is True
    await robot.have(1)
    report = read_frame_report(robot.frames[0], 0)
    assert {board.stopped for board in report.boards} == {"samples"}
    assert report.details["samples"] == "1000"
    right = posterior(folder, {"Grass": "wet"}, bank=report.number % 16)
    assert tuple(robot.results[0]["data"]) == right.probabilities
    await stage.nothing_left("hub")
