"""Replicas and readings per line, end to end: arrays in, as many posteriors out, to the bit (thesis 4.4).

message ──▶ subscriber ──▶ master ──▶ pcie-app ──▶ INPUTS of one or two boards ──▶ R posteriors on the wire
"""

import json
import re
import subprocess
import textwrap

import numpy as np
import pytest

from machines.kind import FrameInput
from machines.posterior import joint_posterior
from pcie_shim.programming_file import read_image
from posteriors.frame_report import read_frame_report
from posteriors.posterior import read_posterior
from tests.integration.conftest import BIN, Robot, build, only_error
from tests.patience import PROCESS_PATIENCE
from tests.pcie_shim.boards import expected_of_replicas
from toolchain.deployment import load_deployment
from toolchain.deployment.address_array import to_addresses

LINES = 6
MODEL = f"""
    import numpy as np
    from toolchain.models.model import Known, Model, PriorSelect, dimension

    def model():
        random = np.random.default_rng(3)
        tables = [random.dirichlet(np.full(5, 0.7), {LINES}).T for _ in range(2)]
        light = random.dirichlet(np.ones({LINES}), 2)
        return Model(
            name="disparity",
            searched=(dimension("disparity", size={LINES}),),
            known=(
                Known(name="left", table=tables[0], path="costs.left"),
                Known(name="right", table=tables[1], path="costs.right", on_missing="missing"),
            ),
            prior_select=PriorSelect(name="light", table=light),
        )
"""


def built(folder, *options):
    folder.mkdir()
    (folder / "model.py").write_text(textwrap.dedent(MODEL))
    return build(folder, folder / "built", *options)


def exact_posteriors(of_replicas):
    """Each replica's posterior, from what its boards counted."""
    return [
        joint_posterior([np.array(board[0], np.uint32) for board in each], [board[1] for board in each])
        for each in of_replicas
    ]


def message_of(deployment, seed):
    """A message for a deployment: flat arrays of what its readings are."""
    random = np.random.default_rng(seed)
    machine = deployment.machine

    def costs(count):
        if machine.sensor_mode == "threshold":
            return random.uniform(0.1, 3, count).round(3).tolist()
        return random.integers(0, 5, count).tolist()

    count = int(np.prod(deployment.reading_shape(deployment.variables[0])))
    lights = random.integers(0, 2, machine.replicas).tolist()
    left, right = costs(count), costs(count)
    if seed % 3 == 2:  # the last replica's second filter says nothing
        each = count // machine.replicas
        right[-each:] = [None] * each
    return {"costs": {"left": left, "right": right}, "light": lights if machine.replicas > 1 else lights[0]}


def inputs_of(deployment, message):
    """The same as the driver takes it."""
    machine = deployment.machine
    rows = []
    for variable, values in zip(
        deployment.sensors, (message["costs"][each] for each in ("left", "right")), strict=True
    ):
        found = to_addresses(deployment, variable, values)
        shape = deployment.reading_shape(variable)
        rows.append(np.reshape(np.full(shape, -1) if found is None else found, (machine.replicas, -1)))
    inputs = np.stack(rows, axis=1)
    lights = message["light"]
    shape = deployment.reading_shape(deployment.sensors[0])
    per_line = shape and shape[-1] == machine.lines
    inputs = inputs if per_line else inputs[:, :, 0]
    return (inputs, tuple(lights)) if machine.replicas > 1 else (inputs[0], lights)


def wanted(deployment, message, number):
    """Each replica's posterior, cycles and reason on every board, by machines that know nothing of each other."""
    machine = deployment.machine
    inputs, light = inputs_of(deployment, message)
    frame = FrameInput(
        addresses=inputs,
        prior_address=light,
        target_count=machine.target_count,
        max_cycles=machine.max_cycles,
        bank=number % machine.rng_banks,
        stop="own" if machine.stop == "own" else "slices",
    )
    images = [read_image(deployment.image_path(at)) for at in range(len(deployment.boards))]
    return expected_of_replicas(images, frame)


@pytest.mark.parametrize(
    ("options", "flags"),
    [
        pytest.param(
            ("--replicas", "3", "--stop", "own", "--partitions", "2"),
            (),
            id="three replicas, each board by itself",
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            ("--sensor-mode", "cell", "--replicas", "3", "--partitions", "2"),
            ("--fused",),
            id="replicas of cells on two boards",
            marks=pytest.mark.process,
        ),
        pytest.param(("--sensor-mode", "threshold"), (), id="thresholds", marks=pytest.mark.thorough),
    ],
)
async def test_what_is_published_is_what_the_machines_count(stage, tmp_path, options, flags):
    deployment = load_deployment(built(tmp_path / "disparity", *options))
    replicas = deployment.machine.replicas
    messages = [message_of(deployment, seed) for seed in (1, 2, 3, 5)]
    _, uri = await stage.hub()
    command = ("master", "--loop", "--queue", "all", *flags, "-d", str(deployment.directory), "--uri", uri)
    master = stage.start(*command)
    async with Robot(uri) as robot:
        await master.says("pcie-app: .* programmed")
        await master.says("publisher: publishing")
        await robot.keep_publishing(**messages[0])
        await robot.have(1)
        await robot.stop_publishing()
        for message in messages:
            frame, result = await robot.answer(await robot.publish(**message))
            report = read_frame_report(frame, 0)
            of_replicas = wanted(deployment, message, report.number)
            exact = exact_posteriors(of_replicas)
            posterior = read_posterior(result, 0)
            assert posterior.probabilities == tuple(np.concatenate(exact).tolist())
            assert posterior.replicas == replicas
            for at, board in enumerate(report.boards):
                assert board.counts_total == sum(sum(each[at][0]) for each in of_replicas)
                assert board.cycles == max(each[at][1] for each in of_replicas)
            if replicas > 1:
                assert posterior.labels == ("replica", "disparity")
                assert posterior.replica(2).probabilities == tuple(exact[2].tolist())
                for at, board in enumerate(report.boards):
                    assert board.replica_cycles == tuple(each[at][1] for each in of_replicas)
                    assert [word.upper().replace(" ", "_") for word in board.replica_stopped] == [
                        each[at][2].name for each in of_replicas
                    ]
    assert "unusable" not in master.err


@pytest.mark.thorough
async def test_an_array_that_does_not_fit_ends_a_run_of_one_frame(stage, tmp_path):
    cells = built(tmp_path / "disparity", "--sensor-mode", "cell")
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing(costs={"left": [9] * 6, "right": [1] * 6}, light=0)
        master = stage.start("master", "--once", "--fused", "-d", str(cells), "--uri", uri)
        assert await master.end() == 4
        assert re.search(r"\bleft: .*\b9\b", only_error(master))


@pytest.mark.thorough
async def test_alone_the_commands_are_a_pipe(stage, tmp_path):
    """`subscriber | pcie-app | publisher`: the same lines as in a run."""
    deployment = load_deployment(built(tmp_path / "disparity", "--replicas", "3"))
    board = stage.start("board", "--listen", f"unix:{tmp_path}/b.sock")
    await board.says("b.sock")
    line = json.dumps({"addresses": [[1, 2, 3], [0, 0, -1], [0, 1, 0]]}) + "\n"
    ran = subprocess.run(
        [BIN / "pcie-app", "-d", deployment.directory, "--boards", f"unix:{tmp_path}/b.sock"],
        input=line + "\n" + line.replace("[1, 2, 3]", "[1, 2]"),
        capture_output=True,
        text=True,
        timeout=PROCESS_PATIENCE,
        check=False,
    )
    first = json.loads(ran.stdout.splitlines()[0])
    message = {"costs": {"left": [1, 2, 3], "right": [0, 0, None]}, "light": [0, 1, 0]}
    of_replicas = wanted(deployment, message, 1)
    assert first["boards"][0]["counts"] == [count for each in of_replicas for count in each[0][0]]
    assert first["boards"][0]["replica_cycles"] == [each[0][1] for each in of_replicas]
    assert ran.returncode == 2
    assert ran.stderr.splitlines()[-1].startswith("error: line 3 of standard input: ")
