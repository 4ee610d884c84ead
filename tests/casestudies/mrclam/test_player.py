"""Recordings of a robot among landmarks, and their player with a pretend master."""

import asyncio
import json
import subprocess
import sys

import pytest

from casestudies.mrclam import player
from posteriors.errors import BadResultError, NoResultError
from posteriors.posterior import Posterior
from tests.casestudies.cells import centre
from tests.casestudies.pretend_stack import PretendStack, certain
from tests.command_runner import invoke
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import FACTOR, PROCESS_PATIENCE
from toolchain.errors import ModelError

HEADING = "time_s,ref_x_m,ref_y_m,ref_std_m,heading_rad" + "".join(
    f",range_{landmark}_m,bearing_{landmark}_rad" for landmark in player.LANDMARKS
)
UNSEEN = 2 * (len(player.LANDMARKS) - 1) * ","
FIRST = f"1248272277.018,4.392,2.407,0.041,-2.0698{UNSEEN},6.712,-1.8623"
SECOND = f"1248272278.018,-1.5,-6.25,0.035,-2.0624,6.794,-2.2450{UNSEEN}"


def file(tmp_path, *lines):
    path = tmp_path / "recording.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_frames_are_read_with_what_was_seen(tmp_path):
    first, second = player.read_recording(file(tmp_path, HEADING, FIRST, SECOND))
    seen = {"range_20": 6.712, "bearing_20": -1.8623}
    assert first == player.RecordedFrame(number=1, x=4.392, y=2.407, readings=seen)
    seen = {"range_6": 6.794, "bearing_6": -2.2450}
    assert second == player.RecordedFrame(number=2, x=-1.5, y=-6.25, readings=seen)


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        (["landmark,x_m,y_m", "6,5.7093,4.9640"], "ref_x_m"),
        (["time_s,ref_x_m,ref_y_m,ref_std_m,heading_rad", "1,2,3,4,5"], "range_6_m"),
        ([HEADING.replace(",bearing_20_rad", ""), FIRST], "bearing_20_rad"),
        ([HEADING.replace("_6_", "_3_"), FIRST], "range_6_m"),
        ([HEADING], "recording.csv"),
        ([""], "recording.csv"),
        ([HEADING, FIRST, SECOND.replace("6.794", "far")], "row 2: range_6_m"),
        ([HEADING, FIRST.replace("4.392", "nan")], "row 1: ref_x_m"),
        ([HEADING, FIRST, SECOND[:-3]], "line 3"),
        ([HEADING, FIRST.replace("6.712", "")], "row 1: landmark 20"),
    ],
)
def test_wrong_files_are_refused_with_the_place(tmp_path, lines, place):
    with pytest.raises(ModelError, match=place):
        player.read_recording(file(tmp_path, *lines))


def test_a_path_that_is_not_a_file_is_one_sentence(tmp_path):
    (tmp_path / "binary").write_bytes(b"\x89PNG\xff\xfe")
    for path in (tmp_path, tmp_path / "none.csv", tmp_path / "binary"):
        ended = invoke(player.app, [path])
        assert (ended.exit_code, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
        assert ended.stderr.startswith("error: ")
        assert str(path) in ended.stderr


GRID = player.area_grid()


def recorded(number, line):
    """A frame whose reference position is the centre of a cell."""
    x, y = centre(GRID, line)
    return player.RecordedFrame(number=number, x=x, y=y, readings={"range_6": float(line), "bearing_6": 0.5})


FRAMES = [recorded(n, 40 * n) for n in range(1, 9)]


def right(_number, message):
    return certain(int(message["range_6"]))


async def test_every_frame_gets_its_own_result_and_the_next_one_waits_for_it():
    """The pretend master looks at the server when it answers: no reading is ahead of it."""
    ahead = []

    def answer(number, message):
        ahead.append(len(fake.ops("publish", topic=player.SIGHTINGS_TOPIC)) - number)
        return right(number, message)

    async with FakeRosbridge() as fake, PretendStack(fake, player.SIGHTINGS_TOPIC, answer):
        played = await player.play(fake.uri, FRAMES)
    assert ahead == [0] * 8
    assert [one.frame for one in played] == FRAMES
    assert [one.distance() for one in played] == pytest.approx([0.0] * 8, abs=1e-9)
    assert [one.cycles for one in played] == list(range(801, 809))


async def test_a_lost_and_an_impossible_frame_have_no_result_and_the_rest_goes_on():
    def answer(number, message):
        return {3: "silent", 5: None}.get(number, right(number, message))

    heard = []
    async with FakeRosbridge() as fake, PretendStack(fake, player.SIGHTINGS_TOPIC, answer):
        played = await player.play(fake.uri, FRAMES, timeout_s=FACTOR, on_frame=heard.append)
    assert heard == played
    assert [one.frame.number for one in played if one.posterior is None] == [3, 5]
    assert played[2].outcome == f"no result within {FACTOR:g} s"
    assert played[4].outcome == "no posterior: impossible on every board"
    assert played[2].distance() == player.LOST_DISTANCE
    assert played[7].distance() == pytest.approx(0, abs=1e-9)


async def test_a_late_answer_is_not_taken_for_that_of_the_next_frame():
    async with FakeRosbridge() as fake:
        fake.delay = 0.2

        async def hasten():
            await fake.wait_for_op("publish", topic=player.SIGHTINGS_TOPIC, count=4)
            fake.delay = 0.0

        hastening = asyncio.create_task(hasten())
        async with PretendStack(fake, player.SIGHTINGS_TOPIC, right):
            played = await player.play(fake.uri, FRAMES, timeout_s=0.05)
        await hastening
    assert any(one.posterior is None for one in played)
    assert all(one.distance() < 1e-9 for one in played if one.posterior is not None)


async def test_the_first_frame_is_repeated_until_somebody_listens():
    def answer(number, message):
        return "silent" if number == 1 else right(number, message)

    async with FakeRosbridge() as fake, PretendStack(fake, player.SIGHTINGS_TOPIC, answer):
        played = await player.play(fake.uri, FRAMES[:2])
        assert len(fake.ops("publish", topic=player.SIGHTINGS_TOPIC)) == 3
    assert [one.distance() for one in played] == pytest.approx([0, 0], abs=1e-9)


async def test_nobody_ever_answers():
    async with FakeRosbridge() as fake:
        with pytest.raises(NoResultError):
            await player.play(fake.uri, FRAMES, first_timeout_s=0.3)


async def test_something_else_on_the_result_topic():
    async with FakeRosbridge() as fake:
        playing = asyncio.create_task(player.play(fake.uri, FRAMES))
        await fake.wait_for_op("publish", topic=player.SIGHTINGS_TOPIC)
        await fake.publish("/BMresults", {"data": ["nonsense"]})
        with pytest.raises(BadResultError, match="/BMresults"):
            await playing


def test_the_median_counts_frames_without_a_result():
    result = Posterior(probabilities=tuple(certain(40)), labels=("y", "x"), sizes=(32, 32), heard_ns=0)
    good = player.PlayedFrame(frame=FRAMES[0], posterior=result, cycles=1, outcome="")
    lost = player.PlayedFrame(frame=FRAMES[0], outcome="")
    assert player.median_distance([good, lost, lost]) == player.LOST_DISTANCE
    assert player.median_distance([good, good, lost]) == pytest.approx(0, abs=1e-9)


@pytest.mark.process
async def test_the_command_prints_a_line_a_frame_and_a_sum(tmp_path):
    path = tmp_path / "robot.csv"
    lines = [HEADING]
    lines += [f"{f.number},{f.x!r},{f.y!r},0.04,0.1,{f.readings['range_6']},0.5{UNSEEN}" for f in FRAMES]
    path.write_text("\n".join(lines) + "\n")

    def answer(number, message):
        return None if number == 2 else right(number, message)

    async with FakeRosbridge() as fake, PretendStack(fake, player.SIGHTINGS_TOPIC, answer):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "casestudies.mrclam.player", str(path), "--uri", fake.uri),
            *("--json", str(tmp_path / "n.json")),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        async with asyncio.timeout(PROCESS_PATIENCE):
            out, err = await process.communicate()
    assert process.returncode == 0, err.decode()
    lines = out.decode().splitlines()
    assert len(lines) == 10
    assert lines[2].endswith(")  no posterior: impossible on every board")
    assert lines[-1].startswith("8 frames, 1 without a result, median distance 0.000 m")
    numbers = json.loads((tmp_path / "n.json").read_text())
    assert numbers["without_result"] == 1
    assert numbers["distances_m"][1] == player.LOST_DISTANCE
