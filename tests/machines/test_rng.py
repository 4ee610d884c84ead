"""Generators, each compared with its definition in plain Python."""

import random

import numpy as np
import pytest

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters, RngKind
from machines.rng import LFSR, apply_map, jump_tables, random_numbers
from tests.machines.bm2_of_the_page import lfsr_step
from tests.machines.random_machines import LFSRS

PRIMES = {8: (3, 5, 17), 16: (3, 5, 17, 257), 24: (3, 5, 7, 13, 17, 241), 32: (3, 5, 17, 257, 65537)}


def words(*numbers):
    return np.array(numbers, dtype=np.uint64)


def numbers(kind, **parameters):
    rng_table = parameters.pop("rng_table", None)
    parameters = BM1Parameters(
        **{"lines": 2, "sensor_bits": (1, 1), "prob_bits": 7, "rng": kind, **parameters}
    )
    tables = tuple(np.full((2, 2), 127) for _ in range(2))
    return random_numbers(BM1Machine(parameters, np.full((1, 2), 1), tables, rng_table))


@pytest.mark.parametrize("kind", LFSRS)
def test_a_step_is_the_definitions(kind):
    states = [random.Random(3).randrange(1, 1 << kind.lfsr_bits) for _ in range(200)]
    assert LFSR(kind).step(words(*states)).tolist() == [lfsr_step(kind, state) for state in states]


@pytest.mark.parametrize("kind", LFSRS)
def test_the_period_is_all_states_but_0(kind):
    """The order of a state is 2**bits - 1: it divides that number, but not that number without one of its primes."""
    lfsr = LFSR(kind)
    state = start = words(1)
    for tables in jump_tables(kind, 1):  # 1 + 2 + 4 + ... steps: the period's
        state = apply_map(tables, state)
    assert state == start
    period = 2**kind.lfsr_bits - 1
    assert lfsr.period == period
    rest = period
    for prime in PRIMES[kind.lfsr_bits]:
        assert period % prime == 0
        while rest % prime == 0:
            rest //= prime
        assert lfsr.jump(start, words(period // prime)) != start
    assert rest == 1


@pytest.mark.parametrize("kind", LFSRS)
def test_a_jump_is_its_steps(kind):
    lfsr = LFSR(kind)
    first = 0b1011
    states = [first]
    for _ in range(1000):
        states.append(lfsr_step(kind, states[-1]))
    steps = np.arange(1001, dtype=np.uint64)
    assert lfsr.jump(np.full(1001, first, dtype=np.uint64), steps).tolist() == states
    around = steps + np.uint64(lfsr.period)
    assert lfsr.jump(np.full(1001, first, dtype=np.uint64), around).tolist() == states


@pytest.mark.parametrize("kind", [RngKind.LFSR8, RngKind.LFSR16])
@pytest.mark.parametrize(("bank", "first"), [(0, 0), (1, 3), (15, 45)])
def test_seeds_are_reached_from_the_base_state(kind, bank, first):
    period = (1 << kind.lfsr_bits) - 1
    expected = []
    for number in range(first, first + 3):
        state = 0x2545F4914F6CDD1D & period
        for _ in range(((((number + 1) * 0x9E3779B97F4A7C15) >> 32) & 0xFFFFFFFF) % period):
            state = lfsr_step(kind, state)
        expected.append(state)
    assert numbers(kind).restart(bank).tolist() == expected


def test_seeds_of_the_default_generator_are_what_they_were():
    """Hardware holds these numbers: whoever changes them changes every machine."""
    seeds = numbers(RngKind.LFSR32).restart(0).tolist()
    assert [hex(seed) for seed in seeds] == ["0x5e6fae2", "0xc2fc3b8d", "0x43b66e68"]


@pytest.mark.parametrize("kind", LFSRS)
def test_unshared_generators_are_numbered_by_cell(kind):
    cells = numbers(kind, shared=False)
    for bank in (0, 1):
        states = cells.restart(bank)
        assert states.shape == (2, 3)
        assert states.ravel().tolist() == [int(LFSR(kind).seeds(words(bank * 6 + n))[0]) for n in range(6)]


@pytest.mark.parametrize("steps_per_clock", [1, 2, 7, 8])
def test_a_clock_is_its_steps_and_shows_the_low_bits(steps_per_clock):
    generators = numbers(RngKind.LFSR16, steps_per_clock=steps_per_clock)
    states = generators.restart(0)
    expected = states.tolist()
    for _ in range(20):
        assert generators.show(states).tolist() == [state & 127 for state in expected]
        states = generators.clock(states)
        for _ in range(steps_per_clock):
            expected = [lfsr_step(RngKind.LFSR16, state) for state in expected]
    assert states.tolist() == expected


def test_a_table_is_played_in_a_ring():
    table = np.array([1000 + n for n in range(10)])
    generators = numbers(RngKind.TABLE, rng_table=table, rng_banks=2)
    states = generators.restart(0)
    assert states.tolist() == [0, 3, 6]
    assert generators.show(states).tolist() == [1000 & 127, 1003 & 127, 1006 & 127]
    for _ in range(8):
        states = generators.clock(states)
    assert states.tolist() == [8, 1, 4]
    # The other bank starts in the middle between.
    assert generators.restart(1).tolist() == [1, 5, 8]
    cells = numbers(RngKind.TABLE, rng_table=table, shared=False, steps_per_clock=3)
    assert cells.restart(0).tolist() == [[0, 1, 3], [5, 6, 8]]
    assert cells.clock(cells.restart(0)).tolist() == [[3, 4, 6], [8, 9, 1]]


def mix(word):
    word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    word = (word ^ (word >> 27)) * 0x94D049BB133111EB % 2**64
    return word ^ (word >> 31)


def test_the_ideal_generator_is_splitmix64_of_seed_number_and_cycle():
    golden = 0x9E3779B97F4A7C15
    # the first numbers of a generator that starts at 0, as its authors' program prints them
    assert [mix(golden), mix(2 * golden % 2**64)] == [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4]
    generators = numbers(RngKind.IDEAL, ideal_seed=42, steps_per_clock=3)
    for bank, first in ((0, 0), (2, 6)):
        states = generators.restart(bank)
        expected = [mix((mix(42) + (n + 1) * golden) % 2**64) for n in range(first, first + 3)]
        for _ in range(5):
            assert states.tolist() == expected
            assert generators.show(states).tolist() == [mix(state) & 127 for state in expected]
            states = generators.clock(states)
            expected = [(state + 3 * golden) % 2**64 for state in expected]
