"""Statistics of streams of random bits (thesis 2.1.1): the mean is the product, the spread is equation 2.1.

Seeds are fixed, so that nothing here is left to chance: a test that passes, passes always.
"""

import numpy as np
import pytest

from machines import make_kernel
from machines.bm1 import BM1Machine, Start
from machines.encode import decode_code
from machines.parameters import BM1Parameters, RngKind

EVER = 2**32 - 1


def machine_of(codes, **parameters):
    """A machine whose columns (the first one the prior's) hold these codes, one row per column."""
    codes = np.asarray(codes)
    columns, lines = codes.shape
    parameters = BM1Parameters(
        **{
            "lines": lines,
            "sensor_bits": (1,) * (columns - 1),
            "counter_bits": 32,
            "rng_banks": 400,
            **parameters,
        }
    )
    tables = tuple(np.stack([row, np.full(lines, parameters.ones_code)]) for row in codes[1:])
    return BM1Machine(parameters, codes[:1], tables)


def counts_of(machine, cycles, banks):
    """uint32[banks, lines]: counts after so many cycles from each bank."""
    kernel = make_kernel(machine)
    counts = []
    for bank in range(banks):
        addresses = (0,) * machine.parameters.sensors
        kernel.start(Start(addresses=addresses, target_count=EVER, max_cycles=cycles, bank=bank))
        counts.append(kernel.counts)
    return np.array(counts)


def exact(machine):
    """The probability of each line's bit."""
    rows = [machine.prior[0], *(table[0] for table in machine.tables)]
    return np.prod([decode_code(row, machine.parameters.prob_bits) for row in rows], axis=0)


@pytest.mark.parametrize("kind", [RngKind.LFSR24, RngKind.LFSR32])
@pytest.mark.parametrize("columns", [3, 5, 7, 17])
def test_the_and_of_columns_is_the_product_within_its_standard_error(kind, columns):
    """Numbers of columns that divide the period are the ones that evenly spaced seeds would fail at."""
    shares = np.linspace(0.3, 0.9, 12) ** (2 / columns)
    codes = np.clip(np.rint(shares * 256), 1, 254).astype(int) * np.ones((columns, 1), dtype=int)
    machine = machine_of(codes, rng=kind)
    cycles, banks = 2**15, 16
    mean = counts_of(machine, cycles, banks).sum(axis=0) / (cycles * banks)
    p = exact(machine)
    assert (np.abs(mean - p) < 4 * np.sqrt(p * (1 - p) / (cycles * banks))).all()


@pytest.mark.parametrize(
    ("parameters", "banks"),
    [
        ({"rng": RngKind.LFSR32}, 400),
        ({"rng": RngKind.LFSR24}, 400),
        ({"rng": RngKind.LFSR32, "prob_bits": 16}, 400),
        ({"rng": RngKind.IDEAL}, 200),
        ({"rng": RngKind.IDEAL, "shared": False}, 100),
        ({"rng": RngKind.LFSR32, "shared": False}, 50),
    ],
)
def test_counts_spread_as_equation_2_1_says(parameters, banks):
    ones = 2 ** parameters.get("prob_bits", 8)
    codes = np.rint(np.array([[0.2, 0.5, 0.9, 0.7], [0.9, 0.5, 0.9, 0.1]]) * ones).astype(int)
    machine = machine_of(codes, **parameters)
    cycles = 200
    rates = counts_of(machine, cycles, banks) / cycles
    p = exact(machine)
    limit = np.sqrt(p * (1 - p) / cycles)
    assert (np.abs(rates.mean(axis=0) - p) < 4 * limit / np.sqrt(banks)).all()
    # The spread of so many draws is known to 1 in sqrt(2 banks).
    assert rates.std(axis=0) == pytest.approx(limit, rel=3.5 / np.sqrt(2 * banks))
