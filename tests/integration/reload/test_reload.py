"""`master reload`: a run switches to another deployment, and no frame mixes the two.

robot ──▶ hub ──▶ master, subscriber, publisher, pcie-app, boards   ◀── master reload
 └─ keeps what it sent, by stamp, and compares every result with what boards in this process count
"""

import shutil
import signal
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from pcie_shim.programming_file import read_image
from services.sockets.control_socket import ReloadOrder, control_socket, give_order
from services.sockets.records import LossReason
from tests.integration.conftest import (
    LOOP,
    READING,
    ROOT,
    Robot,
    build,
    build_boat,
    endpoints_in,
    only_error,
    stamp_of,
    status_of,
    toolchain,
    until,
)
from tests.patience import PROCESS_PATIENCE
from toolchain.analysis.accuracy.emulation import EmulatedBoards
from toolchain.deployment import load_deployment
from toolchain.deployment.address import to_address

pytestmark = pytest.mark.thorough


@cache
def boards_of(_hash, folder, _bank):
    """The boards of deployments in this process, cached by hash and bank, because folders change."""
    deployment = load_deployment(folder)
    images = [read_image(deployment.image_path(board)) for board in range(len(deployment.boards))]
    machine = deployment.machine
    return EmulatedBoards(
        [image.machine for image in images],
        target_count=machine.target_count,
        max_cycles=machine.max_cycles,
        stop=machine.stop,
    )


@cache
def counted(hash_, folder, addresses, bank):
    """The posterior that a deployment's boards count."""
    return boards_of(hash_, folder, bank).run(addresses, 0, bank).posterior


class Witness(Robot):
    """A robot that knows what it sent, and so what must come back."""

    def __init__(self, uri, *folders):
        super().__init__(uri)
        self.sent = {}
        self._deployments = [load_deployment(folder) for folder in folders]

    async def publish(self, **values):
        at = len(self.sent)
        values |= {"D1": 68 + at % 5, "D2": 48 + at % 3}
        stamp_ns = await super().publish(**values)
        self.sent[stamp_ns] = values
        return stamp_ns

    def generations(self):
        """Return the number of results of each generation, after comparing each with that generation bit for bit."""
        found = Counter()
        numbers = []
        published = [frame for frame in self.frames if frame["status"][0]["level"] == 0]
        # the last frame may have come without its result yet
        for frame, result in zip(published, self.results, strict=False):
            values = {pair["key"]: pair["value"] for pair in frame["status"][0]["values"]}
            number, generation = int(values["number"]), int(values["generation"])
            reading = self.sent[stamp_of(frame)]
            deployment = self._deployments[generation]
            addresses = tuple(to_address(each, reading[each.name]) for each in deployment.variables)
            bank = number % deployment.machine.rng_banks
            expected = counted(deployment.hash, deployment.directory, addresses, bank)
            assert result["data"] == expected.tolist(), f"frame {number}, generation {generation}"
            found[generation] += 1
            numbers.append(number)
        assert numbers == sorted(set(numbers))
        return found


async def looping(stage, boat, *options, witness, rate=40):
    """A hub, a witness that publishes, a master in --loop, and its first results."""
    return await stage.loop(boat, *options, robot=lambda uri: Witness(uri, *witness), rate=rate)


async def reload_(stage, *options, code=0, runs=None):
    """Reload, and wait for the command's end."""
    reloading = start_reload(stage, *options, runs=runs)
    assert await reloading.end() == code, reloading.err
    return reloading


def start_reload(stage, *options, runs=None):
    return stage.start("master", "reload", "--directory", str(runs or stage.runs), *options)


async def order(stage, folder):
    """Send the order of `master reload`, without a separate process."""
    return await give_order(control_socket(stage.runs), ReloadOrder(str(folder)), timeout=PROCESS_PATIENCE)


def pids(stage):
    return {name: {each.pid for each in found} for name, found in stage.processes().items()}


@pytest.mark.parametrize(
    ("options", "victim"),
    [((), "pcie-app"), (("--fused", "--queue", "all"), "board")],
    ids=["processes", "fused"],
)
async def test_every_frame_is_of_one_deployment(stage, boat, other_boat, options, victim):
    folders = boat, other_boat, boat, other_boat, boat
    _, robot, master = await looping(stage, boat, *options, witness=folders, rate=80)
    runs = stage.runs
    before = pids(stage)
    for generation in (1, 2, 3):
        assert str(folders[generation]) in await order(stage, folders[generation])
        await robot.have(len(robot.results) + 10)
    assert sorted(robot.generations()) == [0, 1, 2, 3]
    assert pids(stage) == before
    status = await status_of(runs, "master")
    assert (status["generation"], status["folder"]) == (3, str(other_boat))
    hashes = {
        (await status_of(runs, name))["deployment"]
        for name in ("master", "subscriber", "publisher", "pcie-app")
    }
    assert hashes == {load_deployment(other_boat, images=False).hash}
    # nothing is lost without a word: what was received is published, waits, or is counted
    await robot.stop_publishing()

    async def all_accounted_for():
        frames = (await status_of(runs, "master"))["frames"]
        accounted = frames["completed"] + sum(frames["lost"].values())
        # the losses of a subscriber outside the master were never received here
        return frames["received"] == accounted if options else frames["received"] <= accounted

    await until(all_accounted_for)
    # no frame may wait for the board that stops now
    await a_death_while_boards_are_programmed(stage, robot, boat, victim)
    assert sorted(robot.generations()) == [0, 1, 2, 3, 4]
    master.send(signal.SIGKILL)
    await stage.nothing_left("hub")


async def a_death_while_boards_are_programmed(stage, robot, folder, victim):
    """The reload fails, the run goes on with what it had, and the next reload is well."""
    boards, runs = stage.boards(), stage.runs
    images = [board.image_hash for board in load_deployment(folder, images=False).boards]
    generation = (await status_of(runs, "master"))["generation"]
    endpoint = (await status_of(runs, "pcie-app"))["boards"][2]["endpoint"]
    programmed_at = endpoint.removeprefix("unix:").replace(".sock", ".program.sock")
    dies = boards[2] if victim == "board" else stage.processes()["pcie-app"][0]
    boards[2].suspend()
    reloading = start_reload(stage, "-d", str(folder))

    async def half_way():
        # board 1 has its new image, and somebody waits for board 2 to take its own
        before_it = (await status_of(runs, "board1"))["boards"][0]["image"] == images[1]
        sockets = Path("/proc/net/unix").read_text().split()
        return before_it and sockets.count(programmed_at) > 1

    await until(half_way)
    dies.kill()
    if victim != "board":
        boards[2].resume()
    assert await reloading.end() in {5, 6}, reloading.out
    assert victim.removesuffix("-app") in reloading.err.lower()
    before = len(robot.results)
    await robot.keep_publishing(rate=40, **READING)
    await robot.have(before + 5)
    assert max(robot.generations()) == generation
    # the old images are back when the command has answered, or when pcie-app is: no frame fails for that
    assert LossReason.FAILED not in (await status_of(runs, "master"))["frames"]["lost"]
    await order(stage, folder)
    await robot.have(len(robot.results) + 5)


def unfit(boat, where):
    """Deployments of another size, with other topics, and with a damaged image."""
    larger = build_boat(where / "larger", cells=12)
    elsewhere, damaged = where / "elsewhere", where / "damaged"
    shutil.copytree(boat, elsewhere)
    toolchain("regenerate", "deployment", elsewhere, "--topic", "/other/topic", "--output", "/other/results")
    shutil.copytree(boat, damaged)
    image = damaged / "boards/board2.bm"
    data = bytearray(image.read_bytes())
    data[len(data) // 2] ^= 1
    image.write_bytes(data)
    return larger, elsewhere, damaged


async def test_what_is_refused_changes_nothing(stage, boat, other_boat, tmp_path):
    larger, elsewhere, damaged = unfit(boat, tmp_path)
    hub, robot, master = await looping(stage, boat, witness=(boat, other_boat, boat))
    for folder, *named in (
        (larger, "[machine] lines", "64", "144"),
        (elsewhere, "[[source]] 0 topic", "/boat/sensors", "/other/topic", "[[output]] 0 topic"),
        (damaged, f"{damaged}/boards/board2.bm"),
        (tmp_path, str(tmp_path)),
    ):
        reloading = await reload_(stage, "-d", str(folder), code=2)
        assert reloading.err.count("\n") == 1
        assert [each for each in named if each not in reloading.err] == []
        assert await stage.status("master", lambda status: status["generation"] == 0)
    await robot.have(len(robot.results) + 5)
    assert set(robot.generations()) == {0}
    await reload_(stage, "-d", str(other_boat))
    await robot.have(len(robot.results) + 5)
    assert set(robot.generations()) == {0, 1}
    # rosbridge may be away
    hub.send(signal.SIGKILL)
    await hub.end()
    await stage.status("publisher", lambda status: not status["ready"])
    await order(stage, boat)
    before = len(robot.results)
    await stage.hub(int(robot.uri.rsplit(":", 1)[1]))
    await robot.have(before + 5)
    assert set(robot.generations()) == {0, 1, 2}
    master.send(signal.SIGINT)
    assert await master.end() == 130
    await stage.nothing_left("hub")


async def test_a_corrected_table_in_the_same_folder(stage, boat, tmp_path):
    folder, before = tmp_path / "folder", tmp_path / "before"
    model = tmp_path / "boat"
    shutil.copytree(ROOT / "casestudies/boat", model)
    size = ("--set", "width=8", "--set", "height=8")
    build(model, folder, "--partitions", "4", *size)
    shutil.copytree(folder, before)
    _, robot, master = await looping(stage, folder, witness=(before, folder))
    source = model / "model.py"
    source.write_text(source.read_text().replace("sigma=BEARING_SIGMA", "sigma=2 * BEARING_SIGMA"))
    toolchain("regenerate", "memories", folder, "--model", str(model), *size)
    assert load_deployment(folder).hash != load_deployment(before).hash
    # a service that dies now still finds the deployment that is in force
    stage.processes()["subscriber"][0].kill()
    await stage.restarted("subscriber")
    await robot.have(len(robot.results) + 5)
    robot._deployments[1] = load_deployment(folder)
    await reload_(stage)
    await robot.have(len(robot.results) + 5)
    # and after it, the new one
    for victim in ("pcie-app", "subscriber"):
        stage.processes()[victim][0].kill()
        await stage.restarted(victim, 1 + (victim == "subscriber"))
        await robot.have(len(robot.results) + 5)
    stage.boards()[-1].kill()
    await stage.board_is_back()
    await robot.have(len(robot.results) + 5)
    found = robot.generations()
    assert set(found) == {0, 1}
    assert min(found.values()) >= 5
    master.send(signal.SIGINT)
    assert await master.end() == 130
    await stage.nothing_left("hub")


async def test_services_that_the_master_did_not_start_are_used_and_left_running(stage, boat, other_boat):
    _, uri = await stage.hub()
    sockets, boards = stage.start_boards()
    stage.start("pcie-app", "-d", str(boat), "--boards", boards, "--listen", f"unix:{sockets}/pcie-app.sock")
    for role in ("subscriber", "publisher"):
        stage.start(role, "-d", str(boat), "--uri", uri, "--listen", f"unix:{sockets}/{role}.sock")
    robot = Witness(uri, boat, other_boat)
    stage.robots.append(robot)
    await robot.connect()
    await robot.keep_publishing(**READING)
    environment = {"BM_RUN_DIRECTORY": str(sockets)}
    started = (*LOOP, "--connect", str(sockets))
    master = stage.start(*started, "-d", str(boat), environment=environment)
    await robot.have(3)
    await reload_(stage, "-d", str(other_boat), runs=sockets)
    await robot.have(len(robot.results) + 5)
    assert set(robot.generations()) == {0, 1}
    master.send(signal.SIGTERM)
    assert await master.end() == 143
    # the next master finds them with what they were given
    refused = stage.start(*started, "-d", str(boat))
    assert await refused.end() == 2
    last = stage.start(*started, "-d", str(other_boat), "--count", "2")
    assert await last.end() == 0, last.err
    await stage.nothing_left("hub", "board", "pcie-app", "subscriber", "publisher")
    refused = stage.start(*started, "--fused", "-d", str(other_boat))
    assert await refused.end() == 2
    assert "--fused" in only_error(refused)


async def test_there_must_be_a_run(stage, boat, tmp_path):
    orders = tmp_path / "orders"
    orders.mkdir()
    environment = {"BM_RUN_DIRECTORY": str(tmp_path), "BM_CONTROL_DIRECTORY": str(orders)}
    reloading = stage.start("master", "reload", environment=environment)
    assert await reloading.end() == 2
    _, uri = await stage.hub()
    # the run waits for missing boards, and has not begun
    options = ("--boards", endpoints_in(tmp_path), "--peer-timeout", str(PROCESS_PATIENCE))
    master = stage.start("master", "--loop", "-d", str(boat), "--uri", uri, *options, environment=environment)
    control = orders / "master.control.sock"
    await until(control.exists)
    assert control.stat().st_mode & 0o777 == 0o600
    assert not (tmp_path / control.name).exists()
    reloading = stage.start("master", "reload", environment=environment)
    assert await reloading.end() == 6
    master.send(signal.SIGINT)
    assert await master.end() == 130
    assert not control.exists()
