"""Starts and ends: whatever happens to a run, its processes end, and its exit code gives the reason.

robot ──▶ hub ──▶ master, its services (with --fused: tasks of the master), boards
"""

import asyncio
import json
import os
import pty
import re
import signal

import pytest

from tests.integration.conftest import (
    BIN,
    LOOP,
    PROGRAMMED,
    READING,
    endpoints_in,
    only_error,
    right_posteriors,
    stamp_of,
    until,
    until_subscribed,
)
from tests.patience import PROCESS_PATIENCE


@pytest.mark.process
@pytest.mark.parametrize("how", ["--read-results", "--fused"])
async def test_once_publishes_one_result_sees_it_and_ends(stage, robot, boat, how):
    """The result is to the bit what the machines count, so with these it is the same."""
    await robot.keep_publishing()
    master = stage.start("master", "--once", how, "-d", str(boat), "--uri", robot.uri, "--json")
    assert await master.end() == 0, master.err
    assert json.loads(master.out)["seen"] is True
    await robot.have(1)
    await stage.nothing_left("hub")
    assert robot.order == ["/bm/frame", "/BMresults"]
    assert abs(sum(robot.results[0]["data"]) - 1) < 1e-9
    (number,) = (pair["value"] for pair in robot.frames[0]["status"][0]["values"] if pair["key"] == "number")
    right = right_posteriors(boat)
    assert robot.results[0]["data"] == right[int(number) % len(right)].tolist()


@pytest.mark.process
async def test_loop_ends_by_itself_after_count(stage, robot, boat):
    master = stage.start(*LOOP, "--count", "5", "-d", str(boat), "--uri", robot.uri)
    await until_subscribed(robot.uri, "/boat/sensors")  # the boards are ready, and nothing is published yet
    services = ("hub", "master", "subscriber", "publisher", "pcie-app")
    processes = dict.fromkeys(services, 1) | {"board": 5}
    assert {name: len(found) for name, found in stage.processes().items()} == processes
    await robot.keep_publishing()
    assert await master.end() == 0, master.err
    await robot.have(5)
    await stage.nothing_left("hub")
    assert robot.order == ["/bm/frame", "/BMresults"] * 5


@pytest.mark.process
async def test_with_queue_all_every_reading_has_a_result(stage, robot, boat):
    command = (*LOOP, "--fused", "--queue", "all", "--count", "12", "-d", str(boat), "--uri", robot.uri)
    master = stage.start(*command)
    await master.says(PROGRAMMED)
    await until_subscribed(robot.uri, "/boat/sensors")
    stamps = [await robot.publish(**READING) for _ in range(12)]
    assert await master.end() == 0, master.err
    await robot.have(12)
    assert [stamp_of(frame) for frame in robot.frames] == stamps
    assert "not published" not in master.err


@pytest.mark.process
@pytest.mark.parametrize(
    ("how", "number", "code"),
    [((), signal.SIGTERM, 143), (("--fused",), signal.SIGINT, 130)],
    ids=["processes", "fused"],
)
async def test_a_signal_ends_all_and_leaves_nothing(stage, boat, how, number, code):
    _, _, master = await stage.loop(boat, *how)
    master.send(number)
    assert await master.end() == code
    assert "Traceback" not in master.err
    await stage.nothing_left("hub")
    assert not list(stage.runs.iterdir())


@pytest.mark.process
async def test_a_master_that_is_killed_leaves_nothing(stage, boat):
    _, _, master = await stage.loop(boat)
    master.send(signal.SIGKILL)
    _, _, next_one = await stage.loop(boat)  # waits for the end of its processes, in the same directory
    next_one.send(signal.SIGTERM)
    assert await next_one.end() == 143
    await stage.nothing_left("hub")
    assert not list(stage.runs.iterdir())


@pytest.mark.thorough
async def test_a_signal_while_the_boards_start_is_not_waited_out(stage, boat):
    _, uri = await stage.hub()
    options = ("--fused", "-d", str(boat), "--uri", uri, "--peer-timeout", str(10 * PROCESS_PATIENCE))
    master = stage.start(*LOOP, *options, environment={"BM_RUN_DIRECTORY": str(stage.runs)})
    await stage.status("subscriber", lambda status: status["ready"])
    master.send(signal.SIGINT)
    assert await master.end() == 130  # not the minutes that boards may take
    await stage.nothing_left("hub")


@pytest.mark.thorough
async def test_a_closed_terminal_leaves_nothing(stage, robot, boat):
    await robot.keep_publishing()
    pid, terminal = pty.fork()
    if pid == 0:
        os.execve(BIN / "master", [*LOOP, "-d", str(boat), "--uri", robot.uri], stage.environment)
    await robot.have(2)
    os.close(terminal)
    ended = await until(lambda: (ended := os.waitpid(pid, os.WNOHANG))[0] and ended)
    assert os.waitstatus_to_exitcode(ended[1]) == 129
    await stage.nothing_left("hub")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("victim", "code"), [("subscriber", 6), ("publisher", 6), ("pcie-app", 6), ("board", 5), ("hub", 3)]
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
    stage.processes()[victim][-1].kill()
    assert await master.end() == code, master.err
    assert (uri if victim == "hub" else victim.removesuffix("-app")) in only_error(master)
    await stage.nothing_left("hub")


@pytest.mark.process
async def test_a_hub_that_restarts_is_waited_for(stage, boat):
    hub, robot, master = await stage.loop(boat, "--fused")
    hub.send(signal.SIGKILL)
    await hub.end()
    await stage.status("publisher", lambda status: not status["ready"])
    await robot.lost()
    before = len(robot.results)
    await stage.hub(int(robot.uri.rsplit(":", 1)[1]))
    await robot.have(before + 3)
    master.send(signal.SIGHUP)
    assert await master.end() == 129
    assert "Traceback" not in master.err
    await stage.nothing_left("hub")


@pytest.mark.process
async def test_boards_that_are_killed_come_back(stage, boat):
    _, robot, master = await stage.loop(boat, "--fused")
    boards = stage.boards()
    parent = boards[0].parent()
    for victim in boards[:2]:
        victim.kill()
    await stage.board_is_back()  # the other may be back before anybody has missed it
    await robot.have(len(robot.results) + 3)
    assert parent.is_running()
    master.send(signal.SIGTERM)
    assert await master.end() == 143
    assert "Traceback" not in master.err


@pytest.mark.thorough
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


@pytest.mark.process
async def test_loop_gives_up_on_the_fourth_death_of_a_board(stage, boat):
    _, robot, master = await stage.loop(boat, "--fused")
    for times in range(1, 4):
        stage.boards()[-1].kill()
        await stage.board_is_back(times)
        await robot.have(len(robot.results) + 1)
    stage.boards()[-1].kill()
    assert await master.end() == 5
    assert re.search(r"\bwithin \d+ s", only_error(master))
    await stage.nothing_left("hub")


@pytest.mark.process
async def test_the_parts_alone_make_a_pipeline(stage, robot, boat):
    _, boards = stage.start_boards()
    await robot.keep_publishing()
    code, err = await shell(
        stage,
        f"subscriber -d {boat} --uri {robot.uri} --count 3 | pcie-app -d {boat} --boards {boards}"
        f" | publisher -d {boat} --uri {robot.uri}",
    )
    assert code == 0, err
    await robot.have(3)


@pytest.mark.thorough
async def test_the_first_and_the_last_part_alone(stage, robot, boat):
    await robot.keep_publishing()
    (stage.where / "results").write_text(json.dumps([1 / 64] * 64) + "\n")
    code, err = await shell(stage, f"publisher -d {boat} --uri {robot.uri} < results")
    assert code == 0, err
    await robot.have(1)
    alone = stage.start(
        *("subscriber", "--uri", robot.uri, "--topic", "/boat/sensors", "--type", "boat_msgs/Sensors"),
        *("--variables", "D1,header.frame_id", "--count", "2"),
    )
    assert await alone.end() == 0, alone.err
    assert alone.out == f'{{"D1":{READING["D1"]},"header.frame_id":"map"}}\n' * 2


async def shell(stage, command):
    """A command as a shell runs it, with the test's marks: exit code, and standard error."""
    process = await asyncio.create_subprocess_shell(
        f"set -o pipefail; cd {stage.where}; {command}",
        executable="/bin/bash",
        env=stage.environment | {"PATH": f"{BIN}:/usr/bin:/bin"},
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    _, err = await asyncio.wait_for(process.communicate(), PROCESS_PATIENCE)
    return process.returncode, err.decode()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("redirection", "code"),
    [("--fused --json | head -1", 0), (">&- 2>&-", 143), ("--fused --json >/dev/full", 2)],
)
async def test_closed_and_full_streams_leave_no_run_behind(stage, robot, boat, redirection, code):
    await robot.keep_publishing()
    command = f"master --loop -d {boat} --uri {robot.uri} {redirection}"
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


@pytest.mark.thorough
async def test_boards_that_are_not_there(stage, boat, tmp_path):
    _, uri = await stage.hub()
    options = ("--boards", endpoints_in(tmp_path), "--peer-timeout", "1")
    master = stage.start(*LOOP, "--fused", "-d", str(boat), "--uri", uri, *options)
    assert await master.end() == 5
    assert str(tmp_path) in only_error(master)
    await stage.nothing_left("hub")
