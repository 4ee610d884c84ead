"""`master reload` for every kind of machine and run: written priors, several outputs, boards over TCP, replicas.

robot ──▶ hub ──▶ master and its children ──▶ boards, its own or others'   ◀── master reload, or SIGKILL in the midst of it
"""

import asyncio
import json
import shutil
import signal

import numpy as np
import pytest
import websockets

from tests.integration.conftest import LOOP, READING, build, status_of, toolchain, until
from tests.integration.reload.test_reload import looping, order, reload_, start_reload
from tests.patience import PROCESS_PATIENCE
from toolchain.deployment import load_deployment

pytestmark = pytest.mark.thorough


def by_generation(robot):
    """The results, and under which deployment each was computed."""
    for frame, result in robot.paired:
        values = {pair["key"]: pair["value"] for pair in frame["status"][0]["values"]}
        yield int(values["generation"]), int(values["number"]), result


HEARD = np.array([[0.9, 0.4, 0.4, 0.1], [0.1, 0.6, 0.6, 0.9]])
ROOMS = """
import numpy as np
from toolchain.models.model import Known, Model, dimension

def model():
    heard = Known(name="heard", table=np.array({heard}))
    return Model(name="rooms", searched=(dimension("room", size=4),), known=(heard,))
"""


async def test_a_written_prior(stage, tmp_path):
    options = ("--prob-bits", "14", "--counter-bits", "16", "--target-count", "20000", "--partitions", "2")
    tables = HEARD, HEARD[:, [1, 3, 0, 2]]
    for at, heard in enumerate(tables):
        (tmp_path / f"{at}").mkdir()
        (tmp_path / f"{at}/model.py").write_text(ROOMS.format(heard=heard.tolist()))
        written = ("--prior-mode", "written", "--prior-path", "belief")
        build(tmp_path / f"{at}", tmp_path / f"built{at}", *options, *written)
    belief = np.array([4, 2, 0, 1])
    reading = {"heard": 1, "belief": belief.tolist()}
    _, robot, _ = await stage.loop(tmp_path / "built0", rate=40, reading=reading)
    async with robot:
        await order(stage, tmp_path / "built1")
        await have_of(robot, 1)
        found = list(by_generation(robot))
    assert {generation for generation, _, _ in found} == {0, 1}
    for generation, _, result in found:
        joint = belief * tables[generation][1]
        assert result["data"] == pytest.approx((joint / joint.sum()).tolist(), abs=0.02)


async def have_of(robot, generation, count=3):
    """Wait for results of a generation: those of the one before may still be on their way."""

    await until(lambda: sum(each == generation for each, _, _ in by_generation(robot)) >= count)


async def test_several_outputs(stage, boat, other_boat, tmp_path):
    folders = [tmp_path / "before", tmp_path / "after"]
    for folder, made in zip(folders, (boat, other_boat), strict=True):
        shutil.copytree(made, folder)
        with (folder / "deployment.toml").open("a") as file:
            file.write('\n[[output]]\ntopic = "/second"\n')
        toolchain("regenerate", "deployment", folder)
    _, robot, _ = await looping(stage, folders[0], witness=folders)
    second = []
    async with websockets.connect(robot.uri, open_timeout=PROCESS_PATIENCE) as listener:
        await listener.send(json.dumps({"op": "subscribe", "topic": "/second"}))
        await order(stage, folders[1])
        refused = await reload_(stage, "-d", str(boat), code=2)
        assert "[[output]]" in refused.err
        await have_of(robot, 1)
        await robot.stop_publishing()
        while len(second) < 5 or second != robot.results[-len(second) :]:
            second.append(json.loads(await asyncio.wait_for(listener.recv(), PROCESS_PATIENCE))["msg"])
    assert set(robot.generations()) == {0, 1}


async def test_boards_over_tcp(stage, boat, other_boat):
    ports = [stage.place() for _ in range(4)]  # each with the next one, for programming
    boards = [
        stage.start("board", "--listen", f"tcp://127.0.0.1:{port}", "--index", str(at))
        for at, port in enumerate(ports)
    ]
    for board in boards:
        await board.says("listens")
    endpoints = ",".join(f"tcp://127.0.0.1:{port}" for port in ports)
    folders = boat, other_boat, boat
    _, robot, master = await looping(stage, boat, "--boards", endpoints, witness=folders)
    for generation in (1, 2):
        await order(stage, folders[generation])
        await have_of(robot, generation)
    assert sorted(robot.generations()) == [0, 1, 2]
    master.send(signal.SIGINT)
    assert await master.end() == 130
    # they hold the last image, which a master of another deployment takes for somebody else's
    loader = ("loader", str(other_boat / "boards/board1.bm"), f"tcp://127.0.0.1:{ports[1]}")
    for command, deployment, code in (
        (None, other_boat, 2),
        (None, boat, 0),
        (loader, boat, 2),
    ):
        if command is not None:
            loading = stage.start(*command)
            assert await loading.end() == 0, loading.err
        last = stage.start(
            "master", "--once", "-d", str(deployment), "--uri", robot.uri, "--boards", endpoints
        )
        assert await last.end() == code, last.err
    assert "board 1" in last.err.lower()


@pytest.mark.parametrize("flags", [(), ("--fused",)], ids=["processes", "fused"])
async def test_a_master_that_is_killed_in_a_reload_leaves_nothing(stage, boat, other_boat, flags):
    _, robot, master = await looping(stage, boat, *flags, witness=(boat, other_boat))
    images = [board.image_hash for board in load_deployment(other_boat, images=False).boards]
    boards = stage.boards()
    await robot.stop_publishing()  # no frame may wait for the board that stops now
    boards[3].suspend()
    reloading = start_reload(stage, "-d", str(other_boat))

    async def half_way():
        return (await status_of(stage.runs, "board1"))["boards"][0]["image"] == images[1]

    await until(half_way)
    master.send(signal.SIGKILL)
    assert await reloading.end() == 6
    boards[3].resume()
    await stage.nothing_left("hub")
    assert not list(stage.runs.iterdir())
    await robot.keep_publishing(rate=40, **READING)
    again = stage.start(*LOOP, *flags, "-d", str(boat), "--uri", robot.uri, "--count", "3")
    assert await again.end() == 0, again.err
