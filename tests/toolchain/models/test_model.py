"""A model's parts belong together, or the error says which does not."""

import numpy as np
import pytest

from toolchain.errors import ModelError
from toolchain.models.model import Known, Model, PriorSelect, cell_centres, dimension, interval


def known(name="K", values=3, lines=4, **fields):
    return Known(name=name, table=np.full((values, lines), 1 / values), **fields)


def test_cells_are_row_major_with_the_first_dimension_slowest():
    y, x = interval("y", -1, 1, cells=2), dimension("x", size=3, offset=10, step=5)
    ys, xs = cell_centres(y, x)
    assert ys.tolist() == [-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]
    assert xs.tolist() == [10, 15, 20, 10, 15, 20]
    assert [y.value(i) for i in (0, 1)] == [-0.5, 0.5]


def test_a_model_has_a_uniform_prior_and_as_few_bits_as_will_do():
    model = Model(name="m", searched=(dimension("s", size=4),), known=(known(), known("L", values=4)))
    assert model.prior_distribution.tolist() == [0.25] * 4
    assert [k.bits for k in model.known] == [2, 3]  # 4 values and the missing reading's address need 3 bits
    assert [k.as_variable().values for k in model.known] == [3, 4]


def test_a_model_searches_at_most_the_maximum_of_values(monkeypatch):
    monkeypatch.setattr("toolchain.models.model.MAX_LINES", 6)
    width = dimension("x", size=3)
    largest = Model(name="m", searched=(dimension("y", size=2), width), known=(known(lines=6),))
    assert largest.lines == 6
    with pytest.raises(ModelError):
        Model(name="m", searched=(width, dimension("y", size=3)), known=(known(lines=9),))


def test_tables_are_copies_that_cannot_be_written():
    table = np.full((2, 4), 0.5)
    one = Known(name="K", table=table)
    table[0, 0] = 7
    assert one.table[0, 0] == 0.5
    with pytest.raises(ValueError, match="read-only"):
        one.table[0, 0] = 1


def changed(at, to):
    table = np.full((2, 4), 0.5)
    table[at] = to
    return table


def model_with(**fields):
    return Model(**({"name": "m", "searched": (dimension("s", size=4),), "known": ()} | fields))


@pytest.mark.parametrize(
    "make",
    [
        lambda: known(lines=3),
        lambda: Known(name="K", table=np.ones(4)),
        lambda: Known(name="K", table=np.ones((0, 4))),
        lambda: Known(name="K", table=changed((1, 2), 0.4)),
        lambda: Known(name="K", table=changed((1, 2), np.nan)),
        lambda: Known(name="K", table=changed((slice(None), 1), [1.5, -0.5])),
        lambda: known(name=""),
        lambda: known(name="a\x1b[2J"),
        lambda: known(step=0.0),
        lambda: known(values=65536),
        lambda: known(values=5, bits=2),
        lambda: known(on_range="ignore"),
        lambda: model_with(known=(known(), known())),
        lambda: model_with(searched=(dimension("x", size=2), dimension("x", size=2))),
        lambda: model_with(searched=()),
        lambda: model_with(searched=(dimension("x", size=50_000), dimension("y", size=50_000))),
        lambda: model_with(name=""),
        lambda: model_with(name="a\nb"),
        lambda: model_with(name="x" * 201),
        lambda: model_with(name=3),
        lambda: model_with(prior=np.full(3, 1 / 3)),
        lambda: model_with(prior=np.full(4, 0.3)),
        lambda: interval("x", 1, 1, cells=3),
        lambda: interval("x", 0, 1, cells=0),
        lambda: dimension("x", size=0),
        lambda: dimension("", size=1),
        lambda: dimension("a\nb", size=1),
    ],
)
def test_refused_parts_of_a_model(make):
    with pytest.raises(ModelError):
        model_with(known=(make(),))


def test_a_notebook_shows_a_model_in_a_line():
    select = PriorSelect(name="hour", table=np.full((3, 4), 0.25))
    searched = (dimension("y", size=2), dimension("x", size=2))
    model = Model(name="m", searched=searched, known=(known("k"),), prior_select=select)
    assert repr(model) == "Model('m', P(y[2], x[2] | k, hour))"
    assert "array" not in repr(model.known[0]) + repr(select)
