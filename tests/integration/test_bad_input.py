"""Bad input, as a user meets it: one sentence, the right exit code, no traceback, nothing left running."""

import asyncio
import re
import shutil
import socket

import pytest

from machines import warm_up
from services.commands import master
from tests.command_runner import invoke
from tests.integration.conftest import PROGRAMMED, READING, Robot, build_boat, only_error, until_subscribed
from tests.pcie_shim.boards import ServedBoard


async def once(stage, deployment, uri, *options):
    running = stage.start("master", "--once", "--fused", "-d", str(deployment), "--uri", uri, *options)
    code = await running.end()
    sentence = only_error(running)
    await stage.nothing_left("hub", "board")
    return code, sentence


@pytest.fixture
async def server(stage):
    """A hub, and a robot that publishes whatever it is told to."""
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        yield uri, robot


@pytest.mark.parametrize(
    "server",
    [
        pytest.param("absent", marks=pytest.mark.process),
        pytest.param("silent", marks=pytest.mark.thorough),
        pytest.param("of the web", marks=pytest.mark.process),
    ],
)
async def test_a_uri_at_which_no_rosbridge_answers(stage, boat, server):
    async def answer(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi")
        writer.close()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        uri = f"ws://127.0.0.1:{listener.getsockname()[1]}"
        if server == "absent":
            listener.close()
        web = await asyncio.start_server(answer, sock=listener) if server == "of the web" else None
        code, sentence = await once(stage, boat, uri, *(("--connect-timeout", "1") if web is None else ()))
        if web is not None:
            web.close()
    assert code == 3
    assert (uri if web is None else "200") in sentence


@pytest.mark.parametrize(
    "mode",
    [
        pytest.param(("--once", "--fused"), id="--once --fused", marks=pytest.mark.process),
        pytest.param(("--loop",), id="--loop", marks=pytest.mark.thorough),
    ],
)
async def test_a_topic_that_nobody_publishes_is_named(stage, boat, mode):
    _, uri = await stage.hub()
    running = stage.start("master", *mode, "-d", str(boat), "--uri", uri, "--first-data-timeout", "1")
    assert await running.end() == 3
    assert "/boat/sensors" in only_error(running)
    await stage.nothing_left("hub")


WITHOUT_D2 = {name: value for name, value in READING.items() if name != "D2"}


@pytest.mark.parametrize(
    ("reading", "frames"),
    [
        pytest.param(WITHOUT_D2, 0, id="no variable", marks=pytest.mark.process),
        pytest.param(
            READING | {"D1": 0, "D2": 100, "B1": 90, "B2": 270, "D3": 0},
            1,
            id="no posterior",
            marks=pytest.mark.thorough,
        ),
    ],
)
async def test_a_reading_without_a_result(stage, boat, server, reading, frames):
    uri, robot = server
    await robot.keep_publishing(**reading)
    code, sentence = await once(stage, boat, uri)
    assert code == 4, sentence
    assert robot.results == []
    assert len(robot.frames) == frames


@pytest.mark.thorough
async def test_in_a_loop_unusable_messages_are_counted_and_reported_once(stage, boat, server):
    uri, robot = server
    looping = stage.start(
        *("master", "--loop", "-d", str(boat), "--uri", uri, "--count", "3"),
        environment={"BM_RUN_DIRECTORY": str(stage.runs)},
    )
    await looping.says(PROGRAMMED)
    await until_subscribed(uri, "/boat/sensors")
    readings = (
        *(WITHOUT_D2, READING | {"D2": "50"}, READING | {"D2": float("nan")}, READING | {"D2": None}),
        *(READING | {"B1": 10**30, "D2": 1e400}, READING | {"D2": []}, WITHOUT_D2),
        WITHOUT_D2 | {"a": {"D2": 1}, "b": {"D2": 2}},
    )
    for count, reading in enumerate(readings, 1):
        await robot.publish(**reading)
        # in one burst the newest alone would count, as after a server's backlog
        await stage.status(
            "master",
            lambda status, count=count: status["frames"]["lost"].get("with an unusable variable") == count,
        )
    await robot.keep_publishing()
    assert await looping.end() == 0, looping.err
    skipped = [line for line in looping.err.splitlines() if "such messages are skipped" in line]
    assert 1 < len(skipped) < len(readings)
    assert all("D2" in line and "/boat/sensors" in line for line in skipped)
    assert f"{len(readings)} with an unusable variable" in looping.err


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


@pytest.fixture
async def stuck_board(stage, server, tmp_path):
    """A board that never says done; no other board could be late on a slow machine."""
    _, robot = server
    folder = build_boat(tmp_path / "one", partitions=1)
    endpoint = f"unix:{stage.where}/b.sock"
    warm_up()
    board = ServedBoard(endpoint, misbehave="never-done")
    await robot.keep_publishing()
    yield folder, ("--boards", endpoint, "--board-timeout", "0.3")
    board.stop()


@pytest.mark.process
async def test_a_board_that_never_says_done(stage, server, stuck_board):
    folder, options = stuck_board
    code, sentence = await once(stage, folder, server[0], *options)
    assert code == 5
    assert "board 0" in sentence.lower()


@pytest.mark.thorough
async def test_a_board_that_never_says_done_ends_a_loop_after_the_fourth_time(stage, server, stuck_board):
    folder, options = stuck_board
    looping = stage.start("master", "--loop", "-d", str(folder), "--uri", server[0], *options)
    assert await looping.end() == 5, looping.err
    assert re.search(r"\b4 frames failed on boards within \d+ s", only_error(looping))


@pytest.mark.parametrize("options", [(), ("--once", "--loop"), ("--once", "--count", "3")])
def test_wrong_usage(boat, options):
    ended = invoke(master.app, ["-d", boat, *options])
    assert ended.exit_code == 2
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.count("\n") == 1
