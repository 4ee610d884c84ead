"""Sizes above the limits are refused before anything of that size is allocated."""

import numpy as np
import pytest

from tests.toolchain.running import OPTIONS, refused_within
from toolchain.building.machine import partition_lines, plan_machine
from toolchain.errors import BuildError, ModelError
from toolchain.models import IntegerType, IntervalType, Known, Model, PriorSelect, Symbol
from toolchain.models.conditional import normal, wrapped_normal
from toolchain.models.distribution import conditional_normal, potential, table
from toolchain.models.joint import JointDistribution
from toolchain.models.model import cell_centres, dimension, interval

AXIS = dimension("x", size=5000)


def view(*shape):
    """Return an array of this shape that takes no memory."""
    return np.broadcast_to(1 / shape[0], shape)


def model_of_views(lines, bits):
    known = Known(name="K", table=np.full((2, 1), 0.5), bits=bits)
    object.__setattr__(known, "table", view(2, lines))
    return Model(name="m", searched=(dimension("s", size=lines),), known=(known,), prior=view(lines))


def question(lines, *sizes):
    symbols = [Symbol(f"k{i}", IntegerType(1, size)) for i, size in enumerate(sizes)]
    searched = Symbol("s", IntegerType(1, lines))
    factors = [table(each, view(each.size)) for each in (searched, *symbols)]
    return JointDistribution("j", tuple(factors)).ask([searched], symbols)


@pytest.mark.parametrize(
    "too_large",
    [
        lambda: interval("x", 0, 1, cells=10**9),
        lambda: dimension("x", size=2**24 + 1),
        lambda: cell_centres(AXIS, AXIS),
        lambda: normal("K", mean=np.zeros(2), sigma=1, values=10**9),
        lambda: normal("K", mean=np.zeros(5000), sigma=1, values=2**16 - 1),
        lambda: wrapped_normal("K", mean=np.zeros(2), sigma=1, values=10**9),
        lambda: Known(name="K", table=view(2, 10**9)),
        lambda: PriorSelect(name="K", table=view(10**9, 2)),
        lambda: Model(name="m", searched=(dimension("s", size=4),), known=(), prior=view(10**9)),
        lambda: Symbol("n", IntegerType(0, 10**9)),
        lambda: Symbol("n", IntervalType(0.0, 1.0, 10**9)),
        lambda: conditional_normal(
            Symbol("n", IntegerType(0, 9999)), [Symbol("m", IntegerType(0, 9999))], mean=0, sigma=1
        ),
    ],
)
def test_a_model_part_above_its_limit_is_refused_unmade(too_large):
    with refused_within(4 << 20, ModelError):
        too_large()


def searched_together(count):
    """A question for symbols of 16 values each that are joined by one that is summed over."""
    hidden = Symbol("h", IntegerType(0, 1))
    symbols = [Symbol(f"s{at}", IntegerType(0, 15)) for at in range(count)]
    joint = JointDistribution("many", tuple(potential([each, hidden], np.ones((16, 2))) for each in symbols))
    return joint.ask(symbols[:4] if count == 5 else symbols, symbols[4:] if count == 5 else ())


@pytest.mark.parametrize(
    "too_large", [question(1501, *[10_000] * 20), question(5000, 2, 10_000), searched_together(7)]
)
def test_a_question_with_tables_that_are_too_large_is_refused_unmade(too_large):
    with refused_within(64 << 20, ModelError):
        too_large.model()


def test_a_question_with_large_tables_is_answered():
    assert searched_together(5).model().lines == 16**4


def test_codes_that_no_memory_holds_are_refused_before_they_are_made():
    assert plan_machine(model_of_views(2**14, 16), OPTIONS).parameters.lines == 2**14
    with pytest.raises(BuildError):
        plan_machine(model_of_views(2**14 + 1, 16), OPTIONS)


def test_a_board_for_every_line_takes_linear_time():
    assert partition_lines(2**18, 2**18)[-1].end == 2**18
