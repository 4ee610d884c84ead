"""A prior selected by a variable (thesis 2.1.2), and one written by the host, from the model to the results.

model ──▶ deployment.toml, images ──▶ addresses of a frame ──▶ row of the prior's table, codes to write ──▶ posterior
"""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from machines.encode import decode_code
from machines.parameters import PriorMode
from machines.posterior import posterior
from pcie_shim.programming_file import read_image
from tests.toolchain.running import build_model
from toolchain.analysis.emulation import joined
from toolchain.building.quantise import quantise
from toolchain.deployment import Scale, Variable, WrittenPrior, load_deployment
from toolchain.deployment.address import to_address
from toolchain.deployment.address_array import written_prior
from toolchain.errors import BuildError, DeploymentError, ModelError, ReadingError
from toolchain.models.distribution import IntegerType, LabelType, Symbol, table
from toolchain.models.joint import JointDistribution
from toolchain.models.model import Known, Model, PriorSelect, dimension, exact_posterior, fuse

FINE = {"prob_bits": 14, "counter_bits": 16, "target_count": 20000}
PRIORS = np.array([[0.7, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.7], [0.0, 0.5, 0.5, 0.0]])
HEARD = np.array([[0.9, 0.4, 0.4, 0.1], [0.1, 0.6, 0.6, 0.9]])


def model(**fields):
    known = (Known(name="heard", table=HEARD),)
    return Model(name="rooms", searched=(dimension("room", size=4),), known=known, **fields)


def selected(**fields):
    return PriorSelect(name="time", table=PRIORS, on_missing="missing", **fields)


def build(tmp_path, built_model, **options):
    build_model(built_model, tmp_path, **options)
    return load_deployment(tmp_path)


def on_boards(deployment, addresses, codes=None):
    """Return the joint result of a deployment's boards, normalised as by the host."""
    sensors, row = deployment.machine_addresses(addresses)
    boards = [read_image(deployment.image_path(at)).machine for at in range(len(deployment.boards))]
    machine = joined(boards)
    prior = machine.prior[row if deployment.machine.prior_bits else 0] if codes is None else codes
    rows = [table_[address] for table_, address in zip(machine.tables, sensors, strict=True)]
    product = np.prod([decode_code(each, machine.parameters.prob_bits) for each in (prior, *rows)], axis=0)
    exact = product / product.sum()
    if len(boards) == 1:
        target = deployment.machine.target_count
        counted = posterior(machine, sensors, prior_address=row, target_count=target, prior_codes=codes)
        assert counted == pytest.approx(exact, abs=0.02)
    return exact


@pytest.mark.parametrize("partitions", [1, 2])
def test_the_selected_row_is_the_prior_of_the_frame(tmp_path, partitions):
    deployment = build(tmp_path, model(prior_select=selected()), partitions=partitions, **FINE)
    assert deployment.machine.prior_bits == 2
    assert [variable.name for variable in deployment.sensors] == ["heard"]
    assert deployment.prior_select.name == "time"
    for heard in (0, 1):
        for time in (0, 1, 2):
            found = on_boards(deployment, [heard, time])
            assert found == pytest.approx(fuse(PRIORS[time], [HEARD[heard]]), abs=2e-3)
            exact = exact_posterior(model(prior_select=selected()), [heard], prior_address=time)
            assert found == pytest.approx(exact, abs=2e-3)


def test_a_missing_selection_is_the_top_row_the_prior_without_it(tmp_path):
    deployment = build(tmp_path, model(prior_select=selected()), **FINE)
    assert deployment.machine_addresses([1, None]) == ((1,), 3)
    found = on_boards(deployment, [1, None])
    assert found == pytest.approx(fuse(PRIORS.mean(axis=0), [HEARD[1]]), abs=2e-3)
    given = model(prior_select=selected(), prior=np.array([0.4, 0.3, 0.2, 0.1]))
    assert quantise(given).prior[3].tolist() == [255, 192, 128, 64]


def test_rows_that_are_not_served_are_impossible():
    few = model(prior_select=PriorSelect(name="time", table=PRIORS[:2], bits=3))
    codes = quantise(few, scale=Scale.ADDRESS).prior
    assert codes.shape == (8, 4)
    assert not codes[2:7].any()
    assert codes[[0, 1, 7]].max(axis=1).tolist() == [255, 255, 255]


def test_a_question_selects_its_prior_by_a_variable():
    time, room = Symbol("time", LabelType("day", "night")), Symbol("room", IntegerType(0, 3))
    heard = table(Symbol("heard", LabelType("no", "yes")), HEARD, given=[room])
    by_time = table(room, PRIORS[:2].T, given=[time])
    joint = JointDistribution("rooms", (table(time, [0.75, 0.25]), by_time, heard))
    asked = joint.ask(["room"], ["heard"], prior_select="time").model()
    assert asked.prior_select.table == pytest.approx(PRIORS[:2])
    assert asked.prior_distribution == pytest.approx(0.75 * PRIORS[0] + 0.25 * PRIORS[1])
    as_column = joint.ask(["room"], ["heard", "time"]).model()
    for address in (0, 1):
        selecting = exact_posterior(asked, [1], prior_address=address)
        assert selecting == pytest.approx(exact_posterior(as_column, [1, address]))
    assert exact_posterior(asked, [1]) == pytest.approx(exact_posterior(as_column, [1, None]))
    never = JointDistribution("r", (table(time, [1, 0]), by_time))
    plain = never.ask(["room"], prior_select="time").model()
    assert plain.prior_select.table[1] == pytest.approx(PRIORS[0])
    words = asked.prior_select.as_variable()
    assert [to_address(words, each) for each in ("night", "day", 1, 0)] == [1, 0, 1, 0]


@pytest.mark.parametrize("partitions", [1, 2])
def test_a_written_prior_stands_in_the_place_of_the_models(tmp_path, partitions):
    written = {"prior_mode": PriorMode.WRITTEN, "prior_path": "prior.data"}
    deployment = build(tmp_path, model(), partitions=partitions, **written, **FINE)
    assert deployment.machine.prior_mode is PriorMode.WRITTEN
    assert deployment.prior == WrittenPrior(path="prior.data")
    wish = [0.1, 0.2, 0.3, 0.4]
    ratios = written_prior([2e-300, 1e-300, 0, 5e-301], lines=4, prob_bits=8)
    assert ratios.tolist() == [255, 128, 0, 64]
    codes = written_prior(wish, lines=4, prob_bits=14)
    found = on_boards(deployment, [1], codes=codes)
    assert found == pytest.approx(fuse(np.array(wish), [HEARD[1]]), abs=2e-3)
    assert on_boards(deployment, [1]) == pytest.approx(fuse(np.full(4, 0.25), [HEARD[1]]), abs=2e-3)


@pytest.mark.parametrize(
    "prior", [[1, 2, 3], [[1, 2, 3, 4]], [0] * 4, [1, 2, -3, 4], [1, 2, math.nan, 4], ["a", 2, 3, 4], None]
)
def test_a_prior_that_cannot_be_written(prior):
    with pytest.raises(ReadingError):
        written_prior(prior, lines=4, prob_bits=8)


@pytest.mark.parametrize(
    ("fields", "options"),
    [
        ({}, {"prior_path": "prior"}),
        ({}, {"prior_mode": PriorMode.WRITTEN, "prior_path": ""}),
        ({"prior_select": selected()}, {"prior_mode": PriorMode.WRITTEN}),
    ],
)
def test_priors_that_cannot_be_built(tmp_path, fields, options):
    with pytest.raises(BuildError):
        build(tmp_path, model(**fields), **options)


@pytest.mark.parametrize(
    "fields",
    [
        {"table": PRIORS * 2},
        {"table": PRIORS, "bits": 1},
        {"table": PRIORS[0]},
        {"table": np.full((2, 3), 1 / 3)},
        {"table": PRIORS, "name": "heard"},
    ],
)
def test_selected_priors_that_do_not_fit(fields):
    with pytest.raises(ModelError):
        model(prior_select=PriorSelect(**({"name": "a"} | fields)))


def test_a_deployment_whose_prior_does_not_agree_is_refused(tmp_path):
    deployment = build(tmp_path, model(prior_select=selected()))
    fields = dict(deployment)
    two = (*deployment.variables, Variable(name="other", kind="prior_select", bits=2, values=3))
    for changes, sentence in (
        ({"variables": two}, "time and other "),
        ({"variables": deployment.sensors}, "prior_bits"),
        ({"prior": WrittenPrior(path="p")}, "prior_mode"),
    ):
        with pytest.raises(ValidationError, match=sentence):
            type(deployment)(**(fields | changes))
    text = deployment.path.read_text()
    deployment.path.write_text(text.replace('kind = "prior_select"', 'kind = "prior"'))
    with pytest.raises(DeploymentError, match="'prior_select'"):
        load_deployment(tmp_path)


def test_a_word_that_is_not_a_state_is_not_a_number():
    with pytest.raises(ReadingError, match="'of' is a string, not a number"):
        to_address(Variable(name="v", bits=2, values=2, states=("on", "off")), "of")
    with pytest.raises(ValidationError, match="v has 2 values, but 1 states are named"):
        Variable(name="v", bits=2, values=2, states=("on",))
