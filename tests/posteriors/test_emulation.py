"""The posterior of a deployment in a notebook: its shape, its labels, and the readings that it takes."""

import numpy as np
import pytest

from posteriors import LabelError, Posterior, PosteriorError, posterior
from toolchain.building.build import build_deployment
from toolchain.building.machine import plan_machine
from toolchain.building.options import BuildOptions
from toolchain.errors import ReadingMissingError
from toolchain.models import Known, Model, dimension
from toolchain.models.model import exact_posterior

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


def test_what_it_refuses(build):
    folder = build()
    with pytest.raises(LabelError, match="did you mean 'seen'"):
        posterior(folder, {"sen": 1})
    with pytest.raises(ReadingMissingError):
        posterior(folder, {"felt": float("nan")})
    with pytest.raises(PosteriorError):
        posterior(build(replicas=2), {"seen": 1})
