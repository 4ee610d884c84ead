"""float64 fusion against equation 2.2 written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolchain.errors import ModelError
from toolchain.models.model import Known, Model, dimension, exact_posterior, fuse


def random_model(seed, lines=5, sensors=3, values=4):
    random = np.random.default_rng(seed)
    return Model(
        name="random",
        searched=(dimension("s", size=lines),),
        known=tuple(
            Known(name=f"K{i}", table=random.dirichlet(np.ones(values), size=lines).T) for i in range(sensors)
        ),
        prior=random.dirichlet(np.ones(lines)),
    )


@given(st.integers(0, 2**32 - 1), st.lists(st.none() | st.integers(0, 3), min_size=3, max_size=3))
def test_the_product_normalised_and_missing_readings_left_out(seed, addresses):
    model = random_model(seed)
    product = model.prior_distribution.copy()
    for known, address in zip(model.known, addresses, strict=True):
        if address is not None:
            product *= known.table[address]
    assert exact_posterior(model, addresses) == pytest.approx(product / product.sum(), rel=1e-9)


def test_it_does_not_underflow():
    factors = [np.array([1e-300, 2e-300])] * 40
    assert fuse(np.array([0.5, 0.5]), factors) == pytest.approx([1 / (1 + 2.0**40), 1 / (1 + 2.0**-40)])


def test_refusals():
    model = random_model(1)
    with pytest.raises(ModelError, match="2 readings for the 3 known variables"):
        exact_posterior(model, [0, 1])
    with pytest.raises(ModelError, match="K1: address 4 is not one of its 4"):
        exact_posterior(model, [0, 4, 0])
    with pytest.raises(ModelError, match="impossible on every line"):
        fuse(np.array([1.0, 0.0]), [np.array([0.0, 1.0])])
