"""A running stack that filters a recorded sequence.

robot ─40 readings─▶ hub ─▶ master (predict) ─▶ two boards ─▶ posterior ─▶ hub ─▶ robot
                              ▲                                  │
                              └──────────────────────────────────┘
Every published posterior is that of kernels in the test, whose predictions are computed here.
"""

import itertools
import json
import shlex

import numpy as np
import pytest

from machines.encode import encode_probability
from machines.kind import FrameInput
from machines.posterior import joint_posterior
from pcie_shim.programming_file import read_image
from tests.integration.conftest import LOOP, build, inferred, until_subscribed
from tests.pcie_shim.boards import expected
from toolchain.deployment import load_deployment

CELLS = 12
NETWORK = """
variable before {{ type discrete [ {n} ] {{ {names} }}; }}
variable place {{ type discrete [ {n} ] {{ {names} }}; }}
variable door {{ type discrete [ 2 ] {{ yes, no }}; }}
variable light {{ type discrete [ 3 ] {{ dark, dim, bright }}; }}
probability ( before ) {{ table {start}; }}
probability ( place | before ) {{ {moves} }}
probability ( door | place ) {{ {doors} }}
probability ( light | place ) {{ {lights} }}
"""
START = np.eye(CELLS)[0]
MOVES = 0.7 * np.roll(np.eye(CELLS), 1, axis=1) + 0.25 * np.eye(CELLS) + 0.05 / CELLS
DOOR = np.where(np.isin(np.arange(CELLS), [0, 3, 7]), 0.9, 0.15)
DOORS = np.array([DOOR, 1 - DOOR])
LIGHTS = np.array([[0.7, 0.2, 0.1], [0.2, 0.6, 0.2], [0.1, 0.2, 0.7]])[np.arange(CELLS) // 4].T
STATES = ("yes", "no"), ("dark", "dim", "bright")


def rows(table):
    """A table as text, a row for each place."""
    return " ".join(f"(s{at}) {', '.join(map(str, row))};" for at, row in enumerate(table))


def walk(frames):
    """Readings of a robot that walks around, some of them missing, and in one frame all."""
    random = np.random.default_rng(3)
    place, found = 0, []
    for frame in range(frames):
        place = random.choice(CELLS, p=MOVES[place])
        chosen = [int(random.choice(len(table), p=table[:, place])) for table in (DOORS, LIGHTS)]
        missing = (frame % 5 == 4, frame % 7 == 6)
        found.append([None if gone else at for gone, at in zip(missing, chosen, strict=True)])
    return found


@pytest.mark.process
@pytest.mark.parametrize("options", [(), ("--fused",)])
async def test_the_stack_filters_as_a_reference_does(stage, robot, tmp_path, options):
    names = ", ".join(f"s{at}" for at in range(CELLS))
    start = ", ".join(map(str, START))
    text = NETWORK.format(
        n=CELLS, names=names, start=start, moves=rows(MOVES), doors=rows(DOORS.T), lights=rows(LIGHTS.T)
    )
    (tmp_path / "ring.bif").write_text(text)
    question = shlex.split("--searched place --previous before --known door,light --on-missing missing")
    folder = build(tmp_path / "ring.bif", tmp_path / "ring", *question, "--partitions", "2", "--queue", "all")
    readings = walk(40)
    master = stage.start(*LOOP, "-d", folder, "--uri", robot.uri, "--count", str(len(readings)), *options)
    await until_subscribed(robot.uri, "/boat/sensors")
    for reading in readings:
        names = (None if at is None else states[at] for states, at in zip(STATES, reading, strict=True))
        await robot.publish(**dict(zip(("door", "light"), names, strict=True)))
    await robot.have(len(readings))
    assert await master.end() == 0, master.err
    assert master.err.count("the filter begins with its start distribution") == 1
    deployment = load_deployment(folder)
    parts = [read_image(deployment.image_path(board)) for board in range(2)]
    machine = deployment.machine
    belief = exact = START
    variation = []
    for number, (reading, result) in enumerate(zip(readings, robot.results, strict=True), start=1):
        prior = np.einsum("b,bs->s", belief, MOVES)
        codes = encode_probability(prior / prior.max(), machine.prob_bits)
        frame = FrameInput(
            addresses=tuple(reading),
            prior_codes=np.where((prior > 0) & (codes == 0), 1, codes).astype(np.uint16),
            target_count=machine.target_count,
            max_cycles=machine.max_cycles,
            bank=number % machine.rng_banks,
        )
        counts, cycles, _ = zip(*expected(parts, frame), strict=True)
        belief = joint_posterior([np.array(each, np.uint32) for each in counts], cycles)
        assert result["data"] == belief.tolist(), f"frame {number}"
        exact = exact @ MOVES
        for table, at in zip((DOORS, LIGHTS), reading, strict=True):
            exact = exact if at is None else exact * table[at]
        exact = exact / exact.sum()
        variation.append(0.5 * abs(belief - exact).sum())
    assert np.mean(variation) < 0.06
    if not options:
        names = [
            [None if at is None else states[at] for states, at in zip(STATES, each, strict=True)]
            for each in readings
        ]
        assert inferred(folder, names, tmp_path) == [result["data"] for result in robot.results]
    numbers = [json.dumps(result["data"]) for result in robot.results]
    assert all(one != other for one, other in itertools.pairwise(numbers))
