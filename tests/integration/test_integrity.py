"""A bit that flips in a running board is found, and the board is used again without a restart.

Robot ──▶ hub ──▶ master ──▶ pcie-app ──▶ four boards, the second of which is damaged
"""

import json
import subprocess

import numpy as np
import pytest

from tests.integration.conftest import BIN, READING, build_boat, only_error, right_posteriors, until
from tests.patience import PROCESS_PATIENCE
from toolchain.deployment import load_deployment
from toolchain.deployment.address import to_address

pytestmark = pytest.mark.thorough

FRAMES = 2000
LATE = "300"
"""Starts of the damaged board before its damage: canaries and some frames."""


def start_boards(stage, misbehave, tcp=False):
    sockets = stage.where / "s"
    sockets.mkdir(mode=0o700)
    endpoints = [
        f"tcp://127.0.0.1:{stage.place()}" if tcp else f"unix:{sockets}/board{at}.sock" for at in range(4)
    ]
    for at, endpoint in enumerate(endpoints):
        wrong = ["--misbehave", misbehave] if at == 1 else []
        stage.start("board", "--listen", endpoint, "--index", str(at), *wrong)
    return ",".join(endpoints)


def number_of(report):
    return int({pair["key"]: pair["value"] for pair in report["status"][0]["values"]}["number"])


@pytest.mark.parametrize(
    ("options", "tcp"), [((), False), (("--fused",), True)], ids=["processes", "fused, tcp"]
)
async def test_a_flipped_bit_is_found_within_the_stated_frames(stage, boat, options, tcp):
    boards = ("--boards", start_boards(stage, f"flip-table:{LATE}:1", tcp))
    rule = ("--integrity", "canary", "--integrity-frames", str(FRAMES))
    _, robot, master = await stage.loop(boat, *boards, *rule, *options, rate=60)
    found = await stage.status("pcie-app", lambda status: status["integrity"]["damaged"] > 0)
    assert [board["damaged"] for board in found["boards"]] == [0, 1, 0, 0]
    await master.says("board 1 gave wrong counts")
    await master.says("board 1 is back, programmed")
    await robot.have(len(robot.results) + 60)
    status = await stage.status("pcie-app", lambda status: status["ready"])
    assert status["integrity"]["damaged"] == 1
    assert (status["integrity"]["kind"], status["integrity"]["frames"]) == ("canary", FRAMES)
    right = right_posteriors(boat)
    wrong = [
        number_of(report)
        for report, result in robot.paired
        if not np.array_equal(result["data"], right[number_of(report) % len(right)])
    ]
    assert len(wrong) <= FRAMES
    last = number_of(robot.paired[-1][0])
    assert not wrong or (wrong[-1] - wrong[0] < FRAMES and last - wrong[-1] >= 50)
    master.process.terminate()
    assert await master.end() == 143


async def test_a_stuck_counter_keeps_its_board_out(stage, boat):
    boards = ("--boards", start_boards(stage, f"flip-counter:{LATE}"))
    rule = ("--integrity", "canary", "--integrity-frames", str(FRAMES))
    _, robot, _ = await stage.loop(boat, *boards, *rule)
    status = await stage.status("pcie-app", lambda status: not status["ready"])
    assert [board["state"] for board in status["boards"]] == ["programmed", "gone", *["programmed"] * 2]
    came = len(robot.results)
    await stage.status("master", lambda status: status["frames"]["lost"].get("failed on a board", 0) >= 20)
    assert len(robot.results) <= came + 1  # one may have been under way


@pytest.mark.parametrize("options", [(), ("--fused",)], ids=["processes", "fused"])
async def test_twice_withholds_a_result_with_a_flipped_count(stage, boat, options):
    boards = ("--boards", start_boards(stage, "flip-counter:60:1"))
    _, robot, master = await stage.loop(boat, *boards, "--integrity", "twice", *options)
    await stage.status("master", lambda status: status["frames"]["lost"] == {"withheld": 1})
    await master.says("disagree on board 1")
    status = await stage.status("pcie-app", lambda status: status["integrity"]["withheld"] == 1)
    assert status["ready"]
    await robot.have(len(robot.results) + 20)
    right = right_posteriors(boat)
    for report, result in robot.paired:
        assert np.array_equal(result["data"], right[number_of(report) % len(right)])


async def test_the_pipe_reprograms_a_damaged_board_and_goes_on(stage, boat):
    boards = start_boards(stage, "flip-table:100:1")
    await until(lambda: len(list((stage.where / "s").glob("*.sock"))) == 8)
    deployment = load_deployment(boat)
    addresses = [to_address(each, READING[each.name]) for each in deployment.variables]
    lines = "\n".join([json.dumps({"addresses": addresses})] * 60)
    command = [BIN / "pcie-app", "-d", boat, "--boards", boards]
    rule = ["--integrity", "canary", "--integrity-frames", "400"]
    ended = subprocess.run(
        [*command, *rule], input=lines, capture_output=True, text=True, timeout=PROCESS_PATIENCE, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("board 1 gave wrong counts") == 1
    plain = subprocess.run(
        command, input=lines, capture_output=True, text=True, timeout=PROCESS_PATIENCE, check=False
    )
    counts = [
        [[board["counts"] for board in json.loads(line)["boards"]] for line in each.stdout.splitlines()]
        for each in (ended, plain)
    ]
    assert len(counts[0]) == 60
    assert counts[0][-20:] == counts[1][-20:]


@pytest.mark.parametrize(
    ("build_options", "rule"),
    [
        (("--rng-reset", "free"), ("canary",)),
        (("--rng-banks", "1"), ("twice",)),
        (("--target-count", "50"), ("twice",)),
    ],
)
async def test_an_unsound_rule_is_refused(stage, tmp_path, build_options, rule):
    folder = build_boat(tmp_path / "d", *build_options, cells=4)
    running = stage.start("master", "--once", "-d", str(folder), "--integrity", *rule)
    assert await running.end() == 2
    assert "integrity = " in only_error(running)
