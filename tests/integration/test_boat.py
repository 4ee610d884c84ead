"""The whole boat case: an independent client reads the right results on the wire.

boat-simulator -> hub -> boat-normaliser -> hub -> master and its processes -> hub -> roslibpy
"""

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from casestudies.boat.model import model as boat_model
from casestudies.boat.sensors import SENSOR_NAMES, map_grid
from machines.posterior import joint_posterior
from tests.casestudies.cells import line_at
from tests.casestudies.figures import coverage, distances, means
from tests.integration.conftest import (
    PROGRAMMED,
    READING,
    ROOT,
    Robot,
    build_boat,
    stamp_of,
    until,
    until_rosapi,
    until_subscribed,
)
from tests.integration.roslibpy_listener import FOR_TOOLS
from toolchain.deployment import load_deployment
from toolchain.deployment.address import to_address
from toolchain.models.model import exact_posterior

LISTENER = str(Path(__file__).with_name("roslibpy_listener.py"))
HAND = str(Path(__file__).with_name("roslibpy_hand.py"))
FRAMES, SEED = 400, 20261121


@pytest.fixture(scope="module")
def whole_boat(tmp_path_factory):
    """The boat on 32 x 32 cells, as the thesis ran it."""
    return build_boat(tmp_path_factory.mktemp("boat") / "deployment", cells=32)


def heard(file):
    messages = {}
    for line in file.read_text().splitlines():
        entry = json.loads(line)
        messages.setdefault(entry["topic"], []).append(entry["msg"])
    return messages


@pytest.mark.thorough
async def test_frames_are_as_good_as_float64_fusion(stage, whole_boat, tmp_path):
    _, uri = await stage.hub()
    listener = stage.start(sys.executable, LISTENER, uri, str(tmp_path / "heard"), str(FRAMES))
    master = stage.start(
        *("master", "--loop", "--count", str(FRAMES), "--queue", "all", "-d", str(whole_boat), "--uri", uri)
    )
    await listener.says("listening")
    await master.says(PROGRAMMED)
    stage.start("boat-normaliser", "--uri", uri)
    stage.start("boat-simulator", "--uri", uri, "--rate", "40", "--seed", str(SEED))
    assert await master.end() == 0, master.err
    assert await listener.end() == 0, listener.err
    messages = heard(tmp_path / "heard")
    truths = {stamp_of(each): each["pose"]["position"] for each in messages["/boat/true_pose"]}
    readings = {stamp_of(each): each for each in messages["/boat/sensors"]}
    variables = load_deployment(whole_boat, images=False).variables
    assert [variable.name for variable in variables] == list(SENSOR_NAMES)
    model = boat_model().model()
    grid = map_grid()
    dimensions = messages["/BMresults"][0]["layout"]["dim"]
    assert [tuple(each.values()) for each in dimensions] == [("y", 32, 1024), ("x", 32, 32)]
    published = [each for each in messages["/bm/frame"] if each["status"][0]["level"] == 0]
    lines, posteriors, exact = [], [], []
    for frame, result in zip(published, messages["/BMresults"], strict=True):
        at = stamp_of(frame)
        if at not in truths or at not in readings:
            continue  # the listener was late for the very first ones
        addresses = [to_address(variable, readings[at][variable.name]) for variable in variables]
        lines.append(line_at(grid, truths[at]["x"], truths[at]["y"]))
        posteriors.append(result["data"])
        exact.append(exact_posterior(model, addresses))
    assert len(lines) >= FRAMES - 5
    ours, theirs = np.array(posteriors), np.array(exact)
    assert abs(coverage(lines, ours) - coverage(lines, theirs)) <= 0.03
    assert (distances(means(ours, grid.width), means(theirs, grid.width)) <= 1).mean() >= 0.99
    assert np.abs(ours - theirs).sum(axis=1).mean() / 2 <= 0.06


def values_of(report):
    return {pair["key"]: pair["value"] for pair in report["status"][0]["values"]}


def assert_same_posterior(frame, result, grid, pose, decision, ros_version):
    """The topics for robot tools have the posterior of a result, and the stamp of its report."""
    posterior = np.array(result["data"])
    for each in grid, pose, decision:
        assert each["header"]["stamp"] == frame["header"]["stamp"]
    assert ("secs" in grid["header"]["stamp"]) == (ros_version == "1")
    assert grid["data"] == np.rint(98 * posterior / posterior.max()).tolist()
    assert (grid["info"]["width"], grid["info"]["height"], grid["info"]["resolution"]) == (8, 8, 12.5)
    assert grid["info"]["origin"]["position"] == {"x": -50, "y": -50, "z": 0}
    centres = np.arange(-43.75, 50, 12.5)
    for axis, along in (("x", 0), ("y", 1)):
        shares = posterior.reshape(8, 8).sum(axis=along)
        mean = shares @ centres
        assert pose["pose"]["pose"]["position"][axis] == pytest.approx(mean)
        assert pose["pose"]["covariance"][7 * along] == pytest.approx(shares @ (centres - mean) ** 2)
    y, x = np.unravel_index(posterior.argmax(), (8, 8))
    decided = values_of(decision)
    assert (decided["value.y"], decided["value.x"]) == (f"{centres[y]:g}", f"{centres[x]:g}")
    assert decided["valid"] == "true"
    assert float(decided["probability"]) == pytest.approx(posterior.max(), 1e-5)
    assert decided["number"] == values_of(frame)["number"]


@pytest.mark.process
@pytest.mark.parametrize("ros_version", ["1", "2"])
async def test_roslibpy_as_the_robot(stage, boat, tmp_path, ros_version):
    _, uri = await stage.hub(ros_version=ros_version)
    reading = json.dumps(READING)
    robot = stage.start(sys.executable, LISTENER, uri, str(tmp_path / "heard"), "1", reading)
    master = stage.start("master", "--once", "--fused", "-d", str(boat), "--uri", uri)
    assert await master.end() == 0, master.err
    assert await robot.end() == 0, robot.err
    messages = heard(tmp_path / "heard")
    (result,) = messages["/BMresults"]
    assert abs(sum(result["data"]) - 1) < 1e-9
    (frame,) = messages["/bm/frame"]
    report = values_of(frame)
    assert report["missing"] == ""
    assert {name: report[f"reading.{name}"].rsplit(";", 1)[0] for name in READING} == {
        name: f"{value};{value}" for name, value in READING.items()
    }
    grid, pose, decision = (messages[topic][0] for topic in ("/bm/posterior", "/bm/pose", "/bm/decision"))
    assert_same_posterior(frame, result, grid, pose, decision, ros_version)
    (counts,) = messages["/bm/counts"]
    assert (len(counts["data"]), counts["layout"]["dim"][0]["size"]) == (64, 4)
    names = {each["name"] for each in messages["/diagnostics"][-1]["status"]}
    assert {"rosbayes: board 3", "rosbayes: publisher", "rosbayes: pcie-app"} <= names


@pytest.mark.process
@pytest.mark.parametrize("ros_version", ["1", "2"])
async def test_robot_tools_hear_what_separate_services_computed(stage, boat, ros_version):
    """robot -> hub -> subscriber -> master -> pcie-app -> 4 boards; master -> publisher -> hub -> robot"""
    _, uri = await stage.hub(ros_version=ros_version)
    services = {"master", "subscriber", "pcie-app", "publisher"}
    async with Robot(uri, FOR_TOOLS) as robot:
        await robot.keep_publishing()
        run = {"BM_RUN_DIRECTORY": str(stage.runs)}
        stage.start("master", "--loop", "-d", str(boat), "--uri", uri, environment=run)

        def by_stamp(topic):
            return {stamp_of(each): each for each in robot.heard[topic]}

        def same_frame():
            """A result with its report, grid, pose, decision and counts."""
            parts = [by_stamp(topic) for topic in ("/bm/posterior", "/bm/pose", "/bm/decision")]
            for frame, result in robot.paired:
                cycles = [int(values_of({"status": [each]})["cycles"]) for each in frame["status"][1:]]
                for counts in robot.heard["/bm/counts"]:  # they have no stamp
                    rows = np.array(counts["data"], np.uint32).reshape(4, 16)
                    is_of_result = np.allclose(joint_posterior([*rows], cycles), result["data"], rtol=1e-12)
                    if is_of_result and all(stamp_of(frame) in each for each in parts):
                        return frame, result, *(each[stamp_of(frame)] for each in parts)
            return None

        def healthy():
            """The statuses by name, once all are well."""
            levels = [
                {each["name"].removeprefix("rosbayes: "): each for each in health["status"]}
                for health in robot.heard["/diagnostics"]
                if not any(each["level"] for each in health["status"])
            ]
            return next((each for each in levels if services <= set(each)), None)

        def so_far():
            return f"{len(robot.paired)} results; the last on each topic: {[all_[-1:] for all_ in robot.heard.values()]}"

        assert_same_posterior(*await until(same_frame, so_far), ros_version)
        statuses = await until(healthy, lambda: f"{robot.heard['/diagnostics'][-1:]}")
        assert set(statuses) == services | {f"board {at}" for at in range(4)}
        pids = {name: values_of({"status": [statuses[name]]})["pid"] for name in services}
        processes = stage.processes()
        assert pids == {name: str(processes[name][0].pid) for name in services}


def reading_of(values, name):
    """Value and address of a reading in a report."""
    value, address, _age = values[f"reading.{name}"].split(";")
    return float(value), int(address)


@pytest.mark.process
async def test_the_posterior_follows_what_is_done_to_the_world(stage, tmp_path):
    """A sensor is unplugged, the boat is dragged, and a beacon fails, by another client of the same hub."""
    _, uri = await stage.hub()
    deployment = build_boat(tmp_path / "deployment", cells=16)
    model, grid = boat_model(16, 16).model(), map_grid(16, 16)
    environment = {"PYTHONPATH": str(ROOT)}

    async def do(name, message):
        hand = stage.start(sys.executable, HAND, uri, name, json.dumps(message), environment=environment)
        assert await hand.end() == 0, hand.err
        return json.loads(hand.out) if hand.out else None

    async with Robot(uri) as robot:
        stage.start("master", "--loop", "-d", str(deployment), "--uri", uri)
        stage.start("boat-normaliser", "--uri", uri)
        await stage.start("boat-simulator", "--uri", uri, "--rate", "10", "--seed", "5").says("seed")
        await robot.have(2)
        await until_subscribed(uri, "/boat/set_pose")
        await until_rosapi(uri, "services", lambda answer: "/boat/B3/plugged" in answer["services"])

        # the example of the boat's page, which drags the boat and unplugs D1
        page = (ROOT / "docs/case-studies/boat.md").read_text()
        example = page.split("```python\n")[1].split("```")[0].replace("9090", uri.rpartition(":")[2])
        hand = stage.start(sys.executable, "-c", example)
        assert await hand.end() == 0, hand.err
        assert hand.out == "D1 is unplugged\n"

        def without_d1():
            paired = [(values_of(report), result["data"]) for report, result in robot.paired]
            return [each for each in paired if each[0]["missing"] == "D1"]

        await until(lambda: len(without_d1()) >= 10, lambda: f"{robot.frames[-1:]}")
        apart = []
        for values, posterior in without_d1():
            assert "reading.D1" not in values
            addresses = [None, *(reading_of(values, name)[1] for name in SENSOR_NAMES[1:])]
            apart.append(np.abs(np.array(posterior) - exact_posterior(model, addresses)).sum() / 2)
        assert np.mean(apart) <= 0.1

        await do("/boat/noise", {"data": False})
        await do("/boat/set_pose", {"pose": {"position": {"x": 20.0, "y": -30.0}}})
        exact = {"D2": 76, "D3": 28, "B1": 16, "B2": 337, "B3": 45}

        def is_there():
            report, result = robot.paired[-1]
            values = values_of(report)
            return (
                all(reading_of(values, name)[0] == value for name, value in exact.items())
                and np.hypot(*np.subtract(grid.mean(result["data"]), (20, -30))) < 10
            )

        await until(is_there, lambda: f"{robot.frames[-1:]}")

        await do("/boat/beacon3/works", {"data": False})
        done = len(robot.frames)

        def readings():
            return {
                name: {reading_of(values_of(report), name)[0] for report in robot.frames[done:]}
                for name in SENSOR_NAMES[1:]
            }

        await until(lambda: len(readings()["D3"]) >= 3)
        assert {name for name, values in readings().items() if len(values) > 1} == {"D3", "B3"}


@pytest.mark.process
async def test_one_command_draws_the_figures_of_the_thesis(stage, tmp_path):
    page = (ROOT / "docs/case-studies/boat.md").read_text()
    (command,) = re.findall(r"^    (rosbayes demo .*)$", page, re.MULTILINE)
    demo = stage.start(*shlex.split(command), "--count", "6", "--out", str(tmp_path))
    assert await demo.end() == 0, demo.err + demo.out
    figures = [str(tmp_path / f"figure-4.{number}.png") for number in ("4", "5", "5-projected")]
    assert re.findall(r"^wrote (.*)$", demo.out, re.MULTILINE) == figures
    for figure in figures:
        assert imread(figure).shape[1] > 800
    await stage.nothing_left()


@pytest.mark.process
async def test_the_program_of_the_page_drives_the_boat_to_its_goal(stage, whole_boat):
    _, uri = await stage.hub()
    page = (ROOT / "docs/how-to/driving.md").read_text()
    (program,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    goal = tuple(
        float(number) for number in re.search(r"^GOAL = \((.*), (.*)\)", program, re.MULTILINE).groups()
    )
    async with Robot(uri, {"/boat/true_pose": "geometry_msgs/PoseStamped"}) as robot:
        stage.start("master", "--loop", "-d", str(whole_boat), "--uri", uri)
        stage.start("boat-normaliser", "--uri", uri)
        await stage.start("boat-simulator", "--uri", uri, "--rate", "10", "--seed", "5").says("seed")
        await robot.have(2)
        driving = stage.start(sys.executable, "-c", program.replace("ws://127.0.0.1:9090", uri))
        assert await driving.end() == 0, driving.err
        there = len(robot.heard["/boat/true_pose"])
        assert re.fullmatch(r"at the goal: [0-4]\.\d m from it.*\n", driving.out)

        def places():
            poses = [each["pose"]["position"] for each in robot.heard["/boat/true_pose"][there:]]
            return [(each["x"], each["y"]) for each in poses]

        # it lies still there, by the truth too, within the error of a posterior
        await until(lambda: len(places()) >= 5 and len(set(places()[-5:])) == 1, lambda: f"{places()}")
        assert np.hypot(*np.subtract(places()[-1], goal)) < 25
