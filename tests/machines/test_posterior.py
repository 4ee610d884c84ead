"""Posteriors from counts, over boards, and in one call."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.bm1 import BM1Machine
from machines.encode import decode_code
from machines.errors import MachineError, NoPosteriorError, StartError
from machines.parameters import BM1Parameters, PriorMode, SensorMode
from machines.posterior import joint_posterior, posterior


def counts(*boards):
    return [np.array(board, dtype=np.uint32) for board in boards]


@pytest.mark.parametrize(
    ("boards", "cycles", "expected"),
    [
        (([1, 3, 0],), (100,), [0.25, 0.75, 0]),
        # rates of 0.1 and 0.3 on the first board, of 0.1 on the second: not one half for each board
        (([10, 30], [10, 0]), (100, 100), [0.2, 0.6, 0.2, 0]),
        (([10, 30], [100, 0]), (100, 1000), [0.2, 0.6, 0.2, 0]),
        (([0, 0], [2, 2]), (0, 64), [0, 0, 0.5, 0.5]),
        (([0, 0], [0]), (0, 64), None),
        (([0],), (0,), None),
        ((), (), None),
    ],
)
def test_counts_of_boards_are_weighed_by_their_cycles(boards, cycles, expected):
    joint = joint_posterior(counts(*boards), cycles)
    assert joint is None if expected is None else joint == pytest.approx(expected)


def test_boards_and_cycles_must_belong_together():
    with pytest.raises(MachineError):
        joint_posterior(counts([1], [1]), [3])
    with pytest.raises(MachineError):
        joint_posterior(counts([1], [1]), [3, 0])


@given(
    st.lists(st.lists(st.integers(0, 255), min_size=1, max_size=20), min_size=1, max_size=5),
    st.integers(1, 2**40),
)
def test_partitions_that_stop_together_are_the_whole(boards, cycles):
    joint = joint_posterior(counts(*boards), [cycles] * len(boards))
    whole = joint_posterior(counts([count for board in boards for count in board]), [cycles])
    if joint is None:
        assert whole is None
    else:
        assert joint == pytest.approx(whole, abs=1e-15)
        assert joint.sum() == pytest.approx(1)


@pytest.fixture
def machine():
    """Three lines, two sensors of three values."""
    return BM1Machine(
        BM1Parameters(lines=3, sensor_bits=(2, 2)),
        np.array([[255, 128, 64]]),
        (
            np.array([[255, 128, 32], [0, 0, 0], [16, 0, 0], [255, 255, 255]]),
            np.array([[64, 128, 255], [255, 10, 0], [0, 200, 100], [255, 255, 255]]),
        ),
    )


@pytest.mark.parametrize("readings", [(0, 0), (None, None), (None, 0), (0, None), (0, 1), (2, 1)])
def test_readings_give_the_product(machine, readings):
    exact = decode_code(machine.prior[0], 8)
    for table, reading in zip(machine.tables, readings, strict=True):
        exact = exact * decode_code(table[-1 if reading is None else reading], 8)
    exact /= exact.sum()
    # 16 banks of 255 counts at the best line: 1.6 % of it, of which three times that is far.
    mean = np.mean([posterior(machine, readings, bank=bank) for bank in range(16)], axis=0)
    assert mean == pytest.approx(exact, abs=0.03)
    assert mean[exact == 0].tolist() == [0] * int((exact == 0).sum())


def test_readings_that_no_line_allows_have_no_posterior(machine):
    with pytest.raises(NoPosteriorError) as none:
        posterior(machine, [1, 0])
    assert none.value.exit_code == 4


def test_too_few_cycles_have_no_posterior(machine):
    with pytest.raises(NoPosteriorError):
        posterior(machine, [2, 1], max_cycles=1)


def test_a_posterior_can_become_the_next_prior(machine):
    written = BM1Machine(
        BM1Parameters(lines=3, sensor_bits=(2, 2), prior_mode=PriorMode.WRITTEN),
        machine.prior,
        machine.tables,
    )
    codes = np.array([0, 255, 0], dtype=np.uint16)
    assert posterior(written, [0, 0], prior_codes=codes).tolist() == [0, 1, 0]
    assert posterior(written, [0, 0]).tolist() == posterior(machine, [0, 0]).tolist()


def of(machine, **parameters):
    return replace(machine, parameters=replace(machine.parameters, **parameters))


def test_replicas_give_a_leading_axis(machine):
    readings = [(0, 0), (None, 1), (2, None), (None, None)]
    rows = posterior(of(machine, replicas=4), readings, bank=3)
    assert rows.shape == (4, 3)
    for row, reading in zip(rows, readings, strict=True):
        assert row.tolist() == posterior(machine, reading, bank=3).tolist()


def test_replicas_may_be_one_array_and_have_priors_of_their_own(machine):
    two = of(
        BM1Machine(
            replace(machine.parameters, prior_bits=1),
            np.vstack([machine.prior, [[0, 255, 0]]]),
            machine.tables,
        ),
        replicas=2,
    )
    rows = posterior(two, np.array([[0, 0], [0, 0]]), prior_address=(0, 1))
    assert rows[0].tolist() == posterior(machine, (0, 0)).tolist()
    assert rows[1].tolist() == [0, 1, 0]


def test_a_replica_without_a_posterior_is_zeros_unless_none_has_one(machine):
    rows = posterior(of(machine, replicas=2), [(1, 0), (0, 0)])
    assert rows[0].tolist() == [0, 0, 0]
    assert rows[1].sum() == pytest.approx(1)
    with pytest.raises(NoPosteriorError):
        posterior(of(machine, replicas=2), [(1, 0), (1, 1)])


def test_a_cell_sensor_takes_one_value_per_line(machine):
    cells = of(machine, sensor_mode=SensorMode.CELL)
    # line 1 reads other rows than lines 0 and 2
    mixed = BM1Machine(
        machine.parameters,
        machine.prior,
        tuple(np.vstack([[[table[0, 0], table[2, 1], table[0, 2]]], table[1:]]) for table in machine.tables),
    )
    assert posterior(cells, [[0, 2, 0], [0, 2, 0]]).tolist() == posterior(mixed, [0, 0]).tolist()
    assert posterior(cells, [[0, 0, 0], None]).tolist() == posterior(machine, [0, None]).tolist()
    both = posterior(of(cells, replicas=2), [[[0, 2, 0], [0, 2, 0]], [np.array([0, 0, 0]), None]])
    assert both[0].tolist() == posterior(mixed, [0, 0]).tolist()
    assert both[1].tolist() == posterior(machine, [0, None]).tolist()


def test_a_threshold_is_the_code_itself(machine):
    bare = BM1Machine(
        BM1Parameters(lines=3, sensor_bits=(8, 8), sensor_mode=SensorMode.THRESHOLD), machine.prior, ()
    )
    given = [[255, 128, 32], [64, 128, 255]]
    assert posterior(bare, given).tolist() == posterior(machine, [0, 0]).tolist()
    assert posterior(bare, [given[0], None]).tolist() == posterior(machine, [0, None]).tolist()


CELL = {"sensor_mode": SensorMode.CELL}


@pytest.mark.parametrize(
    ("change", "readings", "options"),
    [
        ({}, 3, {}),
        ({}, [0], {}),
        ({}, [0, 3], {}),  # the address of a missing reading, which is None here
        ({}, [0, 0.5], {}),
        ({}, [0, 0], {"target_count": 256}),
        ({"replicas": 2}, [(0, 0)], {}),
        ({"replicas": 2}, [(0, 0), (0,)], {}),
        ({"replicas": 2}, [(0, 0), (0, 3)], {}),
        (CELL, [0, 0], {}),
        (CELL, [[0, 0, 0], [0, [1], 2]], {}),
        (CELL, [[0, 0, 0], [0, 3, 0]], {}),
    ],
)
def test_readings_that_do_not_fit_are_refused(machine, change, readings, options):
    with pytest.raises(StartError):
        posterior(of(machine, **change), readings, **options)
