"""Bad input, as a user meets it: one sentence, the right exit code, no traceback, nothing left running."""

import shutil

import pytest

from machines import warm_up
from services.commands import master
from tests.command_runner import invoke
from tests.integration.conftest import READING, build_boat, only_error
from tests.pcie_shim.boards import ServedBoard


async def once(stage, deployment, uri, *options):
    running = stage.start("master", "--once", "--fused", "-d", str(deployment), "--uri", uri, *options)
    code = await running.end()
    sentence = only_error(running)
    await stage.nothing_left("hub", "board")
    return code, sentence


@pytest.mark.process
async def test_a_uri_at_which_nobody_answers(stage, boat):
    uri = "ws://127.0.0.1:1"
    code, sentence = await once(stage, boat, uri, "--connect-timeout", "0.1")
    assert (code, uri in sentence) == (3, True)


@pytest.mark.process
async def test_a_topic_that_nobody_publishes_is_named(stage, boat):
    _, uri = await stage.hub()
    code, sentence = await once(stage, boat, uri, "--first-data-timeout", "1")
    assert (code, "/boat/sensors" in sentence) == (3, True)


INCOMPLETE = {name: value for name, value in READING.items() if name not in {"D2", "B1"}}


@pytest.mark.parametrize(
    ("reading", "frames"),
    [
        pytest.param(INCOMPLETE, 0, id="no variable", marks=pytest.mark.process),
        pytest.param(
            READING | {"D1": 0, "D2": 100, "B1": 90, "B2": 270, "D3": 0},
            1,
            id="no posterior",
            marks=pytest.mark.thorough,
        ),
    ],
)
async def test_a_reading_without_a_result(stage, boat, robot, reading, frames):
    await robot.keep_publishing(**reading)
    code, sentence = await once(stage, boat, robot.uri)
    assert code == 4, sentence
    assert frames or ["'D2'" in sentence, "'B1'" in sentence] == [True, True]
    assert robot.results == []
    assert len(robot.frames) == frames


@pytest.mark.process
async def test_an_image_of_a_deployment_that_is_damaged(stage, boat, tmp_path):
    folder = tmp_path / "d"
    shutil.copytree(boat, folder)
    path = folder / "boards" / "board2.bm"
    image = path.read_bytes()
    path.write_bytes(image[:-5] + bytes([image[-5] ^ 1]) + image[-4:])
    code, sentence = await once(stage, folder, "ws://127.0.0.1:1")
    assert code == 2  # an unreachable server is 3
    assert path.name in sentence


@pytest.mark.process
async def test_a_board_that_never_says_done(stage, robot, tmp_path):
    """One board, because no other one could be late on a slow machine."""
    folder = build_boat(tmp_path / "one", partitions=1)
    endpoint = f"unix:{stage.where}/b.sock"
    warm_up()
    board = ServedBoard(endpoint, misbehave="never-done")
    await robot.keep_publishing()
    code, sentence = await once(stage, folder, robot.uri, "--boards", endpoint, "--board-timeout", "0.3")
    board.stop()
    assert (code, "board 0" in sentence.lower()) == (5, True)


@pytest.mark.parametrize("options", [(), ("--once", "--loop"), ("--once", "--count", "3")])
def test_wrong_usage(boat, options):
    ended = invoke(master.app, ["-d", boat, *options])
    assert ended.exit_code == 2
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.count("\n") == 1
