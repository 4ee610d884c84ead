"""Every line of a run on standard error is one JSON object, those of its children too."""

import json
import os
import signal

import pytest

from tests.integration.conftest import until


@pytest.mark.process
async def test_every_line_of_a_run_is_an_object(stage, robot, boat):
    await robot.keep_publishing()
    command = ("master", "--loop", "-d", str(boat), "--uri", robot.uri)
    master = stage.start(*command, "--log-format", "json", "--log-level", "debug")
    await robot.have(3)
    (publisher,) = stage.processes()["publisher"]
    os.kill(publisher.pid, signal.SIGKILL)
    await until(lambda: "restarting it" in master.err)
    await robot.have(len(robot.results) + 3)  # a service that is killed comes back
    master.send(signal.SIGTERM)
    assert await master.end() == 143
    found = [json.loads(line) for line in master.err.splitlines()]
    assert all({"time", "level", "process", "message"} <= each.keys() for each in found)
    processes = {each["process"] for each in found}
    assert {"master", "subscriber", "pcie-app", "publisher"} <= processes
    of_frame = [each for each in found if each.get("frame") == 2 or "frame=2 " in each["message"]]
    assert {each["process"] for each in of_frame} == {"master", "subscriber", "pcie-app", "publisher"}
    assert "warning" in {each["level"] for each in found}
