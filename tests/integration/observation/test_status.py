"""The status of a real stack: readiness, deaths, and numbers of results."""

import asyncio
import json
import os
import re
import signal
import socket
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.integration.conftest import Robot, until
from tests.patience import PROCESS_PATIENCE

SERVICES = {"master", "subscriber", "publisher", "pcie-app", "board0", "board1", "board2", "board3"}


async def ask(stage, *options):
    """`status` as a user calls it: exit code, and what it printed."""
    asked = stage.start("python", "-m", "services.commands.status", *options)
    return await asked.end(), asked.out + asked.err


async def ask_until(stage, wanted):
    """The stack's status once `wanted` says so, and the exit code with it."""

    async def asked():
        code, printed = await ask(stage, "--json")
        stack = json.loads(printed) if code in {0, 6} else None
        return (code, stack) if stack is not None and wanted(stack) else None

    return await until(asked)


def by_name(stack):
    return {process["name"]: process for process in stack["processes"]}


async def ready_exit(stage, name, directory):
    asked = stage.start("python", "-m", "services.ready", name, environment={"BM_RUN_DIRECTORY": directory})
    return await asked.end(), asked.out.strip()


@pytest.mark.process
async def test_the_status_of_a_run(stage, boat):
    _, _, master = await stage.loop(boat, "--fused", environment={"BM_RUN_DIRECTORY": ""})
    code, stack = await ask_until(stage, lambda stack: stack["ready"])
    assert code == 0
    assert set(by_name(stack)) == SERVICES | {"hub"}
    master.send(signal.SIGKILL)
    await stage.nothing_left("hub")
    assert (await ask(stage))[0] == 2


@pytest.mark.thorough
async def test_the_status_of_a_stack(stage, boat):
    """Ready, waiting for readings, with a process that does not answer, after deaths, and ended."""
    _, uri = await stage.hub()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    async with Robot(uri) as robot:
        await robot.keep_publishing()
        master = stage.start(
            *("master", "--loop", "-d", str(boat), "--uri", uri, "--log-level", "debug"),
            *("--metrics", str(port)),
            environment={"BM_READY_TIMEOUT": "4"},
        )
        await robot.have(3)
        await is_ready(stage, uri)
        robot._tasks.pop().cancel()
        await is_measured(stage, port)
        stack = await waits_for_readings(stage, robot)
        # one frame through all processes, as grep finds it
        lines = [line for line in master.err.splitlines() if "frame=3 " in line]
        found = {re.search(r"process=(\S+)", line)[1] for line in lines}
        assert found == {"master", "subscriber", "pcie-app", "publisher"}
        assert len(lines) == 4
        await robot.keep_publishing()
        await shows_the_silent_and_the_dead(stage, by_name(stack)["subscriber"]["pid"])
        master.send(signal.SIGTERM)
        assert await master.end() == 143
        assert (await ask(stage))[0] == 2
        await stage.nothing_left("hub")


async def is_measured(stage, port):
    """The master serves its metrics, and knows the latency of each stage."""
    _, stack = await ask_until(stage, lambda stack: by_name(stack)["master"]["stages"])

    def scraped():
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PROCESS_PATIENCE) as answer:
            return answer.read().decode()

    families = {each.name for each in text_string_to_metric_families(await asyncio.to_thread(scraped))}
    assert families > {"rosbayes_ready", "rosbayes_stage_seconds"}
    assert all(by_name(stack)[name]["cpu_s"] > 0 for name in SERVICES)
    stages = {each["stage"]: each for each in by_name(stack)["master"]["stages"]}
    assert 0 < stages["compute"]["p50_ms"] < stages["frame"]["p50_ms"] <= stages["frame"]["p99_ms"]


async def is_ready(stage, uri):
    code, stack = await ask_until(stage, lambda stack: stack["ready"])
    assert code == 0
    assert set(by_name(stack)) == SERVICES | {"hub"}

    async def flows():
        return await ready_exit(stage, "master", stack["directory"]) == (0, "master: results flow")

    await until(flows)
    assert by_name(stack)["publisher"]["connections"] == [
        {"uri": uri, "state": "connected", "reconnections": 0}
    ]
    boards = by_name(stack)["pcie-app"]["boards"]
    assert [board["index"] for board in boards] == [0, 1, 2, 3]
    assert {board["state"] for board in boards} == {"programmed"}
    assert len({board["image"] for board in boards}) == 4

    async def shown():
        code, screen = await ask(stage)
        return code == 0 and screen

    screen = await until(shown)
    assert "all 9 processes are ready" in screen
    assert boards[2]["image"][:12] in screen


async def waits_for_readings(stage, robot):
    code, stack = await ask_until(
        stage, lambda stack: any(why.startswith("master: no result for") for why in stack["why"])
    )
    assert code == 6
    assert any(re.match(r"subscriber: no complete reading .* /boat/sensors", why) for why in stack["why"]), (
        stack["why"]
    )
    published = by_name(stack)["publisher"]["frames"]
    assert published["completed"] == len(robot.results) > 3
    assert published["last_number"] == by_name(stack)["pcie-app"]["frames"]["last_number"]
    code, why = await ready_exit(stage, "master", stack["directory"])
    assert code == 1
    assert why.startswith("master: no result for")

    return stack


async def shows_the_silent_and_the_dead(stage, subscriber):
    os.kill(subscriber, signal.SIGSTOP)
    try:
        code, stack = await ask_until(
            stage, lambda stack: [silent["name"] for silent in stack["silent"]] == ["subscriber"]
        )
    finally:
        os.kill(subscriber, signal.SIGCONT)
    assert code == 6

    os.kill(by_name(stack)["board2"]["pid"], signal.SIGKILL)
    os.kill(by_name(stack)["publisher"]["pid"], signal.SIGKILL)

    def shown(stack):
        processes = by_name(stack)
        if not stack["ready"] or len(processes) < len(SERVICES):
            return False
        return processes["board2"]["boards"][0]["restarts"] == 1

    code, stack = await ask_until(stage, shown)
    assert code == 0
    processes = by_name(stack)
    boards = processes["pcie-app"]["boards"]
    assert [board["restarts"] for board in boards] == [0, 0, 1, 0]
    peers = {peer["name"]: peer["restarts"] for peer in processes["master"]["peers"]}
    assert peers == {"subscriber": 0, "publisher": 1, "pcie-app": 0}
