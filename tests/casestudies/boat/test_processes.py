"""The boat's three commands as processes, with a pretend master between them.

boat-simulator -> /boat/raw -> boat-normaliser -> /boat/sensors -> pretend master -> /BMresults -> boat-viewer
      '---------------------------- /boat/true_pose -------------------------------------------------'
"""

import asyncio
import contextlib
import json
import re
import signal
import subprocess
import sys

import pytest
from matplotlib.image import imread

from casestudies.boat.sensors import map_grid
from tests.casestudies.cells import line_at
from tests.casestudies.pretend_stack import PretendStack, certain, frame_message
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PROCESS_PATIENCE
from tests.posteriors.messages import posterior_message

GRID = map_grid()


class Process:
    """One of the boat's commands."""

    def __init__(self, module, *arguments):
        self.command = (sys.executable, "-m", f"casestudies.boat.{module}", *arguments)

    async def __aenter__(self):
        self._process = await asyncio.create_subprocess_exec(
            *self.command, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        return self

    async def __aexit__(self, *_exception):
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        await self._process.communicate()

    def signal(self, number):
        self._process.send_signal(number)

    async def line(self, beginning):
        """Wait until it prints a line that begins so."""
        async with asyncio.timeout(PROCESS_PATIENCE):
            while not (line := (await self._process.stdout.readline()).decode()).startswith(beginning):
                assert line, "it ended first"

    async def ended(self):
        """(exit code, stdout, stderr)"""
        async with asyncio.timeout(PROCESS_PATIENCE):
            out, err = await self._process.communicate()
        return self._process.returncode, out.decode(), err.decode()


def where_the_boat_is(fake):
    """Answers with certainty in the cell of the pose that has the reading's stamp."""

    def answer(_number, message):
        for op in fake.ops("publish", topic="/boat/true_pose"):
            if op["msg"]["header"]["stamp"] == message["header"]["stamp"]:
                position = op["msg"]["pose"]["position"]
                return certain(line_at(GRID, position["x"], position["y"]))
        raise AssertionError(f"no true pose has the stamp of {message}")

    return answer


@pytest.mark.process
async def test_from_the_simulator_to_the_pictures(tmp_path):
    async with (
        FakeRosbridge(rosapi=True) as fake,
        PretendStack(fake, "/boat/sensors", where_the_boat_is(fake)),
    ):
        viewing = Process(
            *("viewer", "--uri", fake.uri, "--count", "12", "--out", str(tmp_path / "out")),
            *("--json", str(tmp_path / "numbers.json")),
        )
        async with viewing as viewer, Process("normaliser", "--uri", fake.uri):
            await fake.wait_for_op("subscribe", topic="/boat/true_pose", timeout=PROCESS_PATIENCE)
            await fake.wait_for_op("subscribe", topic="/boat/raw", timeout=PROCESS_PATIENCE)
            async with Process("simulator", "--uri", fake.uri, "--rate", "10", "--seed", "4"):
                code, out, err = await viewer.ended()
        sensors = fake.ops("publish", topic="/boat/sensors")
        raws = fake.ops("publish", topic="/boat/raw")
    assert code == 0, err
    heading, *lines, total, first_picture, second_picture = out.splitlines()
    words = ["frame", "true", "x,", "y", "mean", "x,", "y", "distance", "cycles", "time", "(ms)"]
    assert heading.split() == words
    assert [int(line.split()[0]) for line in lines] == list(range(1, 13))
    assert all("  0.00  " in line for line in lines)
    assert total.startswith("12 results, median distance 0.00 cells, median time ")
    for said, name in ((first_picture, "figure-4.4.png"), (second_picture, "figure-4.5.png")):
        path = tmp_path / "out" / name
        assert said == f"wrote {path}"
        assert imread(path).shape[1] > 800
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert numbers["results"] == len(numbers["frames"]) == 12
    first = numbers["frames"][0]
    assert first["true_position_age_ms"] == 0
    # the posterior is certain of the true cell: within half a cell
    assert first["mean"] == first["true_cell"]
    assert list(first["mean_value"]) == list(first["true_position"]) == ["x", "y"]
    for label, half in (("y", GRID.cell_height / 2), ("x", GRID.cell_width / 2)):
        assert first["mean_value"][label] == pytest.approx(first["true_position"][label], abs=half)
    printed = re.findall(r"-?[\d.]+, -?[\d.]+", lines[0])
    assert printed == ["{x:.1f}, {y:.1f}".format(**first[key]) for key in ("true_position", "mean_value")]
    assert [stage["stage"] for stage in numbers["stages"]][::6] == ["rosbridge in", "rosbridge out"]
    assert sum(stage["share"] for stage in numbers["stages"]) == pytest.approx(1)
    # the server says that it speaks for ROS 2, and the stamp is kept from the raw reading on
    first = sensors[0]["msg"]
    assert set(first) == {"header", "D1", "D2", "D3", "B1", "B2", "B3"}
    assert set(first["header"]["stamp"]) == {"sec", "nanosec"}
    assert first["header"] in [op["msg"]["header"] for op in raws]


@pytest.mark.thorough
async def test_arrays_are_paired_with_the_pose_before_them(tmp_path):
    """Without headers the stack stamps a reading when it arrives, which is a little after the true pose."""
    async with FakeRosbridge() as fake, PretendStack(fake, "/boat/sensors", lambda _n, _m: certain(0)):
        viewing = Process(
            "viewer", "--uri", fake.uri, "--count", "3", "--json", str(tmp_path / "numbers.json")
        )
        async with viewing as viewer, Process("normaliser", "--uri", fake.uri, "--array"):
            await fake.wait_for_op("subscribe", topic="/boat/true_pose", timeout=PROCESS_PATIENCE)
            await fake.wait_for_op("subscribe", topic="/boat/raw", timeout=PROCESS_PATIENCE)
            async with Process("simulator", "--uri", fake.uri, "--rate", "20", "--array") as simulator:
                assert (await viewer.ended())[0] == 0
                simulator.signal(signal.SIGTERM)
                assert (await simulator.ended())[0] == 143
        types = {op["topic"]: op["type"] for op in fake.ops("advertise")}
    assert types["/boat/raw"] == types["/boat/sensors"] == "std_msgs/Float64MultiArray"
    for frame in json.loads((tmp_path / "numbers.json").read_text())["frames"]:
        assert frame["true_position"] is not None
        assert 0 < frame["true_position_age_ms"] < 10_000


@pytest.mark.process
async def test_ctrl_c_ends_an_endless_viewer_with_its_pictures(tmp_path):
    async with (
        FakeRosbridge() as fake,
        Process("viewer", "--uri", fake.uri, "--out", str(tmp_path)) as viewer,
    ):
        await fake.wait_for_op("subscribe", topic="/boat/true_pose", timeout=PROCESS_PATIENCE)
        for number in (1, 2):
            report = frame_message({"sec": number, "nanosec": 0}, number, published=True)
            await fake.publish("/bm/frame", report)
            await fake.publish("/BMresults", posterior_message(certain(500), 32, 32))
        await viewer.line("    2 ")
        viewer.signal(signal.SIGINT)
        code, out, err = await viewer.ended()
    assert (code, err.splitlines()[-1]) == (130, "interrupted (Ctrl-C)")
    assert (tmp_path / "figure-4.4.png").exists()
    assert "2 results" in out


@pytest.mark.thorough
async def test_a_normaliser_says_what_went_wrong_once():
    """Each kind of bad reading, and that the server went and came back."""
    good = {"D1": 1.2, "D2": 2, "D3": 3, "B1": 0, "B2": 0, "B3": 0}
    async with FakeRosbridge() as fake, Process("normaliser", "--uri", fake.uri) as normaliser:
        await fake.wait_for_op("subscribe", topic="/boat/raw", timeout=PROCESS_PATIENCE)
        for _ in range(3):
            await fake.publish("/boat/raw", {**good, "B2": "north"})
        await fake.publish("/boat/raw", good)
        await fake.wait_for_op("publish", topic="/boat/sensors", timeout=PROCESS_PATIENCE)
        (sent,) = fake.ops("publish", topic="/boat/sensors")
        await fake.vanish()
        fake.received.clear()
        await fake.come_back()
        await fake.wait_for_op("subscribe", topic="/boat/raw", timeout=PROCESS_PATIENCE)
        normaliser.signal(signal.SIGTERM)
        code, _out, err = await normaliser.ended()
    assert sent["msg"] == {"D1": 1, "D2": 2, "D3": 3, "B1": 0, "B2": 0, "B3": 0}
    assert err.count("B2") == 1
    lost, restored = [line for line in err.splitlines()[1:] if fake.uri in line]
    assert lost.startswith("warning: ")
    assert not restored.startswith("warning: ")
    assert code == 143
