"""Addresses of readings: the rule, the ends of the range, and everything that is not a number."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from toolchain.deployment import Variable
from toolchain.deployment.address import to_address
from toolchain.errors import NotANumberError, ReadingMissingError, ValueOutOfRangeError

NUMBERS = st.floats(allow_nan=False, allow_infinity=False) | st.integers()


def variable(**fields):
    return Variable(**({"name": "D1", "bits": 7, "values": 101} | fields))


@st.composite
def variables(draw, *, period=False):
    bits = draw(st.integers(1, 10))
    return variable(
        bits=bits,
        values=draw(st.integers(1, 2**bits - 1)),
        offset=draw(st.floats(-1e6, 1e6)),
        step=draw(st.floats(1e-3, 1e3) | st.floats(-1e3, -1e-3)),
        period=draw(st.integers(1, 2**bits)) if period else None,
        on_range=draw(st.sampled_from(["error", "clamp", "missing"])),
        on_missing=draw(st.sampled_from(["error", "missing"])),
    )


@given(variables(), NUMBERS)
def test_the_rule_without_a_period(variable, value):
    try:
        expected = math.floor((value - variable.offset) / variable.step + 0.5)
    except OverflowError:
        expected = 2**64 if (value > 0) == (variable.step > 0) else -1
    if 0 <= expected < variable.values:
        assert to_address(variable, value) == expected
    elif variable.on_range == "clamp":
        assert to_address(variable, value) == (variable.values - 1 if expected > 0 else 0)
    elif variable.on_range == "missing" and variable.on_missing == "missing":
        assert to_address(variable, value) is None
    else:
        with pytest.raises(ReadingMissingError if variable.on_range == "missing" else ValueOutOfRangeError):
            to_address(variable, value)


@given(variables(period=True), st.integers(-(2**20), 2**20))
def test_a_period_comes_before_the_range_check(variable, turns):
    variable = variable.model_copy(update={"on_range": "error"})
    for address in {0, variable.values - 1}:
        if address >= variable.period:
            continue
        step = address + turns * variable.period
        value = variable.offset + step * variable.step
        if math.floor((value - variable.offset) / variable.step + 0.5) == step:  # except for rounding
            assert to_address(variable, value) == address


@given(
    variables() | variables(period=True),
    st.text() | st.binary() | st.lists(NUMBERS, min_size=1) | st.dictionaries(st.text(), NUMBERS),
)
@example(variable(), "x" * 10_000)
def test_a_value_that_is_not_a_number_is_never_read_as_one(variable, value):
    with pytest.raises(NotANumberError, match="not a number") as caught:
        to_address(variable, value)
    assert caught.value.exit_code == 4
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)


def test_a_wrong_state_is_refused_with_the_right_ones():
    with pytest.raises(NotANumberError, match="'damp' is a string, .* states: wet, dry"):
        to_address(variable(values=2, states=("wet", "dry")), "damp")


def test_a_number_beyond_the_states_is_refused_with_their_names():
    with pytest.raises(ValueOutOfRangeError, match=r"expected 0 to 1 in steps of 1 \(wet, dry\)"):
        to_address(variable(values=2, states=("wet", "dry")), 5)


@pytest.mark.parametrize(("value", "address"), [(49.5, 50), (-0.5, 0), (True, 1), (False, 0)])
def test_rounding_and_booleans(value, address):
    assert to_address(variable(), value) == address


@pytest.mark.parametrize("value", [-0.51, 100.5, 10**400, pytest.param(10**5000, id="10**5000"), -math.inf])
def test_out_of_range_names_variable_value_and_range(value):
    with pytest.raises(ValueOutOfRangeError, match=r"D1: .* out of range, expected 0 to 100 in steps of 1"):
        to_address(variable(), value)


@pytest.mark.parametrize(("value", "address"), [(-math.inf, 0), (math.inf, 100), (10**400, 100)])
def test_clamping_reaches_from_infinity(value, address):
    assert to_address(variable(on_range="clamp"), value) == address
    assert to_address(variable(on_range="clamp", step=-1.0), value) == 100 - address


@pytest.mark.parametrize("on_range", ["error", "clamp"])
def test_infinity_has_no_place_on_a_circle(on_range):
    bearing = variable(name="B1", bits=9, values=360, period=360, on_range=on_range)
    with pytest.raises(ValueOutOfRangeError, match="period of 360"):
        to_address(bearing, math.inf)
    assert to_address(bearing, 359.5) == 0
    assert to_address(bearing, -1) == 359


@pytest.mark.parametrize(
    ("value", "word"), [(None, "absent or null"), (math.nan, "NaN"), ([], "empty array"), ((), "empty array")]
)
def test_missing_readings(value, word):
    assert to_address(variable(on_missing="missing"), value) is None
    with pytest.raises(ReadingMissingError, match=f"D1 is .*{word}"):
        to_address(variable(), value)
