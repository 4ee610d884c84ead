"""Replicas and readings per line from a message to the topics of results, to the bit (thesis 4.4).

message ──▶ FrameAssembler ──▶ DeployedBoards ──▶ boards in threads ──▶ ResultTopics ──▶ FakeRosbridge
"""

import contextlib
import json

import numpy as np
import pytest

from machines.kind import FrameInput
from machines.parameters import SensorMode
from machines.posterior import joint_posterior
from pcie_shim.endpoint import parse_endpoint
from posteriors.frame_report import read_frame_report
from posteriors.posterior import read_posterior
from services.boards.deployed import DeployedBoards, images_of
from services.boards.frames import result_record
from services.errors import InputLineError
from services.pipeline.frames import FrameAssembler
from services.pipeline.result_topics import ResultTopics
from services.pipes.pcie_app import compute_lines
from services.settings import Settings
from services.sockets.records import FrameRequest, Outcome, Publish
from tests.fake_rosbridge import FakeRosbridge
from tests.pcie_shim.boards import ServedBoard, expected_of_replicas
from tests.toolchain.running import build_model
from toolchain.deployment import load_deployment
from toolchain.deployment.address_array import to_addresses
from toolchain.models.model import Known, Model, PriorSelect, dimension

LINES = 6


def built(folder, **options):
    random = np.random.default_rng(3)
    tables = [random.dirichlet(np.full(5, 0.7), LINES).T for _ in range(2)]
    model = Model(
        name="disparity",
        searched=(dimension("disparity", size=LINES),),
        known=(
            Known(name="left", table=tables[0], path="costs.left"),
            Known(name="right", table=tables[1], path="costs.right", on_missing="missing"),
        ),
        prior_select=PriorSelect(name="light", table=random.dirichlet(np.ones(LINES), 2)),
    )
    build_model(model, folder / "built", **options)
    return load_deployment(folder / "built")


@contextlib.contextmanager
def opened(folder, deployment):
    """The deployment's boards, in threads."""
    where = [f"unix:{folder}/b{at}" for at in range(len(deployment.boards))]
    with contextlib.ExitStack() as stack:
        for at, each in enumerate(where):
            stack.callback(ServedBoard(each, index=at).stop)
        yield stack.enter_context(
            contextlib.closing(
                DeployedBoards(Settings(), deployment, [parse_endpoint(each) for each in where])
            )
        )


def wanted(deployment, message, bank):
    """Each replica's counts, cycles and reason on every board, by machines that know nothing of each other."""
    machine = deployment.machine
    rows = []
    for variable, values in zip(deployment.sensors, message["costs"].values(), strict=True):
        found = to_addresses(deployment, variable, values)
        rows.append(np.reshape(found, (machine.replicas, -1)))
    inputs = np.stack(rows, axis=1)
    inputs = inputs if inputs.shape[2] == LINES else inputs[:, :, 0]
    light = message["light"]
    frame = FrameInput(
        addresses=inputs if machine.replicas > 1 else inputs[0],
        prior_address=tuple(light) if machine.replicas > 1 else light,
        target_count=machine.target_count,
        max_cycles=machine.max_cycles,
        bank=bank,
        stop=machine.stop,
    )
    return expected_of_replicas(images_of(deployment), frame)


def message_of(deployment, seed):
    random = np.random.default_rng(seed)
    count = int(np.prod(deployment.reading_shape(deployment.variables[0])))
    if deployment.machine.sensor_mode == "threshold":
        left, right = random.uniform(0.1, 3, (2, count)).round(3).tolist()
    else:
        left, right = random.integers(0, 5, (2, count)).tolist()
        right[-count // 3 :] = [None] * (count // 3)  # the last replica's second filter says nothing
    lights = random.integers(0, 2, deployment.machine.replicas).tolist()
    return {"costs": {"left": left, "right": right}, "light": lights if len(lights) > 1 else lights[0]}


@pytest.mark.parametrize(
    "options",
    [
        {"replicas": 3, "stop": "own", "partitions": 2},
        {"replicas": 3, "sensor_mode": SensorMode.CELL, "partitions": 2},
        {"sensor_mode": SensorMode.THRESHOLD},
    ],
    ids=["replicas, each board by itself", "replicas of cells on two boards", "thresholds"],
)
async def test_what_is_published_is_what_the_machines_count(tmp_path_factory, options):
    folder = tmp_path_factory.mktemp("b")
    deployment = built(folder, **options)
    replicas = deployment.machine.replicas
    async with FakeRosbridge() as fake:
        topics = ResultTopics(Settings(uri=fake.uri), deployment)
        with opened(folder, deployment) as boards:
            boards.open()
            async with topics.opened():
                for number in (1, 2, 3):
                    message = message_of(deployment, number)
                    (reading,) = FrameAssembler(deployment).take(0, message, 5, 6)
                    output = boards.run(FrameRequest(number, reading.addresses, number))
                    publish = Publish(result_record(number, output), 0, 0, 0, 0, 0)
                    assert topics.publish_now(publish).outcome is Outcome.PUBLISHED
                    report = await fake.wait_for_op("publish", topic="/bm/frame", count=number)
                    result = await fake.wait_for_op("publish", topic="/BMresults", count=number)
                    report, posterior = read_frame_report(report["msg"], 0), read_posterior(result["msg"], 0)
                    of_replicas = wanted(deployment, message, number)
                    exact = [
                        joint_posterior(
                            [np.array(part[0], np.uint32) for part in each], [part[1] for part in each]
                        )
                        for each in of_replicas
                    ]
                    assert posterior.probabilities == tuple(np.concatenate(exact).tolist())
                    assert posterior.replicas == replicas
                    assert posterior.labels == (*(("replica",) if replicas > 1 else ()), "disparity")
                    for at, board in enumerate(report.boards):
                        of_board = [each[at] for each in of_replicas]
                        assert board.counts_total == sum(sum(counts) for counts, _, _ in of_board)
                        assert board.cycles == max(cycles for _, cycles, _ in of_board)
                        if replicas > 1:
                            assert board.replica_cycles == tuple(cycles for _, cycles, _ in of_board)
                            words = [each.upper().replace(" ", "_") for each in board.replica_stopped]
                            assert words == [reason.name for _, _, reason in of_board]


def test_pcie_app_alone_computes_lines(tmp_path_factory, capsys, monkeypatch):
    folder = tmp_path_factory.mktemp("b")
    deployment = built(folder, replicas=3)
    line = json.dumps({"addresses": [[1, 2, 3], [0, 0, -1], [0, 1, 0]]}) + "\n"
    (folder / "lines").write_text(line + "\n" + line.replace("[1, 2, 3]", "[1, 2]"))
    with opened(folder, deployment) as boards, (folder / "lines").open() as lines:
        monkeypatch.setattr("sys.stdin", lines)
        with pytest.raises(InputLineError, match="line 3 of standard input"):
            compute_lines(boards, deployment.machine.rng_banks)
    (board,) = json.loads(capsys.readouterr().out)["boards"]
    message = {"costs": {"left": [1, 2, 3], "right": [0, 0, None]}, "light": [0, 1, 0]}
    of_replicas = wanted(deployment, message, 1)
    assert board["counts"] == [count for each in of_replicas for count in each[0][0]]
    assert board["replica_cycles"] == [each[0][1] for each in of_replicas]
