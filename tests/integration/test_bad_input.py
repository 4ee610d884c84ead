"""Bad input, as a user meets it: one sentence, the right exit code, no traceback, nothing left running."""

import asyncio
import shutil
import socket
import time

import pytest

from tests.integration.conftest import (
    PATIENCE,
    READING,
    Robot,
    build,
    build_boat,
    status_of,
    until_subscribed,
)


def only_sentence(running) -> str:
    """The one error line; a traceback or a second error fails the test."""
    assert "Traceback" not in running.err
    lines = [line for line in running.err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, running.err
    return lines[0]


async def once(stage, deployment, uri, *options) -> tuple[int, str]:
    master = stage.start("master", "--once", "-d", str(deployment), "--uri", uri, *options)
    code = await master.end()
    sentence = only_sentence(master)
    await stage.nothing_left("hub", "board")
    return code, sentence


@pytest.fixture
async def server(stage):
    """A hub, and a robot that publishes whatever it is told to."""
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        yield uri, robot


async def test_nothing_listens_there(stage, boat):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    code, sentence = await once(stage, boat, f"ws://127.0.0.1:{port}", "--connect-timeout", "1")
    assert code == 3
    assert f"ws://127.0.0.1:{port}" in sentence


async def test_a_web_server_is_no_rosbridge(stage, boat):
    async def answer(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi")
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as web:
        port = web.sockets[0].getsockname()[1]
        code, sentence = await once(stage, boat, f"ws://127.0.0.1:{port}", "--connect-timeout", "30")
    assert code == 3
    assert "200" in sentence


async def test_a_server_that_says_nothing(stage, boat):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"ws://127.0.0.1:{silent.getsockname()[1]}"
        code, sentence = await once(stage, boat, uri, "--connect-timeout", "1")
    assert code == 3
    assert uri in sentence


async def test_a_uri_that_is_none(stage, boat):
    code, sentence = await once(stage, boat, "http://robot:9090")
    assert code == 2
    assert "ws://" in sentence


@pytest.mark.parametrize("mode", ["--once", "--loop"])
async def test_a_topic_that_nobody_publishes_is_named(stage, boat, mode):
    _, uri = await stage.hub()
    master = stage.start("master", mode, "-d", str(boat), "--uri", uri, "--first-data-timeout", "1")
    assert await master.end() == 3
    sentence = only_sentence(master)
    assert "/boat/sensors" in sentence
    assert "within 1 s" in sentence
    await stage.nothing_left("hub")


WITHOUT_D2 = {name: value for name, value in READING.items() if name != "D2"}


@pytest.mark.parametrize(
    ("reading", "match"),
    [
        (WITHOUT_D2, ["D2", "D1", "B3"]),
        (READING | {"D2": "50"}, ["D2", "'50'", "string"]),
        (READING | {"D2": float("nan")}, ["D2"]),
        (READING | {"D2": None}, ["D2", "null"]),
        (READING | {"B1": 10**30, "D2": 1e400}, ["D2"]),
        (READING | {"D2": []}, ["D2", "empty array"]),
        (WITHOUT_D2 | {"a": {"D2": 1}, "b": {"D2": 2}}, ["D2", "a.D2", "b.D2"]),
    ],
    ids=["absent", "string", "NaN", "null", "infinite", "empty array", "twice"],
)
async def test_a_variable_that_cannot_be_used(stage, boat, server, reading, match):
    uri, robot = server
    await robot.keep_publishing(**reading)
    code, sentence = await once(stage, boat, uri)
    assert code == 4, sentence
    assert "/boat/sensors" in sentence
    for each in match:
        assert each in sentence


STRICT = """
from dataclasses import replace

from casestudies.boat.model import model as boat


def model():
    whole = boat(width=8, height=8)
    return replace(whole, known=tuple(replace(each, on_range="error") for each in whole.known))
"""


async def test_a_value_out_of_range_names_the_range(stage, server, tmp_path):
    """Bearings wrap and distances clamp in the boat's model; this one refuses."""
    (tmp_path / "strict").mkdir()
    (tmp_path / "strict/model.py").write_text(STRICT)
    deployment = build(tmp_path / "strict", tmp_path / "deployment")
    uri, robot = server
    await robot.keep_publishing(**READING | {"D2": 5000})
    code, sentence = await once(stage, deployment, uri)
    assert code == 4
    assert "D2: 5000 is out of range, expected 0 to 100" in sentence


async def test_in_a_loop_unusable_messages_are_counted_and_told_once(stage, boat, server):
    uri, robot = server
    runs = stage.runs
    master = stage.start(
        *("master", "--loop", "-d", str(boat), "--uri", uri, "--count", "3"),
        environment={"BM_RUN_DIRECTORY": str(runs)},
    )
    await master.says("pcie-app: 4 boards")
    await until_subscribed(uri, "/boat/sensors")

    async def counted():
        return (await status_of(runs, "master"))["frames"]["lost"].get("with an unusable variable", 0)

    for before in range(5):
        await robot.publish(**WITHOUT_D2)
        deadline = time.monotonic() + PATIENCE
        while (
            await counted() == before
        ):  # in one burst the newest alone would count, as after a server's backlog
            assert time.monotonic() < deadline, master.err
            await asyncio.sleep(0.02)
    await master.says("such messages are skipped")
    await robot.keep_publishing()
    assert await master.end() == 0, master.err
    assert master.err.count("such messages are skipped") == 1
    assert "5 with an unusable variable" in master.err


def edited(boat, directory, old: str, new: str):
    shutil.copytree(boat, directory)
    path = directory / "deployment.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return directory


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("format = 1", "format = 2", ["format 2", "format 1"]),
        ("target_count = 255", "target_count = 200", ["not as it was built", "hash"]),
        ("target_count", "target_cuont", ["target_cuont", "target_count", "deployment.toml, line"]),
        ("prob_bits = 8", 'prob_bits = "8"', ["prob_bits", "deployment.toml, line"]),
    ],
    ids=["another version", "edited", "wrong key", "wrong value"],
)
async def test_a_deployment_that_was_changed(stage, boat, tmp_path, old, new, match):
    code, sentence = await once(stage, edited(boat, tmp_path / "d", old, new), "ws://127.0.0.1:1")
    assert code == 2
    for each in match:
        assert each in sentence


async def test_a_damaged_image_is_named_with_its_hash(stage, boat, server, tmp_path):
    shutil.copytree(boat, tmp_path / "d")
    image = tmp_path / "d/boards/board2.bm"
    damaged = bytearray(image.read_bytes())
    damaged[-5] ^= 1
    image.write_bytes(damaged)
    code, sentence = await once(stage, tmp_path / "d", server[0])
    assert code == 2
    assert "board2.bm" in sentence
    assert "sha256" in sentence


async def test_no_deployment(stage, tmp_path):
    code, sentence = await once(stage, tmp_path, "ws://127.0.0.1:1")
    assert code == 2
    assert "toolchain build" in sentence


async def test_a_board_with_another_image(stage, boat, server, tmp_path):
    other = build_boat(tmp_path / "other", "--target-count", "100", cells=6)
    sockets = tmp_path / "s"
    sockets.mkdir()
    boards = stage.start("board", "--boards", "4", "--directory", str(sockets))
    while len(list(sockets.glob("*.sock"))) < 8:
        assert boards.process.poll() is None, boards.err
        await asyncio.sleep(0.02)
    loader = stage.start("loader", str(other / "boards/board1.bm"), f"unix:{sockets}/board1.sock")
    assert await loader.end() == 0, loader.err
    endpoints = ",".join(f"unix:{sockets}/board{at}.sock" for at in range(4))
    code, sentence = await once(stage, boat, server[0], "--boards", endpoints)
    assert code == 2
    assert "board 1" in sentence.lower()
    assert sentence.count("image") >= 1


async def misbehaving(stage, sockets, kind: str, at: int = 1) -> str:
    """Four boards, one of which does not behave; their endpoints."""
    sockets.mkdir()
    endpoints = [f"unix:{sockets}/board{each}.sock" for each in range(4)]
    for each, endpoint in enumerate(endpoints):
        wrong = ["--misbehave", kind] if each == at else []
        stage.start("board", "--listen", endpoint, "--index", str(each), *wrong)
    while len(list(sockets.glob("*.sock"))) < 8:
        await asyncio.sleep(0.02)
    return ",".join(endpoints)


async def test_a_board_that_never_says_done(stage, boat, server, tmp_path):
    uri, robot = server
    endpoints = await misbehaving(stage, tmp_path / "s", "never-done")
    await robot.keep_publishing()
    code, sentence = await once(stage, boat, uri, "--boards", endpoints, "--board-timeout", "3")
    assert code == 5
    assert "board 1" in sentence.lower()


async def test_in_a_loop_a_board_that_stops_answering_ends_the_run_after_the_fourth_time(
    stage, boat, server, tmp_path
):
    uri, robot = server
    endpoints = await misbehaving(stage, tmp_path / "s", "never-done:8")
    await robot.keep_publishing()
    master = stage.start(
        *("master", "--loop", "-d", str(boat), "--uri", uri, "--boards", endpoints, "--board-timeout", "1.5")
    )
    assert await master.end() == 5, master.err
    assert "4 frames failed on boards within 60 s" in only_sentence(master)


async def test_a_wrong_setting_in_the_environment(stage, boat):
    master = stage.start("master", "--once", "-d", str(boat), environment={"BM_QUEU": "all"})
    assert await master.end() == 2
    assert "BM_QUEUE" in only_sentence(master)


async def test_a_service_of_another_model_is_refused(stage, boat, server, tmp_path):
    uri, _ = server
    other = build_boat(tmp_path / "other", cells=6)
    endpoint = f"unix:{tmp_path}/subscriber.sock"
    stage.start("subscriber", "-d", str(other), "--uri", uri, "--listen", endpoint)
    master = stage.start(
        "master", "--once", "-d", str(boat), "--uri", uri, environment={"BM_SUBSCRIBER": endpoint}
    )
    assert await master.end() == 2
    assert "same deployment" in only_sentence(master)


@pytest.mark.parametrize("options", [(), ("--once", "--loop"), ("--once", "--count", "3")])
async def test_wrong_usage(stage, boat, options):
    master = stage.start("master", "-d", str(boat), *options)
    assert await master.end() == 2
    only_sentence(master)


async def test_impossible_readings_have_no_posterior(stage, boat, server):
    uri, robot = server
    await robot.keep_publishing(**READING | {"D1": 0, "D2": 100, "B1": 90, "B2": 270, "D3": 0})
    code, sentence = await once(stage, boat, uri)
    assert code == 4
    assert "no posterior" in sentence
    assert robot.results == []
    assert len(robot.frames) == 1
