"""`master --start-each-message`: each message has a subscriber and a publisher of its own, and none is lost.

robot ──▶ hub ──▶ subscriber 1, 2, 3 ──▶ master ◀─▶ pcie-app ──▶ boards;  master ──▶ publisher 1, 2, 3 ──▶ hub ──▶ robot
"""

import re
import signal

import psutil
import pytest

from tests.integration.conftest import (
    LOOP,
    PROGRAMMED,
    READING,
    Robot,
    only_error,
    right_posteriors,
    stamp_of,
    until,
    until_subscribed,
)
from tests.patience import FACTOR

EACH = (*LOOP, "--start-each-message")


@pytest.mark.process
async def test_every_message_has_its_own_processes_and_its_result(stage, boat):
    _, uri = await stage.hub()
    seen, stamps = {"subscriber": [], "publisher": []}, []

    async def new(role):
        """Wait until one process of a role runs, which has not been there before."""

        def found():
            pids = [each.pid for each in stage.processes().get(role, ())]
            return pids if len(pids) == 1 and pids[0] not in seen[role] else None

        seen[role] += await until(found, lambda: f"{role}: {seen[role]}, {stage.processes()}")

    async with Robot(uri) as robot:
        master = stage.start(*EACH, "--count", "3", "-d", str(boat), "--uri", uri)
        await master.says(PROGRAMMED)
        (app,) = stage.processes()["pcie-app"]
        for at in range(3):
            await new("subscriber")
            await until_subscribed(uri, "/boat/sensors")
            if at == 1:  # a message without a reading is skipped, as in any loop, and had a subscriber too
                await robot.publish(D1=3)
                await new("subscriber")
                await until_subscribed(uri, "/boat/sensors")
            await until(lambda: not stage.processes().get("publisher"))
            app.suspend()  # the next one is there while the boards' result is not
            stamps.append(await robot.publish(**READING))
            await new("publisher")
            app.resume()
            await robot.have(at + 1)
        assert await master.end() == 0, master.err
        assert app.pid not in psutil.pids()
        await stage.nothing_left("hub")
    assert {role: len(set(pids)) for role, pids in seen.items()} == {"subscriber": 4, "publisher": 3}
    assert [stamp_of(frame) for frame in robot.frames] == stamps
    right = right_posteriors(boat)
    assert [each["data"] for each in robot.results] == [right[number].tolist() for number in (1, 2, 3)]
    assert master.err.count("[warning]") == 1, master.err
    assert master.err.endswith("; not published: 1 with an unusable variable\n")


@pytest.mark.process
async def test_ctrl_c_at_any_time_leaves_nothing(stage, boat):
    _, robot, master = await stage.loop(boat, "--start-each-message")
    master.send(signal.SIGINT)
    assert await master.end() == 130
    assert "Traceback" not in master.err
    await stage.nothing_left("hub")
    assert not list(stage.runs.iterdir())
    assert robot.order == ["/bm/frame", "/BMresults"] * len(robot.results)


@pytest.mark.process
async def test_services_and_hubs_that_die_are_waited_for(stage, boat):
    hub, robot, master = await stage.loop(boat, "--start-each-message")
    for role in ("subscriber", "publisher", "pcie-app"):  # at whatever it is doing
        (await until(lambda role=role: stage.processes().get(role)))[0].kill()
        await robot.have(len(robot.results) + 2)
    hub.send(signal.SIGKILL)
    await hub.end()
    await robot.lost()
    await stage.hub(int(robot.uri.rsplit(":", 1)[1]))
    await robot.have(len(robot.results) + 2)
    master.send(signal.SIGTERM)
    assert await master.end() == 143
    assert "Traceback" not in master.err


@pytest.mark.process
async def test_the_error_of_a_service_ends_the_run(stage, boat):
    hub, uri = await stage.hub()
    async with Robot(uri) as robot:
        flags = ("--connect-timeout", str(5 * FACTOR), "-d", str(boat), "--uri", uri)
        master = stage.start(*EACH, *flags)
        await master.says(PROGRAMMED)
        await until_subscribed(uri, "/boat/sensors")
        await robot.publish(**READING)
        await until(lambda: not stage.processes().get("subscriber"))
        hub.send(signal.SIGKILL)
        await hub.end()
        # the publisher finds no server, or if it was faster, the next subscriber
        assert await master.end() == 3
        assert re.search(f"error: (publisher|subscriber): .*{uri}", only_error(master))
        await stage.nothing_left()
