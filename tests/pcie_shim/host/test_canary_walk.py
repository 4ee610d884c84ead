"""Canaries: they show every bit of a table that can change a count, and do not change the frames of a user."""

import dataclasses

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from machines.bm1 import BM1Machine
from machines.kernel import BM1Kernel, make_kernel
from machines.parameters import RngKind, SensorMode
from pcie_shim.board.emulated_board import with_flipped_bit
from pcie_shim.errors import FrameInputError
from pcie_shim.host.canary_reach import Reach, reach
from pcie_shim.host.canary_walk import CanaryWalk
from pcie_shim.host.frame import BoardResult, FrameInput
from pcie_shim.host.mini_cluster import MiniCluster
from tests.pcie_shim.boards import endpoints_of, image, images, machine, opened
from tests.pcie_shim.host.test_mini_cluster import StartBoard, frame, outcome

MAX_CYCLES = 1 << 10


def result(kernel: BM1Kernel, walk: CanaryWalk, number: int) -> BoardResult:
    kernel.start(walk.start(number, 0))
    several = kernel.machine.parameters.replicas > 1
    return BoardResult(
        words=kernel.counts.astype("<u4").tobytes(),
        cycles=kernel.cycles,
        reason=kernel.reason,
        replica_cycles=kernel.replica_cycles if several else (),
        replica_reasons=kernel.replica_reasons if several else (),
    )


def finds(walk: CanaryWalk, damaged: BM1Machine) -> bool:
    kernel = make_kernel(damaged)
    return any(walk.differing_boards(at, [result(kernel, walk, at)]) for at in range(len(walk)))


def compare_every_flip(built: BM1Machine) -> Reach:
    """Compare the computed reach of a walk with what it finds, for the flip of every single bit."""
    walk = CanaryWalk([image(built)])
    assert not finds(walk, built)
    found = reach(walk, built, 0, MAX_CYCLES)
    for column, shown in enumerate(found.shown):
        for place in np.ndindex(shown.shape):
            assert finds(walk, with_flipped_bit(built, column, *place)) == shown[place], (column, place)
    return found


@pytest.mark.thorough
@settings(max_examples=12, deadline=None, phases=(Phase.explicit, Phase.generate))
@given(
    st.integers(0, 2**16),
    st.fixed_dictionaries(
        {
            "lines": st.integers(1, 3),
            "sensor_bits": st.lists(st.integers(1, 2), max_size=2),
            "prior_bits": st.integers(0, 1),
            "rng_banks": st.sampled_from([1, 4, 16]),
            "counter_bits": st.sampled_from([6, 8, 16]),
            "prob_bits": st.sampled_from([3, 4]),
            "sensor_mode": st.sampled_from([SensorMode.COLUMN, SensorMode.CELL]),
            "replicas": st.integers(1, 2),
            "zeros": st.sampled_from([0.0, 0.3]),
        }
    ),
)
def test_a_walk_finds_the_predicted_flips(seed: int, options: dict) -> None:
    compare_every_flip(machine(seed, **options))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"zeros": 0.4},
        {"counter_bits": 16},
        {"prior_bits": 2, "prob_bits": 6},
        {"prior_mode": "written"},
        {"sensor_mode": "cell", "replicas": 2},
    ],
    ids=str,
)
def test_no_bit_of_a_usual_machine_is_out_of_reach(options: dict) -> None:
    built = machine(3, lines=4, sensor_bits=(1, 2), **options)
    found = reach(CanaryWalk([image(built)]), built, 0, MAX_CYCLES)
    assert found.flips > 100
    assert found.unseen == []


def test_every_address_of_every_column_is_in_every_turn() -> None:
    built = machine(sensor_bits=(2, 3), prior_bits=1)
    walk = CanaryWalk([image(built)])
    for turn in range(walk.turns):
        own = range(turn * walk.steps, (turn + 1) * walk.steps)
        inputs = [walk.canary(number) for number in own]
        assert {each.addresses[0] for each in inputs} == set(range(4))
        assert {each.addresses[1] for each in inputs} == set(range(8))
        assert {each.prior_address for each in inputs} == {0, 1}
    assert len(walk) == walk.turns * (2 + 3 + 7)


def test_machines_whose_counts_depend_on_their_history_are_refused() -> None:
    with pytest.raises(FrameInputError) as caught:
        CanaryWalk([image(machine(rng_reset="free"))])
    assert caught.value.exit_code == 2


def run_with_canaries(cluster: MiniCluster, walk: CanaryWalk, frames: list[FrameInput]) -> list[object]:
    """Run frames with all canaries of a turn between two of them."""
    outputs = []
    for each in frames:
        for number in range(walk.steps):
            assert not walk.differing_boards(number, cluster.run(walk.canary(number)).boards)
        outputs.append(outcome(cluster.run(each)))
    return outputs


@pytest.mark.thorough
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"prior_bits": 2},
        {"prior_mode": "written"},
        {"replicas": 2},
        {"sensor_mode": "cell"},
        {"sensor_mode": "threshold"},
        {"sensor_mode": "cell", "replicas": 2, "prior_mode": "written"},
        {"rng": RngKind.TABLE},
        {"shared": False},
    ],
    ids=str,
)
@pytest.mark.parametrize("lines", [(3,), (3, 2)], ids=["one board", "two boards"])
def test_frames_are_the_same_with_and_without_canaries(options: dict, lines: tuple[int, ...]) -> None:
    mode = options.get("sensor_mode", "column")
    parts = images(40, lines, sensor_bits=(8, 8) if mode == "threshold" else (1, 2), **options)
    random = np.random.default_rng(5)
    parameters = parts[0].machine.parameters
    whole = dataclasses.replace(parameters, lines=sum(lines))
    frames = []
    for bank in range(6):
        inputs: object = tuple(int(random.integers(0, 1 << bits)) for bits in parameters.sensor_bits)
        if mode != "column" or parameters.replicas > 1:
            tops = [(1 << bits) - 1 for bits in parameters.sensor_bits]
            inputs = random.integers(0, min(tops), whole.input_shape)
        written = options.get("prior_mode") == "written" and bank % 2
        frames.append(
            FrameInput(
                addresses=inputs,
                bank=bank,
                prior_address=bank % parameters.prior_addresses,
                prior_codes=random.integers(1, 256, whole.lines).astype(np.uint16) if written else None,
                target_count=40,
                max_cycles=(300, 3000)[bank % 2],
                stop=("slices", "own")[bank % 3 == 0],
            )
        )
    with opened(parts) as cluster:
        without = [outcome(cluster.run(each)) for each in frames]
        assert run_with_canaries(cluster, CanaryWalk(parts), frames) == without


@pytest.mark.parametrize("kind", ["flip-table", "flip-counter"])
def test_a_running_board_with_a_flipped_bit_is_named(start_board: StartBoard, kind: str) -> None:
    parts = images(70, (3, 2), zeros=0.0)
    walk = CanaryWalk(parts)
    boards = [
        start_board(index=0),
        start_board(index=1, misbehave=f"{kind}:1{':1' if kind[5] == 't' else ''}"),
    ]
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        cluster.run(frame())
        found = {
            each
            for number in range(len(walk))
            for each in walk.differing_boards(number, cluster.run(walk.canary(number)).boards)
        }
    assert found == {1}
