"""Starts and ends: whatever happens to a run, its processes end, and its exit code gives the reason.

robot ──▶ hub ──▶ master, its services (with --fused: tasks of the master), boards
"""

import asyncio
import json
import os
import pty
import signal
import socket

import pytest

from tests.integration.conftest import (
    BIN,
    LOOP,
    MARK,
    PATIENCE,
    READING,
    Robot,
    endpoints_in,
    only_error,
    until,
)

both_ways = pytest.mark.parametrize("how", [(), ("--fused",)], ids=["processes", "fused"])


async def test_once_publishes_one_result_sees_it_and_ends(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        for how in ([], ["--fused"]):
            master = stage.start("master", "--once", *how, "-d", str(boat), "--uri", uri, "--json")
            assert await master.end() == 0, master.err
            assert json.loads(master.out)["seen"] is True
        await robot.have(2)
        await stage.nothing_left("hub")
        assert robot.order == ["/bm/frame", "/BMresults"] * 2
        assert abs(sum(robot.results[0]["data"]) - 1) < 1e-9
        # the same reading and the same number: the same bank, and so the same bits
        assert robot.results[0]["data"] == robot.results[1]["data"]


@pytest.mark.parametrize(
    ("how", "processes"),
    [
        ((), {"master": 1, "subscriber": 1, "publisher": 1, "pcie-app": 1, "board": 5}),
        (("--fused",), {"master": 1, "board": 5}),
    ],
    ids=["processes", "fused"],
)
async def test_loop_ends_by_itself_after_count(stage, boat, how, processes):
    _, robot, master = await stage.loop(boat, *how, "--count", "40")
    assert {name: len(found) for name, found in stage.processes().items()} == {"hub": 1} | processes
    assert await master.end() == 0, master.err
    await robot.have(40)
    await stage.nothing_left("hub")
    assert robot.order == ["/bm/frame", "/BMresults"] * 40


async def test_a_signal_while_the_boards_start_is_not_waited_out(stage, boat):
    _, uri = await stage.hub()
    options = ("--fused", "-d", str(boat), "--uri", uri, "--peer-timeout", "250")
    master = stage.start(*LOOP, *options, environment={"BM_RUN_DIRECTORY": str(stage.runs)})
    await stage.status("subscriber", lambda status: status["ready"])
    master.send(signal.SIGINT)
    assert await master.end() == 130  # not the minutes that boards may take
    await stage.nothing_left("hub")


async def test_a_closed_terminal_leaves_nothing(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        pid, terminal = pty.fork()
        if pid == 0:
            os.environ[MARK] = stage.run
            os.environ["TMPDIR"] = str(stage.where)
            os.execv(BIN / "master", [*LOOP, "-d", str(boat), "--uri", uri])
        await robot.have(2)
        os.close(terminal)
        ended = await until(lambda: (ended := os.waitpid(pid, os.WNOHANG))[0] and ended)
        assert os.waitstatus_to_exitcode(ended[1]) == 129
        await stage.nothing_left("hub")


@pytest.mark.parametrize(
    ("victim", "code"),
    [("subscriber", 6), ("publisher", 6), ("pcie-app", 6), ("board", 5), ("hub", 3)],
)
async def test_once_ends_with_a_death(stage, boat, victim, code):
    _, uri = await stage.hub()
    master = stage.start(  # no robot publishes: it waits
        *("master", "--once", "-d", str(boat), "--uri", uri),
        environment={"BM_RUN_DIRECTORY": str(stage.runs)},
    )
    await stage.status(
        "master", lambda status: status["peers"] and all(each["ready"] for each in status["peers"])
    )
    await asyncio.sleep(0.3)
    stage.processes()[victim][-1].kill()
    assert await master.end() == code, master.err
    assert (uri if victim == "hub" else victim.removesuffix("-app")) in only_error(master)
    await stage.nothing_left("hub")


@pytest.mark.parametrize(
    ("how", "number", "code"),
    [((), signal.SIGTERM, 143), (("--fused",), signal.SIGHUP, 129)],
    ids=["processes", "fused"],
)
async def test_loop_survives_rosbridge_going_and_boards_dying(stage, boat, how, number, code):
    hub, robot, master = await stage.loop(boat, *how)
    hub.send(signal.SIGKILL)
    await hub.end()
    await stage.status("publisher", lambda status: not status["ready"])
    await asyncio.sleep(0.5)
    before = len(robot.results)
    await stage.hub(int(robot.uri.rsplit(":", 1)[1]))
    await robot.have(before + 5)
    boards = stage.boards()
    parent = boards[0].parent()
    for victim in boards[:2]:
        victim.kill()
    await stage.board_is_back()  # the other may be back before anybody has missed it
    await robot.have(len(robot.results) + 5)
    assert parent.is_running()
    master.send(number)
    assert await master.end() == code
    assert "Traceback" not in master.err
    await stage.nothing_left("hub")


async def test_loop_survives_deaths_of_services_and_gives_up_on_the_fourth(stage, boat):
    _, robot, master = await stage.loop(boat)
    stage.boards()[0].parent().kill()  # all were forked from it
    await stage.board_is_back(4)
    await robot.have(len(robot.results) + 5)
    for victim, times in (("publisher", 1), ("pcie-app", 1), *(("subscriber", times) for times in (1, 2, 3))):
        stage.processes()[victim][0].kill()
        await stage.restarted(victim, times)
        await robot.have(len(robot.results) + 5)
    stage.processes()["subscriber"][0].kill()
    assert await master.end() == 6
    assert "subscriber" in only_error(master)
    await stage.nothing_left("hub")


async def test_loop_gives_up_on_the_fourth_death_of_a_board(stage, boat):
    _, robot, master = await stage.loop(boat)
    for times in range(1, 4):
        stage.boards()[-1].kill()
        await stage.board_is_back(times)
        await robot.have(len(robot.results) + 3)
    stage.boards()[-1].kill()
    assert await master.end() == 5
    assert "60 s" in only_error(master)
    await stage.nothing_left("hub")


async def test_the_parts_alone_make_a_pipeline(stage, boat):
    _, uri = await stage.hub()
    _, boards = stage.start_boards()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        code, err = await shell(
            stage,
            f"subscriber -d {boat} --uri {uri} --count 3 | pcie-app -d {boat} --boards {boards}"
            f" | publisher -d {boat} --uri {uri}",
        )
        assert code == 0, err
        await robot.have(3)
        (stage.where / "results").write_text(json.dumps([1 / 64] * 64) + "\n")
        code, err = await shell(stage, f"publisher -d {boat} --uri {uri} < results")
        assert code == 0, err
        await robot.have(4)
        alone = stage.start(
            *("subscriber", "--uri", uri, "--topic", "/boat/sensors", "--type", "boat_msgs/Sensors"),
            *("--variables", "D1,header.frame_id", "--count", "2"),
        )
        assert await alone.end() == 0, alone.err
        assert alone.out == f'{{"D1":{READING["D1"]},"header.frame_id":"map"}}\n' * 2


async def shell(stage, command: str) -> tuple[int, str]:
    """A command as a shell runs it, with the test's marks: exit code, and standard error."""
    process = await asyncio.create_subprocess_shell(
        f"set -o pipefail; cd {stage.where}; {command}",
        executable="/bin/bash",
        env=dict(os.environ) | {MARK: stage.run, "TMPDIR": str(stage.where), "PATH": f"{BIN}:/usr/bin:/bin"},
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    _, err = await asyncio.wait_for(process.communicate(), PATIENCE)
    return process.returncode, err.decode()


@pytest.mark.parametrize(
    ("redirection", "code"),
    [("--fused --json | head -1", 0), (">&- 2>&-", 143), ("--fused --json >/dev/full", 2)],
)
async def test_closed_and_full_streams_leave_no_run_behind(stage, boat, redirection, code):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        command = f"master --loop -d {boat} --uri {uri} {redirection}"
        running = asyncio.create_task(shell(stage, f"{command}; exit $?"))
        if code == 143:
            await robot.have(1)
            for master in stage.processes()["master"]:
                master.terminate()
        ended, err = await running
        assert ended == code, err
        assert "Traceback" not in err
        await robot.have(1)
        await stage.nothing_left("hub")


async def test_a_peer_that_does_not_greet_is_given_up(stage, boat):
    _, uri = await stage.hub()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        master = stage.start(
            *("master", "--once", "-d", str(boat), "--uri", uri, "--peer-timeout", "3"),
            environment={"BM_SUBSCRIBER": endpoint},
        )
        assert await master.end() == 6, master.err
    assert f"subscriber at {endpoint}" in only_error(master)
    await stage.nothing_left("hub")


async def test_boards_that_are_not_there(stage, boat, tmp_path):
    _, uri = await stage.hub()
    options = ("--boards", endpoints_in(tmp_path), "--peer-timeout", "1")
    master = stage.start(*LOOP, "--fused", "-d", str(boat), "--uri", uri, *options)
    assert await master.end() == 5
    assert str(tmp_path) in only_error(master)
    await stage.nothing_left("hub")


SLOW_BOARDS = """
import sys, time
if any(word.endswith("/board") for word in sys.orig_argv):
    time.sleep(5)
"""


@both_ways
async def test_boards_that_compile_their_kernels_first_are_waited_for(stage, boat, tmp_path, how):
    """The first start of all takes a slow processor longer than a board may take to be reached."""
    (tmp_path / "sitecustomize.py").write_text(SLOW_BOARDS)
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        command = ("master", "--once", *how, "--peer-timeout", "2.5", "-d", str(boat), "--uri", uri)
        master = stage.start(*command, environment={"PYTHONPATH": str(tmp_path)})
        assert await master.end() == 0, master.err
    await stage.nothing_left("hub")
