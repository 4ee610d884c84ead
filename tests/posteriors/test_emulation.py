"""The posterior of a deployment in a notebook: its shape, its labels, and the readings that it takes."""

from dataclasses import replace

import numpy as np
import pytest

from posteriors import LabelError, Posterior, PosteriorError, posterior
from toolchain.building.bm2_machine import plan_bm2
from toolchain.building.build import build_deployment
from toolchain.building.machine import plan_machine, with_bits
from toolchain.building.options import BuildOptions
from toolchain.errors import BuildError, ReadingMissingError
from toolchain.models import Known, Model, PriorSelect, dimension
from toolchain.models.model import exact_posterior
from toolchain.networks import read_network

TARGET = {"uri": "ws://robot:9090", "topic": "/readings", "type": "test_msgs/Readings"}
LIKELY = np.array([[0.7, 0.2, 0.1, 0.3, 0.5, 0.6], [0.3, 0.8, 0.9, 0.7, 0.5, 0.4]])


def model():
    return Model(
        name="rooms",
        searched=(dimension("floor", size=2), dimension("room", size=3, states=("hall", "attic", "yard"))),
        known=tuple(
            Known(name=name, table=table, step=1.0, states=("dark", "light"), on_missing=on_missing)
            for name, table, on_missing in (("seen", LIKELY, "missing"), ("felt", LIKELY[:, ::-1], "error"))
        ),
    )


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    def built(**options):
        folder = tmp_path_factory.mktemp("built")
        build_deployment(plan_machine(model(), BuildOptions(**TARGET, **options)), folder)
        return folder

    return built


@pytest.mark.parametrize("partitions", [1, 2])
def test_it_has_the_shape_and_the_labels_of_the_model(build, partitions):
    folder = build(partitions=partitions, counter_bits=16, target_count=20_000)
    found = posterior(folder, {"seen": "light", "felt": 0})
    assert isinstance(found, Posterior)
    assert (found.labels, found.values.shape) == (("floor", "room"), (2, 3))
    exact = exact_posterior(model(), [1, 0]).reshape(2, 3)
    assert np.abs(found.values - exact).max() < 0.02
    assert found.best() == dict(zip(found.labels, divmod(int(exact.argmax()), 3), strict=True))
    # a message without "felt" is an error, but not a question without it
    for readings in ({"seen": 1}, {"seen": np.int64(1), "felt": None}):
        missing = posterior(folder, readings).values
        assert np.abs(missing - exact_posterior(model(), [1, None]).reshape(2, 3)).max() < 0.02


def test_it_has_the_units_of_the_deployment(build):
    folder = build()
    found = posterior(folder, {"seen": "light", "felt": 0})
    at = found.best()
    room = model().searched[1].states[at["room"]]
    assert found.best_value() == {"floor": float(at["floor"]), "room": room}
    assert found.mean_value() == {"floor": pytest.approx(found.mean()["floor"])}
    received = Posterior(
        probabilities=found.probabilities, labels=found.labels, sizes=found.sizes, heard_ns=0
    )
    assert received.with_units(folder).best_value() == found.best_value()


def test_the_exact_posterior_is_that_of_the_model_or_of_the_codes(build):
    folder = build(partitions=2, prob_bits=4)
    found = posterior(folder, {"seen": "light"})
    exact, codes = found.exact(model()), found.exact()
    np.testing.assert_allclose(exact.values.ravel(), exact_posterior(model(), [1, None]))
    likely = np.round(LIKELY[1] / LIKELY[1].max() * 16) / 16  # 4 bits
    np.testing.assert_allclose(codes.values.ravel(), likely / likely.sum())
    assert (exact.details["exact"], codes.details["exact"]) == ("model", "codes")
    assert 0 < codes.total_variation(exact) < 0.05
    assert exact.best_value().keys() == {"floor", "room"}
    other = Model(name="rooms", searched=model().searched, known=model().known[::-1])
    with pytest.raises(BuildError, match="not built from"):
        found.exact(other)


def test_the_exact_posterior_of_a_selected_prior_and_of_wider_columns(tmp_path):
    rows = np.array([[0.5, 0.1, 0.1, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.1, 0.1, 0.5]])
    plain = replace(model(), prior_select=PriorSelect(name="hour", table=rows))
    build_deployment(plan_machine(with_bits(plain, ["seen=4"]), BuildOptions(**TARGET)), tmp_path)
    for hour in (1, None):
        found = posterior(tmp_path, {"seen": "light", "hour": hour})
        exact = exact_posterior(plain, [1, None], prior_address=hour)
        np.testing.assert_allclose(found.exact(plain).probabilities, exact)
        np.testing.assert_allclose(found.exact().probabilities, exact, atol=0.01)
        assert found.total_variation(found.exact(plain)) < 0.2


NETWORK = """network rain { }
variable rain { type discrete [ 2 ] { no, yes }; }
variable grass { type discrete [ 2 ] { dry, wet }; }
variable roof { type discrete [ 2 ] { dry, wet }; }
probability ( rain ) { table 0.8, 0.2; }
probability ( grass | rain ) { (no) 0.9, 0.1; (yes) 0.05, 0.95; }
probability ( roof | rain, grass ) { (no, dry) 0.9, 0.1; (no, wet) 0.6, 0.4; (yes, dry) 0.5, 0.5; (yes, wet) 0.1, 0.9; }
"""


def test_the_exact_posterior_of_a_network(tmp_path):
    file = tmp_path / "rain.bif"
    file.write_text(NETWORK)
    question = read_network(file).ask(["rain"], ["grass", "roof"])
    options = BuildOptions(**TARGET, target_count=2000)
    build_deployment(plan_bm2(question.network(), options, "it was asked for"), tmp_path / "built")
    found = posterior(tmp_path / "built", {"roof": "wet"})
    dry, wet = 0.8 * (0.9 * 0.1 + 0.1 * 0.4), 0.2 * (0.05 * 0.5 + 0.95 * 0.9)
    np.testing.assert_allclose(found.exact(file).values, np.array([dry, wet]) / (dry + wet))
    assert found.total_variation(found.exact(question)) < 0.1
    with pytest.raises(PosteriorError, match="name the model"):
        found.exact()
    file.write_text(NETWORK.replace("0.8, 0.2", "0.7, 0.3"))
    with pytest.raises(BuildError, match="not built from"):
        found.exact(str(file))


def test_a_posterior_keeps_its_machine(build):
    folder = build()
    found = posterior(folder, {"seen": 1})
    before = found.exact()
    for image in folder.rglob("*.bm"):
        image.unlink()
    assert found.exact() == before


def test_what_it_refuses(build, tmp_path):
    folder = build()
    with pytest.raises(PosteriorError, match="cells: only a model has parameters"):
        posterior(folder, {"seen": 1}).exact(cells=3)
    with pytest.raises(PosteriorError, match="cells: a network file has no parameters"):
        posterior(folder, {"seen": 1}).exact(tmp_path / "a.bif", cells=3)
    with pytest.raises(LabelError, match="did you mean 'seen'"):
        posterior(folder, {"sen": 1})
    with pytest.raises(PosteriorError, match="expected values by name"):
        posterior(folder, [1, 2])
    with pytest.raises(ReadingMissingError):
        posterior(folder, {"felt": float("nan")})
    with pytest.raises(PosteriorError):
        posterior(build(replicas=2), {"seen": 1})
