"""The boat case as a whole: what comes out on the wire is right, and read there by a client of others.

boat-simulator -> hub -> boat-normaliser -> hub -> master and its processes -> hub -> roslibpy
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from casestudies.boat.correctness import correctness
from casestudies.boat.geometry import map_grid
from casestudies.boat.messages import SENSOR_NAMES
from casestudies.boat.model import model as boat_model
from machines.posterior import joint_posterior
from machines.reference import ReferenceBM1
from pcie_shim.programming_file import read_image
from tests.integration.conftest import READING, build_boat, stamp_of
from toolchain.deployment import load_deployment
from toolchain.deployment.address import to_address
from toolchain.models.fusion import exact_posterior

LISTENER = str(Path(__file__).with_name("roslibpy_listener.py"))
FRAMES, SEED = 1000, 20261121


@pytest.fixture(scope="module")
def whole_boat(tmp_path_factory):
    """The boat on 32 x 32 cells, as the thesis ran it."""
    return build_boat(tmp_path_factory.mktemp("boat") / "deployment", cells=32)


def heard(file: Path) -> dict[str, list[dict]]:
    messages: dict[str, list[dict]] = {}
    for line in file.read_text().splitlines():
        entry = json.loads(line)
        messages.setdefault(entry["topic"], []).append(entry["msg"])
    return messages


def reference_frame(deployment, readings, number):
    """What the boards must count: the reference machine, in slices as the host drives them."""
    loaded = load_deployment(deployment)
    addresses = [to_address(variable, readings[variable.name]) for variable in loaded.variables]
    machine = loaded.machine
    boards = [ReferenceBM1(read_image(loaded.image_path(at)).machine) for at in range(len(loaded.boards))]
    from machines.bm1 import Start, StopReason

    end = 512  # the first that is at least twice the target of 255
    for board in boards:
        board.start(
            Start(
                addresses=tuple(addresses),
                target_count=machine.target_count,
                max_cycles=machine.max_cycles,
                bank=number % machine.rng_banks,
                run_until=end,
            )
        )
    while not any(board.reason is StopReason.OVERFLOW for board in boards):
        end *= 2
        for board in boards:
            if board.reason is StopReason.SLICE:
                board.resume(end)
    return boards


async def test_the_wire_says_what_the_reference_counts(stage, whole_boat, tmp_path):
    _, uri = await stage.hub()
    reading = READING | {"D1": 40, "D2": 44, "B1": 60, "B2": 320, "D3": 38, "B3": 100}
    stage.start(sys.executable, LISTENER, uri, str(tmp_path / "heard"), "1", json.dumps(reading))
    master = stage.start("master", "--once", "-d", str(whole_boat), "--uri", uri)
    listener = stage.running[-2]
    assert await master.end() == 0, master.err
    assert await listener.end() == 0, listener.err
    messages = heard(tmp_path / "heard")
    boards = reference_frame(whole_boat, reading, 1)
    expected = joint_posterior([board.counts for board in boards], [board.cycles for board in boards])
    assert messages["/BMresults"][0]["data"] == expected.tolist()
    labels = [
        (each["label"], each["size"], each["stride"]) for each in messages["/BMresults"][0]["layout"]["dim"]
    ]
    assert labels == [("y", 32, 1024), ("x", 32, 32)]
    statuses = messages["/bm/frame"][0]["status"]
    values = [{pair["key"]: pair["value"] for pair in status["values"]} for status in statuses]
    assert [int(each["cycles"]) for each in values[1:]] == [board.cycles for board in boards]
    assert [int(each["counts_total"]) for each in values[1:]] == [int(board.counts.sum()) for board in boards]


async def test_a_thousand_frames_are_as_good_as_float64_fusion(stage, whole_boat, tmp_path):
    _, uri = await stage.hub()
    listener = stage.start(sys.executable, LISTENER, uri, str(tmp_path / "heard"), str(FRAMES))
    master = stage.start(
        *("master", "--loop", "--count", str(FRAMES), "--queue", "all", "-d", str(whole_boat), "--uri", uri)
    )
    await listener.says("listening")
    await master.says("pcie-app: 4 boards")
    stage.start("boat-normaliser", "--uri", uri)
    stage.start("boat-simulator", "--uri", uri, "--rate", "40", "--seed", str(SEED))
    assert await master.end(200) == 0, master.err
    assert await listener.end() == 0, listener.err
    messages = heard(tmp_path / "heard")
    truths = {stamp_of(each): each["pose"]["position"] for each in messages["/boat/true_pose"]}
    readings = {stamp_of(each): each for each in messages["/boat/sensors"]}
    variables = load_deployment(whole_boat, images=False).variables
    assert [variable.name for variable in variables] == list(SENSOR_NAMES)
    model = boat_model()
    grid = map_grid()
    published = [each for each in messages["/bm/frame"] if each["status"][0]["level"] == 0]
    lines, posteriors, exact = [], [], []
    for frame, result in zip(published, messages["/BMresults"], strict=True):
        at = stamp_of(frame)
        if at not in truths or at not in readings:
            continue  # the listener was late for the very first ones
        addresses = [to_address(variable, readings[at][variable.name]) for variable in variables]
        lines.append(grid.line(truths[at]["x"], truths[at]["y"]))
        posteriors.append(result["data"])
        exact.append(exact_posterior(model, addresses))
    assert len(lines) >= FRAMES - 5
    figures = correctness(lines, np.array(posteriors), np.array(exact), width=grid.width)
    print(figures)
    assert abs(figures.coverage - figures.exact_coverage) <= 0.03, figures
    assert figures.mean_within_one_cell >= 0.99, figures
    assert figures.total_variation_mean <= 0.06, figures
