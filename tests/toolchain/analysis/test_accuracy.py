"""Accuracy beside hand-computed figures, the emulation of boards, and readings drawn or recorded."""

import numpy as np
import pytest

from machines.bm1 import BM1Machine, Start, StopReason, first_slice
from machines.parameters import BM1Parameters
from machines.reference import ReferenceBM1
from tests.toolchain.builders import corridor, machine_of
from toolchain.analysis.accuracy import _difference, _line_probabilities, bootstrap, measure, share_of_frames
from toolchain.analysis.emulation import EmulatedBoards, joined
from toolchain.analysis.readings import MISSING, Readings, model_of_codes, recorded_readings, sample_readings
from toolchain.building.machine import split
from toolchain.cluster import in_this_process
from toolchain.deployment import Stop
from toolchain.errors import BuildError, ModelError
from toolchain.learning.recording import reading_columns
from toolchain.models.model import Known, Model, dimension, exact_posterior

MACHINE = machine_of(corridor(13, sigma=0.7))


def test_boards_split_and_joined():
    parts = split(MACHINE, 4)
    assert [part.parameters.lines for part in parts] == [4, 3, 3, 3]
    assert joined(parts) == MACHINE


@pytest.mark.parametrize("address", [(9, 0), (9, 1), (20, 1)])
def test_slices_are_those_of_the_reference(address):
    target, limit = 200, 3000
    parts = split(MACHINE, 3)
    boards = EmulatedBoards(parts, target_count=target, max_cycles=limit, stop=Stop.SLICES)
    for bank in (0, 3):
        ran = boards.run(address, 0, bank)
        kernels = [ReferenceBM1(part) for part in parts]
        end = first_slice(target)
        for kernel in kernels:
            kernel.start(
                Start(addresses=address, target_count=target, max_cycles=limit, bank=bank, run_until=end)
            )
        while not any(kernel.reason is StopReason.OVERFLOW for kernel in kernels):
            left = [kernel for kernel in kernels if kernel.reason is StopReason.SLICE]
            if not left:
                break
            end *= 2
            for kernel in left:
                kernel.resume(end if end < limit else 0)
        assert ran.cycles == tuple(kernel.cycles for kernel in kernels)
        assert ran.reasons == tuple(kernel.reason for kernel in kernels)
        assert [counts.tolist() for counts in ran.counts] == [kernel.counts.tolist() for kernel in kernels]


def test_own_stops_each_board_by_itself():
    boards = EmulatedBoards(split(MACHINE, 2), target_count=255, max_cycles=100_000, stop=Stop.OWN)
    ran = boards.run((2, 1), 0, 0)
    assert ran.reasons[0] is StopReason.OVERFLOW
    assert ran.cycles[0] != ran.cycles[1]
    assert ran.length == max(ran.cycles)
    posterior = ran.posterior
    assert posterior is not None
    assert posterior.sum() == pytest.approx(1)


def test_a_run_of_a_given_length_is_stopped_by_no_counter():
    boards = EmulatedBoards([MACHINE], target_count=3, max_cycles=100, stop=Stop.OWN)
    ran = boards.run_for((2, 1), 0, 0, 5000)
    assert ran.cycles == (5000,)
    assert ran.counts[0].max() > 255


def test_limits_that_make_no_sense():
    with pytest.raises(BuildError, match="256"):
        EmulatedBoards([MACHINE], target_count=256, max_cycles=10, stop=Stop.OWN)
    with pytest.raises(BuildError, match="max_cycles"):
        EmulatedBoards([MACHINE], target_count=5, max_cycles=0, stop=Stop.OWN)


def test_readings_are_drawn_as_the_model_says():
    model = corridor(4, sigma=2.0)
    readings = sample_readings(model, 20_000, seed=3)
    for column, known in enumerate(model.known):
        expected = known.table @ model.prior_distribution
        found = np.bincount(readings.addresses[:, column], minlength=known.values) / len(readings)
        assert np.abs(found - expected).max() < 5 * np.sqrt(0.25 / 20_000)
    assert (readings.prior_addresses == MISSING).all()
    again = sample_readings(model, 20_000, seed=3)
    assert np.array_equal(again.addresses, readings.addresses)
    assert not np.array_equal(sample_readings(model, 20_000, seed=4).addresses, readings.addresses)


def test_readings_depend_on_the_selected_prior():
    readings = sample_readings(corridor(select=True), 3000, seed=1)
    near, far = (readings.addresses[readings.prior_addresses == row, 0].mean() for row in (0, 1))
    assert near + 5 < far


def test_a_frame_for_the_model_and_for_the_machine():
    model = corridor(select=True, missing=True)
    machine = machine_of(model)
    readings = sample_readings(model, 2, seed=1)
    readings.addresses[1, 0] = MISSING
    readings.prior_addresses[1] = MISSING
    assert readings.of_model(1) == ((None, int(readings.addresses[1, 1])), None)
    addresses, row = readings.of_machine(1, machine)
    assert addresses == (machine.parameters.missing_address(1), int(readings.addresses[1, 1]))
    assert row == 3  # the top one: the prior without a selection
    assert readings.of_machine(0, machine)[1] == readings.of_model(0)[1]


@pytest.mark.parametrize("select", [False, True])
def test_a_model_is_found_again_in_its_codes(select):
    model = corridor(select=select)
    found = model_of_codes("again", model.searched, model.variables, machine_of(model, prob_bits=16))
    for ours, theirs in zip(found.known, model.known, strict=True):
        assert 0.5 * np.abs(ours.table - theirs.table).sum(axis=0).max() < 0.06
    assert np.abs(found.prior_distribution - model.prior_distribution).max() < 1e-3
    assert (found.prior_select is not None) == select


def test_recorded_readings(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(
        "t,range_m,loud\n" + "".join(f"{i},{i / 2},{i % 2}\n" for i in range(15)) + "15,,1\n16,1,7\n"
    )
    model = corridor()
    readings = recorded_readings(path, model.variables, ["range=range_m", "loud=loud"], frames=100)
    assert readings.addresses.tolist() == [[i, i % 2] for i in range(15)]
    assert readings.source.startswith("15 of 17 rows of run.csv, ")
    assert "range" in readings.source
    spread = recorded_readings(path, model.variables, ["range=range_m", "loud=loud"], frames=3)
    assert spread.addresses[:, 0].tolist() == [0, 8]  # the last row is refused
    alone = recorded_readings(path, corridor(missing=True).variables, ["range=range_m"], frames=100)
    assert (alone.addresses[:, 1] == MISSING).all()
    path.write_text("range,loud\n9,7\n")
    with pytest.raises(ModelError, match="loud: 7"):
        recorded_readings(path, model.variables, [], frames=5)


def test_patterns_of_columns():
    names = ["range_1", "range_12", "bearing_1"]
    assert reading_columns(names, []) == {name: name for name in names}
    assert reading_columns(names, ["range_*=r*_m", "bearing_1=b"]) == {
        "range_1": "r1_m",
        "range_12": "r12_m",
        "bearing_1": "b",
    }


def boards_of(machine, count=1, *, target=255, limit=2**15, stop=Stop.SLICES):
    return EmulatedBoards(split(machine, count), target_count=target, max_cycles=limit, stop=stop)


def test_a_difference_by_hand():
    ours, theirs = np.array([0.5, 0.5, 0.0]), np.array([0.25, 0.5, 0.25])
    variation, divergence, same = _difference(ours, theirs)
    assert variation == pytest.approx(0.25)
    assert divergence == pytest.approx(0.5)  # 0.5 log2 2
    assert same  # of two equally probable lines one is theirs
    assert not _difference(np.array([0.6, 0.4, 0.0]), theirs)[2]


def test_how_often_codes_let_lines_count():
    machine = BM1Machine(
        BM1Parameters(lines=3, sensor_bits=(1,)),
        np.array([[255, 128, 64]], dtype=np.uint16),
        (np.array([[255, 128, 0], [255, 255, 255]], dtype=np.uint16),),
    )
    chances = _line_probabilities(boards_of(machine, 1), (0,), 0, None)
    assert chances / chances.sum() == pytest.approx([0.8, 0.2, 0])
    zero = BM1Machine(machine.parameters, np.zeros((1, 3), dtype=np.uint16), machine.tables)
    assert not _line_probabilities(boards_of(zero, 1), (0,), 0, None).any()


def test_a_machine_beside_its_model():
    model = corridor(24, sigma=1.5)
    readings = sample_readings(model, 40, seed=1)
    coarse, fine = (
        measure(boards_of(machine_of(model, prob_bits=bits), 2), readings, model, banks=2) for bits in (3, 10)
    )
    for accuracy in (coarse, fine):
        assert accuracy.machine is not None
        assert accuracy.quantising is not None
        assert accuracy.sampling is not None
        low, value, high = (
            getattr(accuracy.machine.total_variation, name) for name in ("low", "value", "high")
        )
        assert low < value < high
        # The distance of the machine is at most the sum of both losses.
        assert value <= accuracy.quantising.total_variation.value + accuracy.sampling.total_variation.value
    assert coarse.quantising.total_variation.value > 10 * fine.quantising.total_variation.value
    assert fine.machine.total_variation.value == pytest.approx(fine.sampling.total_variation.value, rel=0.1)
    assert 0 < fine.machine.total_variation.value < 0.1
    assert fine.overflow == 1
    assert fine.cycles.median.value % 256 == 0 or fine.cycles.median.value < 512


def test_z_scores_are_near_1_with_fresh_bits_and_larger_without():
    model = corridor(40, sigma=2.0)
    readings = sample_readings(model, 100, seed=1)
    fresh, stale = (
        measure(boards_of(machine_of(model, steps_per_clock=steps, rng_banks=256)), readings, None, banks=1)
        for steps in (8, 1)
    )
    assert fresh.z.rms.value == pytest.approx(1, abs=0.12)
    assert fresh.z.rms.low < 1 < fresh.z.rms.high
    assert stale.z.rms.low > 1.1
    assert fresh.z.draws == 100
    few = measure(boards_of(machine_of(model, rng_banks=4)), readings, None, banks=1)
    assert few.z.draws == 4
    assert fresh.machine is None
    assert fresh.quantising is None


def test_frames_without_a_posterior_are_counted():
    table = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
    model = Model(
        name="torn",
        searched=(dimension("s", size=3),),
        known=(Known(name="A", table=table), Known(name="B", table=table)),
        prior=np.array([0.4999, 0.4999, 0.0002]),
    )
    # A = 0 and B = 1 is possible on the last line alone, whose prior is code 0.
    readings = Readings("by hand", np.array([[0, 0], [0, 1]]), np.array([-1, -1]))
    accuracy = measure(boards_of(machine_of(model)), readings, model, banks=3)
    assert accuracy.impossible == 0.5
    assert accuracy.without == 0.5
    for difference in (accuracy.machine, accuracy.quantising, accuracy.sampling):
        # the second frame counts as 1 and as wrong
        alone = difference.alone
        assert alone.total_variation.value < 0.05
        assert difference.total_variation.value == pytest.approx((alone.total_variation.value + 1) / 2)
        assert (alone.map_agreement.value, difference.map_agreement.value) == (1, 0.5)
    lost = measure(boards_of(machine_of(model)), Readings("", readings.addresses[1:], np.array([-1])), model)
    assert (lost.machine.total_variation.value, lost.machine.alone) == (1, None)


def test_a_selected_prior_and_missing_readings():
    model = corridor(16, sigma=1.5, select=True, missing=True)
    readings = sample_readings(model, 30, seed=1)
    readings.addresses[::3, 0] = MISSING
    readings.prior_addresses[::5] = MISSING
    accuracy = measure(
        boards_of(machine_of(model, prob_bits=12, counter_bits=12), 2, target=2000), readings, model
    )
    assert accuracy.frames == 30
    assert accuracy.quantising.total_variation.value < 0.003
    assert accuracy.machine.total_variation.value < 0.03


def test_readings_that_the_model_finds_impossible():
    table = np.array([[1.0, 1.0], [0.0, 0.0]])
    model = Model(name="sure", searched=(dimension("s", size=2),), known=(Known(name="A", table=table),))
    recorded = Readings("by hand", np.array([[0], [1]]), np.array([-1, -1]))
    accuracy = measure(boards_of(machine_of(model)), recorded, model)
    assert (accuracy.frames, accuracy.without) == (2, 0.5)
    assert accuracy.machine.total_variation.value == 0.5
    readings = Readings("by hand", np.array([[1]]), np.array([-1]))
    with pytest.raises(ModelError, match="by hand"):
        measure(boards_of(machine_of(model)), readings, model)
    assert exact_posterior(model, [0]) == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("replicas", [1, 3])
def test_the_order_of_the_work_changes_nothing(replicas):
    model = corridor(20, sigma=1.5)
    boards, readings = (
        boards_of(machine_of(model, prob_bits=5), target=20),
        sample_readings(model, 30, seed=1),
    )

    def backwards(job, numbers, keep):
        in_this_process(job, numbers[::-1], keep)

    forwards, other = (
        measure(boards, readings, model, replicas=replicas, run=run) for run in (in_this_process, backwards)
    )
    assert other == forwards


def test_intervals():
    values = np.random.default_rng(1).normal(10, 2, (400, 1))
    interval = bootstrap(values, np.mean)
    assert interval.low < interval.value < interval.high
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * 2 / 20, rel=0.25)
    all_agree = share_of_frames(1.0, 20)
    assert all_agree.high == 1
    assert all_agree.low == pytest.approx(0.839, abs=0.001)  # Wilson's, from a table
