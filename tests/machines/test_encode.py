"""Codes: the nearest of what a cell can make, ties up."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from machines.encode import decode_code, encode_probability
from machines.errors import ParameterError


@settings(deadline=None)
@given(st.floats(0, 1), st.integers(1, 16))
@example(1 / 512, 8)  # ties, and what is next to them
@example(np.nextafter(1 / 512, 0), 8)
@example(255 / 256, 8)
@example(np.nextafter(255 / 256, 0), 8)
@example(0.5, 1)
def test_no_other_code_is_nearer_and_ties_go_up(p, prob_bits):
    ones = 2**prob_bits - 1
    below = int(p * 2**prob_bits)
    values = {code: Fraction(code, 2**prob_bits) for code in range(below - 1, below + 3) if 0 <= code < ones}
    values[ones] = Fraction(1)
    nearest = min(values, key=lambda code: (abs(values[code] - Fraction(p)), -code))
    assert int(encode_probability(p, prob_bits)) == nearest


@given(st.integers(1, 16))
def test_every_code_is_the_nearest_to_what_it_makes(prob_bits):
    codes = np.arange(2**prob_bits)
    made = decode_code(codes, prob_bits)
    assert made[-1] == 1
    assert (encode_probability(made, prob_bits) == codes).all()


@pytest.mark.parametrize(
    ("function", "values", "prob_bits"),
    [
        *((encode_probability, [0.5, p], 8) for p in (-0.01, 1.01, np.nan, np.inf)),
        *((decode_code, codes, 8) for codes in ([256], [-1], [0.5])),
        *((function, [0], bits) for function in (encode_probability, decode_code) for bits in (0, 17)),
    ],
)
def test_a_number_that_is_not_a_probability_or_a_code_is_refused(function, values, prob_bits):
    with pytest.raises(ParameterError):
        function(values, prob_bits)
