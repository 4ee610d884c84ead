"""Status and metrics of a run, and its posteriors in the command `listen`."""

import asyncio
import itertools
import json
import re
import signal
import socket
import urllib.request

import numpy as np
import pytest

from tests.integration.conftest import status_of, until
from tests.patience import PROCESS_PATIENCE

PROCESSES = {"hub", "master", "subscriber", "publisher", "pcie-app", "board0", "board1", "board2", "board3"}


async def ask(stage, *options):
    """`status` as a user calls it: exit code, and what it printed."""
    asked = stage.start("python", "-m", "services.commands.status", *options)
    return await asked.end(), asked.out + asked.err


async def ask_until(stage, wanted):
    """The exit code, the stack's status once `wanted` says so, and its processes by name."""

    async def asked():
        code, printed = await ask(stage, "--json")
        stack = json.loads(printed) if code in {0, 6} else None
        return (code, stack) if stack is not None and wanted(stack) else None

    code, stack = await until(asked)
    return code, stack, {process["name"]: process for process in stack["processes"]}


@pytest.mark.process
async def test_the_status_of_a_run(stage, boat):
    """Results flow; then readings are missing; then the master is gone."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        metrics = free.getsockname()[1]
    environment = {"BM_RUN_DIRECTORY": "", "BM_READY_TIMEOUT": "4"}
    _, robot, master = await stage.loop(boat, "--fused", "--metrics", str(metrics), environment=environment)
    code, stack, processes = await ask_until(stage, lambda stack: stack["ready"])
    assert (code, processes.keys()) == (0, PROCESSES)
    (connection,) = processes["publisher"]["connections"]
    assert connection == {"uri": robot.uri, "state": "connected", "reconnections": 0}
    boards = processes["pcie-app"]["boards"]
    assert [(board["index"], board["state"]) for board in boards] == [(at, "programmed") for at in range(4)]
    assert len({board["image"] for board in boards}) == 4
    stages = {each["stage"]: each for each in processes["master"]["stages"]}
    assert 0 < stages["compute"]["p50_ms"] < stages["frame"]["p50_ms"] <= stages["frame"]["p99_ms"]

    def scraped():
        with urllib.request.urlopen(
            f"http://127.0.0.1:{metrics}/metrics", timeout=PROCESS_PATIENCE
        ) as answer:
            return answer.read().decode()

    assert {"rosbayes_ready{", "rosbayes_stage_seconds_sum{"} <= set(
        re.findall(r"^\w+{", await asyncio.to_thread(scraped), re.MULTILINE)
    )
    robot.stop_publishing()
    code, stack, _ = await ask_until(
        stage, lambda stack: any(why.startswith("master: no result for") for why in stack["why"])
    )
    assert code == 6
    assert any(re.match(r"subscriber: no complete reading .* /boat/sensors", why) for why in stack["why"])
    asked = stage.start(
        "python", "-m", "services.ready", "master", environment={"BM_RUN_DIRECTORY": stack["directory"]}
    )
    assert await asked.end() == 1
    assert asked.out.startswith("master: no result for")
    master.send(signal.SIGKILL)
    await stage.nothing_left("hub")
    assert (await ask(stage))[0] == 2


@pytest.mark.process
async def test_a_paused_simulation_is_ready_until_its_clock_goes_on(stage, boat):
    _, robot, _ = await stage.loop(boat, "--use-sim-time", environment={"BM_READY_TIMEOUT": "1"})
    robot.stop_publishing()
    paused = await stage.status("master", lambda status: status["frames"]["last_age_s"] > 2)
    assert paused["ready"]
    seconds = itertools.count()

    async def is_late():
        clock = {"clock": {"sec": next(seconds), "nanosec": 0}}
        await robot._socket.send(json.dumps({"op": "publish", "topic": "/clock", "msg": clock}))
        status = await status_of(stage.runs, "subscriber")
        return not status["ready"] and re.match("no complete reading for .*/boat/sensors", status["why"])

    assert (await status_of(stage.runs, "subscriber"))["ready"]
    await until(is_late)


@pytest.mark.process
async def test_listen_prints_and_saves_until_it_is_ended(stage, boat, tmp_path):
    _, robot, _ = await stage.loop(boat, "--fused")
    counting = stage.start("listen", "-d", str(boat), "--uri", robot.uri, "--count", "4")
    saving = stage.start("listen", "--uri", robot.uri, "--json", "--save", str(tmp_path / "out.npz"))
    assert await counting.end() == 0
    lines = [line for line in counting.out.splitlines() if not line.startswith("frame -:")]
    pattern = r"frame \d+: x [-\d.]+, y [-\d.]+ with [\d.]+; mean x [-\d.]+, y [-\d.]+; \d+ cycles; [\d.]+ ms"
    assert [line for line in lines if not re.fullmatch(pattern, line)] == []
    await until(lambda: saving.out.count("\n") > 3)
    saving.send(signal.SIGINT)
    assert await saving.end() == 130
    printed = [json.loads(line) for line in saving.out.splitlines()]
    with np.load(tmp_path / "out.npz") as saved:
        assert saved["frame"].tolist() == [-1 if each["frame"] is None else each["frame"] for each in printed]
        assert saved["probabilities"].reshape(len(printed), -1).tolist() == [
            each["probabilities"] for each in printed
        ]
