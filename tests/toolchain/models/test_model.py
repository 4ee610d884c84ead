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


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: known(lines=3),
            r"P\(K \| S\) has 3 lines, but the searched dimensions \(2 x 2\) have 4 cells",
        ),
        (lambda: Known(name="K", table=np.ones(4)), r"has shape \(4,\), expected \(values, lines\)"),
        (lambda: Known(name="K", table=np.ones((0, 4))), "has shape"),
        (lambda: Known(name="K", table=changed((1, 2), 0.4)), r"sums to 0.9 over its values on line 2"),
        (lambda: Known(name="K", table=changed((1, 2), np.nan)), "not a probability"),
        (lambda: Known(name="K", table=changed((slice(None), 1), [1.5, -0.5])), "not a probability"),
        (lambda: known(name=""), "variable '': name = '', expected at least 1 character"),
        (lambda: known(name="a\x1b[2J"), r"'a\\x1b\[2J' has a character that can't be printed"),
        (lambda: known(step=0.0), "a step of 0"),
        (lambda: known(values=65536), "has 65536 values; a column serves at most 65535: use a larger step"),
        (lambda: known(values=5, bits=2), "serves 5 values, but 2 bits hold 3"),
        (lambda: known(on_range="ignore"), "on_range = 'ignore', expected 'error', 'clamp' or 'missing'"),
    ],
)
def test_refused_variables(make, sentence):
    with pytest.raises(ModelError, match=sentence):
        Model(name="m", searched=(dimension("y", size=2), dimension("x", size=2)), known=(make(),))


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"known": (known(), known())}, "has the known variable 'K' twice"),
        ({"searched": (dimension("x", size=2), dimension("x", size=2))}, "searched dimension 'x' twice"),
        ({"searched": ()}, "searches nothing"),
        ({"name": ""}, "the model's name is '', expected 1 to 200 characters that can be printed"),
        ({"name": "a\nb"}, r"the model's name is 'a\\nb', expected"),
        ({"name": "x" * 201}, "expected 1 to 200 characters"),
        ({"name": 3}, "the model's name is '3', expected"),
        (
            {"searched": (dimension("x", size=50_000), dimension("y", size=50_000))},
            "searches 50000 x 50000 = 2500000000 values; the most is 16777216",
        ),
        ({"prior": np.full(3, 1 / 3)}, r"prior P\(S\) has shape \(3,\), expected \(4,\)"),
        ({"prior": np.full(4, 0.3)}, r"prior P\(S\) sums to 1.2; a distribution sums to 1"),
    ],
)
def test_refused_models(fields, sentence):
    with pytest.raises(ModelError, match=sentence):
        Model(**({"name": "m", "searched": (dimension("s", size=4),), "known": ()} | fields))


@pytest.mark.parametrize(
    "make",
    [
        lambda: interval("x", 1, 1, cells=3),
        lambda: interval("x", 0, 1, cells=0),
        lambda: dimension("x", size=0),
        lambda: dimension("", size=1),
        lambda: dimension("a\nb", size=1),
    ],
)
def test_refused_dimensions(make):
    with pytest.raises(ModelError, match="searched dimension"):
        make()


def test_a_notebook_shows_a_model_in_a_line():
    known = Known(name="k", table=np.full((2, 4), 0.5))
    select = PriorSelect(name="hour", table=np.full((3, 4), 0.25))
    searched = (dimension("y", size=2), dimension("x", size=2))
    assert (
        repr(Model(name="m", searched=searched, known=(known,), prior_select=select))
        == "Model('m', P(y[2], x[2] | k, hour))"
    )
    assert repr(Model(name="m", searched=searched, known=())) == "Model('m', P(y[2], x[2]))"
    assert repr(known).startswith("Known(name='k', bits=2, ")
    assert "array" not in repr(known) + repr(select)
