"""Readings: drawn with the probabilities of the model, or recorded; and a model recovered from codes."""

import numpy as np
import pytest

from tests.toolchain.corridor import corridor, machine_of
from toolchain.analysis.readings import (
    MISSING,
    model_of_codes,
    reading_columns,
    recorded_readings,
    sample_readings,
)
from toolchain.errors import BuildError, ModelError


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


def test_what_a_recording_may_not_be(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("range,loud\n9,7\n")
    variables = corridor().variables
    with pytest.raises(ModelError, match="loud: 7"):
        recorded_readings(path, variables, [], frames=5)
    with pytest.raises(BuildError, match="--frames is 0"):
        recorded_readings(path, variables, [], frames=0)
    with pytest.raises(BuildError, match="--reading sonar"):
        recorded_readings(path, variables, ["sonar=a"], frames=5)


def test_patterns_of_columns():
    names = ["range_1", "range_12", "bearing_1"]
    assert reading_columns(names, []) == {name: name for name in names}
    assert reading_columns(names, ["range_*=r*_m", "bearing_1=b"]) == {
        "range_1": "r1_m",
        "range_12": "r12_m",
        "bearing_1": "b",
    }
