"""Codes and their loss, and the division of lines among boards."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.encode import decode_code, encode_probability
from machines.errors import ParameterError
from tests.toolchain.builders import normal, wrapped_normal
from toolchain.building.machine import partition_lines
from toolchain.building.quantise import quantise
from toolchain.deployment import Scale
from toolchain.errors import BuildError
from toolchain.models.model import Known, Model, PriorSelect, dimension


@st.composite
def models(draw):
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lines, sharpness = draw(st.integers(1, 6)), draw(st.sampled_from([0.02, 0.3, 1.0]))
    return Model(
        name="random",
        searched=(dimension("s", size=lines),),
        known=tuple(
            Known(
                name=f"K{i}",
                table=random.dirichlet(np.full(draw(st.integers(1, 6)), sharpness), size=lines).T,
                bits=draw(st.sampled_from([0, 4])),
            )
            for i in range(draw(st.integers(0, 3)))
        ),
        prior=random.dirichlet(np.full(lines, sharpness)),
    )


@given(models(), st.integers(1, 16), st.sampled_from(list(Scale)))
def test_every_address_by_its_scale_then_the_nearest_code(model, prob_bits, scale):
    quantised = quantise(model, prob_bits=prob_bits, scale=scale)
    ones = 2**prob_bits - 1
    for known, codes in zip(model.known, quantised.tables, strict=True):
        assert codes.shape == (2**known.bits, model.lines)
        for address in range(2**known.bits - 1):
            if address >= known.values:
                assert not codes[address].any()
                continue
            largest = {
                Scale.ADDRESS: known.table[address].max(),
                Scale.COLUMN: known.table.max(),
                Scale.NONE: 1.0,
            }[scale]
            expected = encode_probability(known.table[address] / (largest or 1.0), prob_bits)
            assert codes[address].tolist() == expected.tolist()
            if scale is Scale.ADDRESS and largest > 0:
                assert codes[address].max() == ones
        assert (codes[-1] == ones).all()


def check_loss(loss, exact_rows, approximate_rows):
    """Compare a loss with sums over rows of P(S, K): the exact ones and those of the codes, up to a factor each."""
    mass, divergence, dead = 0.0, 0.0, 0
    for exact, approximate in zip(exact_rows, approximate_rows, strict=True):
        mass += exact[approximate == 0].sum()
        if exact.sum() > 0 and approximate.sum() == 0:
            dead += 1
        elif exact.sum() > 0:
            p, q = exact / exact.sum(), approximate / approximate.sum()
            divergence += exact.sum() * sum(b * math.log2(b / a) for a, b in zip(p, q, strict=True) if b > 0)
    assert loss.values == len(exact_rows)
    assert loss.mass == pytest.approx(mass, abs=1e-12)
    assert loss.kl_bits == pytest.approx(max(0, divergence), abs=1e-9)
    assert loss.dead_values == dead


@given(models(), st.sampled_from([2, 4, 8, 16]), st.sampled_from(list(Scale)))
def test_the_loss_is_the_mass_of_vanished_cells_and_the_divergence_of_the_rest(model, prob_bits, scale):
    quantised = quantise(model, prob_bits=prob_bits, scale=scale)
    prior = model.prior_distribution
    for known, codes, loss in zip(model.known, quantised.tables, quantised.losses[1:], strict=True):
        decoded = decode_code(codes, prob_bits)[: known.values]
        check_loss(loss, prior * known.table, prior * decoded)
        assert loss.bits == known.bits
        assert len(quantised.warnings) == sum(each.dead_values > 0 for each in quantised.losses[1:])


@given(models(), st.sampled_from([2, 4, 8]), st.sampled_from(list(Scale)), st.integers(1, 5), st.data())
def test_the_prior_is_a_column_too_and_its_rows_are_selected_equally_often(
    model, prob_bits, scale, values, data
):
    random = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    rows = random.dirichlet(np.full(model.lines, 0.1), size=values)
    select = PriorSelect(name="A", table=rows, bits=data.draw(st.sampled_from([0, 4])))
    for given_model, exact in (
        (model, model.prior_distribution[np.newaxis]),
        (replace(model, prior_select=select), rows / values),
    ):
        quantised = quantise(given_model, prob_bits=prob_bits, scale=scale)
        loss = quantised.losses[0]
        assert (loss.name, loss.bits) == ("prior", 0 if given_model is model else select.bits)
        check_loss(loss, exact, decode_code(quantised.prior, prob_bits)[: len(exact)])


def with_floor(floor, prob_bits=8):
    known = normal("D", mean=np.arange(40.0), sigma=1.0, values=40, floor=floor)
    model = Model(name="m", searched=(dimension("s", size=40),), known=(known,))
    return quantise(model, prob_bits=prob_bits)


def test_a_vanishing_floor_is_reported_with_advice():
    (warning,) = with_floor(1e-3).warnings
    assert "Variable D: its outlier floor of 0.001 vanishes at" in warning
    assert "below 2^-9" in warning
    bits = int(warning.split("--prob-bits ")[1].rstrip("."))
    assert not with_floor(1e-3, bits).warnings
    assert with_floor(1e-3, bits - 1).warnings
    assert not with_floor(0.0).warnings  # a Gaussian's tails vanish, and that is what tails do


@pytest.mark.parametrize("prob_bits", [2, 3, 8])
@pytest.mark.parametrize("scale", [Scale.ADDRESS, Scale.COLUMN])
def test_the_floor_that_is_advised_is_enough_and_not_too_much(prob_bits, scale):
    def floors(floor):
        known = wrapped_normal(
            "B", mean=np.arange(0.0, 360, 9), sigma=np.linspace(15, 40, 40), values=36, step=10, floor=floor
        )
        model = Model(name="m", searched=(dimension("s", size=40),), known=(known,))
        return quantise(model, prob_bits=prob_bits, scale=scale).floors

    (found,) = floors(1e-3)
    needed = float(found.advice.removeprefix("use a floor of about ").split()[0])
    assert floors(needed) == ()
    assert floors(0.85 * needed)


def test_codes_of_one_bit_hold_no_floor():
    (found,) = with_floor(0.02, prob_bits=1).floors
    assert "below 2^-1 of the largest" in found.what
    bits = int(found.advice.removeprefix("use --prob-bits "))
    assert not with_floor(0.02, bits).warnings


@pytest.mark.parametrize("prob_bits", [0, 17])
def test_codes_that_no_machine_has(prob_bits):
    with pytest.raises(ParameterError):
        with_floor(0.0, prob_bits)


@given(st.data())
def test_blocks_cover_all_lines_in_order(data):
    lines = data.draw(st.integers(1, 5000))
    count = data.draw(st.integers(1, min(lines, 50)))
    blocks = partition_lines(lines, count)
    assert [line for block in blocks for line in range(block.offset, block.end)] == list(range(lines))
    sizes = [block.lines for block in blocks]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes.count(lines // count + 1) == lines % count
    assert len(blocks) == count


@pytest.mark.parametrize("count", [0, -1, 5])
def test_what_cannot_be_split(count):
    with pytest.raises(BuildError, match="expected 1 to 4 partitions"):
        partition_lines(4, count)
