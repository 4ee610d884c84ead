"""`master reload` of every kind of machine and of run: written priors, several outputs, boards over TCP, replicas of cells.

robot ──▶ hub ──▶ master and its children ──▶ boards, its own or others'   ◀── master reload, or SIGKILL in the midst of it
"""

import asyncio
import json
import shutil
import signal

import numpy as np
import pytest
import websockets

from machines.posterior import joint_posterior
from posteriors.posterior import read_posterior
from tests.integration import test_prior, test_replicas
from tests.integration.conftest import PATIENCE, READING, Robot, status_of
from tests.integration.test_reload import LOOP, looping, other_boat, regenerate, reload_, until
from toolchain.deployment import load_deployment

__all__ = ["other_boat"]  # a fixture


async def run_of(stage, deployment, message):
    """A hub, a robot that publishes a message, a master, and its first results."""
    _, uri = await stage.hub()
    robot = Robot(uri)
    await robot.connect()
    await robot.keep_publishing(rate=40, **message)
    environment = {"BM_RUN_DIRECTORY": str(stage.where)}
    master = stage.start(*LOOP, "-d", str(deployment), "--uri", uri, environment=environment)
    await robot.have(3)
    return robot, master


def by_generation(robot):
    """The results, and under which deployment each was computed."""
    published = [frame for frame in robot.frames if frame["status"][0]["level"] == 0]
    for frame, result in zip(published, robot.results, strict=False):
        values = {pair["key"]: pair["value"] for pair in frame["status"][0]["values"]}
        yield int(values["generation"]), int(values["number"]), result


async def test_a_written_prior(stage, tmp_path, monkeypatch):
    written = ("--prior-mode", "written", "--prior-path", "belief")
    before = test_prior.built(tmp_path / "before", select=False, options=written)
    monkeypatch.setattr(test_prior, "HEARD", test_prior.HEARD[:, [1, 3, 0, 2]])
    after = test_prior.built(tmp_path / "after", select=False, options=written)
    heard = {1: test_prior.HEARD[1]}
    monkeypatch.undo()
    heard[0] = test_prior.HEARD[1]
    belief = np.array([4, 2, 1, 1])
    robot, master = await run_of(stage, before, {"heard": 1, "belief": belief.tolist()})
    async with robot:
        reloading = reload_(stage, stage.where, "-d", str(after))
        assert await reloading.end() == 0, reloading.err + master.err
        await have_of(robot, 1)
        found = list(by_generation(robot))
    assert {generation for generation, _, _ in found} == {0, 1}
    for generation, _, result in found:
        joint = belief * heard[generation]
        assert result["data"] == pytest.approx((joint / joint.sum()).tolist(), abs=0.02)


async def have_of(robot, generation, count=3):
    """Wait for results of a generation: those of the one before may still be on their way."""

    async def have():
        return sum(each == generation for each, _, _ in by_generation(robot)) >= count

    await until(have)


async def test_replicas_of_cells(stage, tmp_path):
    options = ("--sensor-mode", "cell", "--replicas", "3", "--partitions", "2")
    folders = [
        test_replicas.built(tmp_path / "before", *options),
        test_replicas.built(tmp_path / "after", *options, "--target-count", "100"),
    ]
    text = (tmp_path / "after" / "model.py").read_text()
    (tmp_path / "after" / "model.py").write_text(text.replace("default_rng(3)", "default_rng(4)"))
    regenerate("memories", folders[1], "--model", str(tmp_path / "after"))
    deployments = [load_deployment(folder) for folder in folders]
    message = test_replicas.message_of(deployments[0], 2)
    robot, master = await run_of(stage, folders[0], message)
    async with robot:
        reloading = reload_(stage, stage.where, "-d", str(folders[1]))
        assert await reloading.end() == 0, reloading.err + master.err
        await have_of(robot, 1)
        found = list(by_generation(robot))
    assert {generation for generation, _, _ in found} == {0, 1}
    for generation, number, result in (*found[:2], *found[-2:]):
        exact = [
            joint_posterior(
                [np.array(board[0], np.uint32) for board in of_replica], [board[1] for board in of_replica]
            )
            for of_replica in test_replicas.wanted(deployments[generation], message, number)
        ]
        posterior = read_posterior(result, 0)
        assert posterior.probabilities == tuple(np.concatenate(exact).tolist())
        assert posterior.replicas == 3


async def test_several_outputs(stage, boat, other_boat, tmp_path):
    folders = [tmp_path / "before", tmp_path / "after"]
    for folder, made in zip(folders, (boat, other_boat), strict=True):
        shutil.copytree(made, folder)
        with (folder / "deployment.toml").open("a") as file:
            file.write('\n[[output]]\ntopic = "/second"\n')
        regenerate("deployment", folder)
    _, robot, master, runs = await looping(stage, folders[0], witness=folders)
    second = []
    async with websockets.connect(robot.uri, open_timeout=PATIENCE) as listener:
        await listener.send(json.dumps({"op": "subscribe", "topic": "/second"}))
        reloading = reload_(stage, runs, "-d", str(folders[1]))
        assert await reloading.end() == 0, reloading.err + master.err
        refused = reload_(stage, runs, "-d", str(boat))
        assert await refused.end() == 2
        assert "[[output]]" in refused.err
        await have_of(robot, 1)
        await robot.stop_publishing()
        while len(second) < 5 or second != robot.results[-len(second) :]:
            second.append(json.loads(await asyncio.wait_for(listener.recv(), PATIENCE))["msg"])
    assert set(robot.generations()) == {0, 1}


async def test_boards_over_tcp(stage, boat, other_boat):
    ports = [stage.place() for _ in range(4)]  # each with the next one, for programming
    boards = []
    for at, port in enumerate(ports):
        boards.append(stage.start("board", "--listen", f"tcp://127.0.0.1:{port}", "--index", str(at)))
    for board in boards:
        await board.says("listens")
    endpoints = ",".join(f"tcp://127.0.0.1:{port}" for port in ports)
    folders = boat, other_boat, boat
    _, robot, master, runs = await looping(stage, boat, "--boards", endpoints, witness=folders)
    for generation in (1, 2):
        reloading = reload_(stage, runs, "-d", str(folders[generation]))
        assert await reloading.end() == 0, reloading.err + master.err
        await have_of(robot, generation)
    assert sorted(robot.generations()) == [0, 1, 2]
    master.send(signal.SIGINT)
    assert await master.end() == 130
    # they hold the last image, which a master of another deployment takes for somebody else's
    refused = stage.start(
        "master", "--once", "-d", str(other_boat), "--uri", robot.uri, "--boards", endpoints
    )
    assert await refused.end() == 2
    again = stage.start("master", "--once", "-d", str(boat), "--uri", robot.uri, "--boards", endpoints)
    assert await again.end() == 0, again.err


@pytest.mark.parametrize("flags", [(), ("--fused",)], ids=["processes", "fused"])
async def test_a_master_that_is_killed_in_a_reload_leaves_nothing(stage, boat, other_boat, flags):
    _, robot, master, runs = await looping(stage, boat, *flags, witness=(boat, other_boat))
    images = [board.image_hash for board in load_deployment(other_boat, images=False).boards]
    boards = stage.boards()
    await robot.stop_publishing()  # no frame may wait for the board that stops now
    boards[3].suspend()
    reloading = reload_(stage, runs, "-d", str(other_boat))

    async def half_way():
        return (await status_of(runs, "board1"))["boards"][0]["image"] == images[1]

    await until(half_way)
    master.send(signal.SIGKILL)
    assert await reloading.end() == 6
    boards[3].resume()
    await stage.nothing_left("hub")
    assert not list(runs.iterdir())
    await robot.keep_publishing(rate=40, **READING)
    environment = {"BM_RUN_DIRECTORY": str(runs)}
    again = stage.start(
        *LOOP, *flags, "-d", str(boat), "--uri", robot.uri, "--count", "3", environment=environment
    )
    assert await again.end() == 0, again.err
