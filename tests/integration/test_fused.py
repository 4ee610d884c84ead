"""`master --fused`: the same runs with three processes less.

robot ──▶ hub ──▶ master (subscriber, publisher and PCIe application inside) ──▶ boards
"""

import asyncio
import signal

import pytest

from tests.integration.conftest import Robot

FUSED = ("master", "--fused", "--connect-timeout", "30")


async def looping(stage, boat, *options):
    """A hub, a robot that publishes, a fused master in --loop, and its first results."""
    hub, uri = await stage.hub()
    robot = Robot(uri)
    await robot.connect()
    await robot.keep_publishing()
    master = stage.start(*FUSED, "--loop", "-d", str(boat), "--uri", uri, *options)
    await robot.have(2)
    return hub, uri, robot, master


async def test_a_fused_run_publishes_what_a_run_in_processes_does(stage, boat):
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        for fused in ([], ["--fused"]):
            master = stage.start("master", "--once", *fused, "-d", str(boat), "--uri", uri, "--json")
            assert await master.end() == 0, master.err
            assert '"seen":true' in master.out
        await robot.have(2)
        await stage.nothing_left("hub")
        assert robot.order == ["/bm/frame", "/BMresults"] * 2
        # the same reading and the same number: the same bank, and so the same bits
        assert robot.results[0]["data"] == robot.results[1]["data"]


async def test_only_the_master_and_its_boards_run(stage, boat):
    *_, master = await looping(stage, boat, "--count", "40")
    assert {name: len(all_) for name, all_ in stage.processes().items()} == {
        "hub": 1,
        "master": 1,
        "board": 5,
    }
    assert await master.end() == 0, master.err
    assert "40 results published" in master.err
    await stage.nothing_left("hub")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
async def test_a_signal_ends_everything(stage, boat, number, code):
    *_, master = await looping(stage, boat)
    master.send(number)
    assert await master.end() == code
    assert "Traceback" not in master.err
    await stage.nothing_left("hub")


async def test_a_signal_while_the_boards_start_is_not_waited_out(stage, boat):
    _, uri = await stage.hub()
    master = stage.start(*FUSED, "--loop", "-d", str(boat), "--uri", uri, "--peer-timeout", "250")
    await master.says("subscriber: connected")
    master.send(signal.SIGINT)
    assert await master.end() == 130  # not the minutes that boards may take
    await stage.nothing_left("hub")


async def test_a_killed_master_leaves_nothing(stage, boat):
    *_, master = await looping(stage, boat)
    master.send(signal.SIGKILL)
    await stage.nothing_left("hub")


async def test_killed_boards_are_restarted_and_programmed(stage, boat):
    _, _, robot, master = await looping(stage, boat)
    boards = stage.boards()
    parent = boards[0].parent()
    for victim in boards[:2]:
        victim.kill()
    await master.says("restarting it", times=2)
    await master.says("is back, programmed")
    before = len(robot.results)
    await robot.have(before + 5)
    assert parent.is_running()
    master.send(signal.SIGINT)
    assert await master.end() == 130
    await stage.nothing_left("hub")


async def test_rosbridge_may_go_and_come(stage, boat):
    hub, uri, robot, master = await looping(stage, boat)
    hub.send(signal.SIGKILL)
    await hub.end()
    await master.says("is gone")
    await asyncio.sleep(0.5)
    before = len(robot.results)
    await stage.hub(int(uri.rsplit(":", 1)[1]))
    await robot.have(before + 5)
    master.send(signal.SIGTERM)
    assert await master.end() == 143


async def test_a_silent_topic_is_named(stage, boat):
    _, uri = await stage.hub()
    master = stage.start(*FUSED, "--once", "-d", str(boat), "--uri", uri, "--first-data-timeout", "1")
    assert await master.end() == 3
    assert master.err.count("error: ") == 1
    assert "/boat/sensors" in master.err.splitlines()[-1]
    await stage.nothing_left("hub")


async def test_boards_that_are_not_there(stage, boat, tmp_path):
    _, uri = await stage.hub()
    boards = ",".join(f"unix:{tmp_path}/board{at}.sock" for at in range(4))
    options = ("--boards", boards, "--peer-timeout", "1")
    master = stage.start(*FUSED, "--loop", "-d", str(boat), "--uri", uri, *options)
    assert await master.end() == 5
    assert "No board listens" in master.err.splitlines()[-1]
    await stage.nothing_left("hub")


async def test_a_service_elsewhere_is_refused(stage, boat, tmp_path):
    master = stage.start(*FUSED, "--loop", "-d", str(boat), "--connect", str(tmp_path))
    assert await master.end() == 2
    assert "--fused runs subscriber, publisher and pcie-app in the master's own process" in master.err
