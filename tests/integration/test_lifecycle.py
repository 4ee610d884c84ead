"""Beginnings and ends: whatever happens to a run, its processes end, and one sentence says what happened."""

import asyncio
import json
import os
import pty
import re
import signal
import socket
import time

import pytest

from tests.integration.conftest import BIN, MARK, PATIENCE, READING, Robot

LOOP = ("master", "--loop", "--connect-timeout", "30")


async def looping(stage, boat, *options):
    """A hub, a robot that publishes, a master in --loop, and its first results."""
    hub, uri = await stage.hub()
    robot = Robot(uri)
    await robot.connect()
    await robot.keep_publishing()
    master = stage.start(*LOOP, "-d", str(boat), "--uri", uri, *options)
    await robot.have(2)
    return hub, uri, robot, master


async def test_once_publishes_one_result_sees_it_and_ends(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        master = stage.start("master", "--once", "-d", str(boat), "--uri", uri, "--json")
        assert await master.end() == 0, master.err
        await robot.have(1)
        await stage.nothing_left("hub")
        assert len(robot.results) == 1
        assert robot.order == ["/bm/frame", "/BMresults"]
        assert '"seen":true' in master.out
        assert abs(sum(robot.results[0]["data"]) - 1) < 1e-9


async def test_loop_ends_by_itself_after_count(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        master = stage.start(*LOOP, "--count", "5", "-d", str(boat), "--uri", uri)
        assert await master.end() == 0, master.err
        await robot.have(5)
        assert "5 results published" in master.err
        await stage.nothing_left("hub")
        assert robot.order == ["/bm/frame", "/BMresults"] * 5


async def test_each_board_is_a_process_of_its_own(stage, boat):
    await looping(stage, boat)
    found = {name: len(all_) for name, all_ in stage.processes().items()}
    assert found == {"hub": 1, "master": 1, "subscriber": 1, "publisher": 1, "pcie-app": 1, "board": 5}


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
async def test_a_signal_ends_everything(stage, boat, number, code):
    *_, master = await looping(stage, boat)
    master.send(number)
    assert await master.end() == code
    assert "Traceback" not in master.err
    assert "published" in master.err
    await stage.nothing_left("hub")


async def test_a_killed_master_leaves_nothing(stage, boat):
    *_, master = await looping(stage, boat)
    master.send(signal.SIGKILL)
    await stage.nothing_left("hub")


async def test_a_closed_terminal_leaves_nothing(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        pid, terminal = pty.fork()
        if pid == 0:
            os.environ["ROSBAYES_TEST_RUN"] = stage.run
            os.environ["TMPDIR"] = str(stage.where)
            os.execv(BIN / "master", [*LOOP, "-d", str(boat), "--uri", uri])
        await robot.have(2)
        os.close(terminal)
        deadline = time.monotonic() + PATIENCE
        while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
            assert time.monotonic() < deadline
            await asyncio.sleep(0.05)
        assert os.waitstatus_to_exitcode(ended[1]) == 129
        await stage.nothing_left("hub")


@pytest.mark.parametrize(
    ("victim", "code"), [("subscriber", 6), ("publisher", 6), ("pcie-app", 6), ("board", 5)]
)
async def test_once_ends_with_a_childs_death(stage, boat, victim, code):
    _, uri = await stage.hub()
    master = stage.start("master", "--once", "-d", str(boat), "--uri", uri)  # nobody publishes: it waits
    await master.says("pcie-app: 4 boards")
    await master.says("publisher: publishing")
    stage.processes()[victim][-1].kill()
    assert await master.end() == code, master.err
    assert master.err.count("error: ") == 1
    assert victim in master.err.splitlines()[-1] or "board" in master.err.splitlines()[-1]
    await stage.nothing_left("hub")


async def test_once_ends_when_rosbridge_goes(stage, boat):
    hub, uri = await stage.hub()
    master = stage.start("master", "--once", "-d", str(boat), "--uri", uri)
    await master.says("subscriber: connected")
    await master.says("pcie-app: 4 boards")
    await asyncio.sleep(0.3)
    hub.send(signal.SIGKILL)
    assert await master.end() == 3, master.err
    assert uri in master.err.splitlines()[-1]
    await stage.nothing_left()


async def test_loop_survives_rosbridge_going_and_coming(stage, boat):
    hub, uri, robot, master = await looping(stage, boat)
    hub.send(signal.SIGKILL)
    await hub.end()
    await master.says("is gone")
    await asyncio.sleep(0.5)
    before = len(robot.results)
    await stage.hub(int(uri.rsplit(":", 1)[1]))
    await robot.have(before + 5)
    master.send(signal.SIGINT)
    assert await master.end() == 130
    await stage.nothing_left("hub")


@pytest.mark.parametrize("victim", ["subscriber", "publisher", "pcie-app"])
async def test_loop_survives_a_killed_service(stage, boat, victim):
    _, _, robot, master = await looping(stage, boat)
    stage.processes()[victim][0].kill()
    await master.says(f"{victim} was killed by SIGKILL; restarting it")
    before = len(robot.results)
    await robot.have(before + 5)


async def test_loop_survives_all_boards_dying_at_once(stage, boat):
    _, _, robot, master = await looping(stage, boat)
    stage.boards()[0].parent().kill()  # all were forked from it
    await master.says("the boards' process was killed by SIGKILL; restarting it")
    await robot.have(len(robot.results) + 5)
    assert master.process.poll() is None


async def test_loop_survives_a_killed_board_and_gives_up_on_the_fourth(stage, boat):
    _, _, robot, master = await looping(stage, boat)
    for time_ in range(1, 4):
        stage.boards()[-1].kill()
        await master.says(r"board \d was killed by SIGKILL; restarting it", times=time_)
        await master.says(r"board \d is back", times=time_)
        await robot.have(len(robot.results) + 3)
    stage.boards()[-1].kill()
    assert await master.end() == 5, master.err
    assert re.search(r"4 (ends of boards|frames failed on boards) within 60 s", master.err)
    await stage.nothing_left("hub")


async def test_a_second_set_of_boards_leaves_the_first_alone(stage, tmp_path):
    first = stage.start("board", "--boards", "2", "--directory", str(tmp_path))
    paths = {f"board{at}{kind}.sock" for at in (0, 1) for kind in ("", ".program")}
    deadline = time.monotonic() + PATIENCE
    while {path.name for path in tmp_path.glob("*.sock")} < paths:
        assert time.monotonic() < deadline, first.err
        await asyncio.sleep(0.05)
    second = stage.start("board", "--boards", "2", "--directory", str(tmp_path))
    assert await second.end() == 2
    assert second.err.count("\n") == 1
    assert "another process listens at" in second.err
    assert {path.name for path in tmp_path.glob("*.sock")} >= paths
    first.send(signal.SIGTERM)
    assert await first.end() == 143


async def test_loop_gives_up_on_a_service_that_dies_too_often(stage, boat):
    _, _, robot, master = await looping(stage, boat)
    for time_ in range(1, 4):
        stage.processes()["subscriber"][0].kill()
        await master.says("subscriber was killed by SIGKILL; restarting", times=time_)
        await robot.have(len(robot.results) + 2)
    stage.processes()["subscriber"][0].kill()
    assert await master.end() == 6, master.err
    assert "restarted 3 times within 60 s" in master.err
    await stage.nothing_left("hub")


async def test_services_that_already_run_are_used_and_left_running(stage, boat):
    _, uri = await stage.hub()
    sockets = stage.where / "s"
    sockets.mkdir(mode=0o700)
    boards = ",".join(f"unix:{sockets}/board{at}.sock" for at in range(4))
    stage.start("board", "--boards", "4", "--directory", str(sockets))
    stage.start("pcie-app", "-d", str(boat), "--boards", boards, "--listen", f"unix:{sockets}/pcie-app.sock")
    stage.start("subscriber", "-d", str(boat), "--uri", uri, "--listen", f"unix:{sockets}/subscriber.sock")
    stage.start("publisher", "-d", str(boat), "--uri", uri, "--listen", f"unix:{sockets}/publisher.sock")
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        for total in (3, 6):  # a second master finds the same services
            master = stage.start(*LOOP, "--count", "3", "-d", str(boat), "--connect", str(sockets))
            assert await master.end() == 0, master.err
            await robot.have(total)
        await stage.nothing_left("hub", "board", "pcie-app", "subscriber", "publisher")


async def test_the_parts_alone_make_a_pipeline(stage, boat):
    _, uri = await stage.hub()
    sockets = stage.where / "s"
    sockets.mkdir(mode=0o700)
    boards = ",".join(f"unix:{sockets}/board{at}.sock" for at in range(4))
    stage.start("board", "--boards", "4", "--directory", str(sockets))
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        code, _, err = await shell(
            stage,
            f"subscriber -d {boat} --uri {uri} --count 3 | pcie-app -d {boat} --boards {boards}"
            f" | publisher -d {boat} --uri {uri}",
        )
        assert code == 0, err
        await robot.have(3)


async def test_the_subscriber_alone_prints_what_it_finds(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        alone = stage.start(
            *("subscriber", "--uri", uri, "--topic", "/boat/sensors", "--type", "boat_msgs/Sensors"),
            *("--variables", "D1,header.frame_id", "--count", "2"),
        )
        assert await alone.end() == 0, alone.err
        assert alone.out == f'{{"D1":{READING["D1"]},"header.frame_id":"map"}}\n' * 2


async def shell(stage, command: str, timeout: float = PATIENCE) -> tuple[int, str, str]:
    """A command as a shell runs it, with the test's marks: exit code, standard output, standard error."""
    process = await asyncio.create_subprocess_shell(
        f"set -o pipefail; cd {stage.where}; {command}",
        executable="/bin/bash",
        env=dict(os.environ) | {MARK: stage.run, "TMPDIR": str(stage.where), "PATH": f"{BIN}:/usr/bin:/bin"},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    out, err = await asyncio.wait_for(process.communicate(), timeout)
    return process.returncode, out.decode(), err.decode()


@pytest.mark.parametrize(
    ("redirection", "code"), [("--json | head -1", 0), (">&-", 143), ("2>&-", 143), ("--json >/dev/full", 2)]
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
        ended, _, err = await running
        assert ended == code, err
        assert "Traceback" not in err
        await robot.have(1)
        await stage.nothing_left("hub")


async def test_a_peer_that_says_nothing_is_given_up(stage, boat):
    _, uri = await stage.hub()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        master = stage.start(
            *("master", "--once", "-d", str(boat), "--uri", uri, "--peer-timeout", "10"),
            environment={"BM_SUBSCRIBER": endpoint},
        )
        assert await master.end() == 6, master.err
    assert f"subscriber at {endpoint} did not greet within 10 s" in master.err
    await stage.nothing_left("hub")


SLOW_BOARDS = """
import sys, time
if any(word.endswith("/board") for word in sys.orig_argv):
    time.sleep(12)
"""


@pytest.mark.parametrize("how", [(), ("--fused",)], ids=["processes", "fused"])
async def test_boards_that_compile_their_kernels_first_are_waited_for(stage, boat, tmp_path, how):
    """The first start of all takes a slow processor longer than a board may take to be reached."""
    (tmp_path / "sitecustomize.py").write_text(SLOW_BOARDS)
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        command = ("master", "--once", *how, "-d", str(boat), "--uri", uri)
        master = stage.start(*command, environment={"PYTHONPATH": str(tmp_path)})
        assert await master.end() == 0, master.err
    await stage.nothing_left("hub")


async def test_results_from_a_file_are_published(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        (stage.where / "results").write_text(json.dumps([1 / 64] * 64) + "\n")
        code, _, err = await shell(stage, f"publisher -d {boat} --uri {uri} < results")
        assert code == 0, err
        await robot.have(1)
