"""The exact chain of a BM2 has the law, cycles and correlations that its runs approach."""

import numpy as np
import pytest

from machines.bm2 import BM2Start, pack, start_state
from machines.bm2_reference import ReferenceBM2
from tests.toolchain.chains import machine_of, network, sprinkler
from toolchain.analysis.chain import ExactChain, chain_error, distance

WET = {2: 1}
SAMPLES = 1500


@pytest.mark.parametrize(("bits", "due"), [(8, 0.01782), (12, 0.001575), (16, 0.0001493)])
def test_the_error_of_the_codes_is_that_of_an_independent_computation(bits, due):
    model = sprinkler(["rain", "sprinkler"])
    chain = ExactChain(machine_of(model, prob_bits=bits), WET)
    assert distance(chain.posterior(chain.law), model.exact([1])) == pytest.approx(due, rel=1e-3)
    found = chain_error(machine_of(model, prob_bits=bits), model, samples=10_000)
    assert (found.worst, found.worst_reading) == (pytest.approx(due, rel=1e-3), (1,))
    assert found.quantising < found.worst


@pytest.mark.parametrize(
    ("options", "cycles"), [({}, 6.970), ({"literal": True}, 9.374), ({"sequencer": "random"}, 6.970)]
)
def test_cycles_of_a_sweep_of_the_sprinkler(options, cycles):
    assert ExactChain(machine_of(sprinkler(), **options), WET).cycles == pytest.approx(cycles, abs=1e-3)


def _three():
    """Variables of 3, 2 and 4 values in a ring, with correlations; no zeros."""
    weights = np.random.default_rng(3).random
    return network(
        {"AB": weights((3, 2)) + 0.1, "BC": weights((2, 4)) + 0.1, "AC": weights((3, 4)) + 0.1, "D": [1, 2]}
    )


@pytest.mark.parametrize("known", [{}, {0: 2}])
@pytest.mark.parametrize(
    "options",
    [
        {"sequencer": "linear"},
        {"sequencer": "random"},
        {"sequencer": "coloured"},
        {"sequencer": "linear", "sample_every": "move"},
        {"sequencer": "linear", "literal": True, "prob_bits": 5},
    ],
)
def test_a_long_run_approaches_it(options, known):
    machine = machine_of(_three(), rng="ideal", **options)
    p = machine.parameters
    chain = ExactChain(machine, known)
    kernel = ReferenceBM2(machine)
    moves = p.state_bits - sum(p.bits[each] for each in known)
    samples = SAMPLES * (moves if p.sample_every == "move" else 1)
    start = BM2Start(
        state=start_state(machine, known),
        known=sum(p.masks[each] for each in known),
        samples=samples,
        burn_in=20,
        ops_timeout=2**20,
        max_cycles=2**40,
        sequencer=p.sequencer,
    )
    kernel.start(start)
    assert kernel.cycles / (20 + SAMPLES) == pytest.approx(chain.cycles, rel=0.06)
    counts = kernel.results[p.histogram_words :]  # A alone, whose last code is unused
    if not known:
        assert distance(counts[:3] / counts.sum(), chain.posterior(chain.law)) < 0.05
        assert kernel.unused / samples == pytest.approx(1 - chain.law[_used(machine)].sum(), abs=0.002)


def _used(machine):
    """The states, by index, in which A is at one of its values; all bits are unknown."""
    return np.arange(1 << machine.parameters.state_bits) % 4 < 3


def test_a_frame_forgets_its_start():
    machine = machine_of(sprinkler(), prob_bits=6)
    chain = ExactChain(machine, WET)
    start = pack(machine.parameters, (1, 0, 1))
    law, laws = np.zeros(4), []
    law[1] = 1
    for _ in range(3 + 13):
        law = law @ chain.sweep
        laws.append(law)
    assert chain.frame(start, 3, 13) == pytest.approx(np.mean(laws[3:], axis=0))
    assert chain.frame(start, 10**6, 1) == pytest.approx(chain.law)


def test_samples_of_a_persistent_variable_are_worth_less():
    """The sweep's matrix of two equal variables is known: a variable changes its value in a share of 2 q (1 - q)."""
    keep = 0.9
    machine = machine_of(network({"AB": [[keep, 1 - keep], [1 - keep, keep]]}))
    chain = ExactChain(machine, {})
    again = 1 - 2 * keep * (1 - keep)  # A follows B, and B follows A
    correlation = 2 * again - 1
    assert chain.effective() == pytest.approx([(1 - correlation) / (1 + correlation)] * 2, rel=1e-3)
    assert ExactChain(machine_of(network({"A": [1, 3]})), {}).effective() == pytest.approx([1, 1])


def test_a_clipped_ratio_is_lost():
    """All that a chain knows of 1 to 3 is in odds of 1 to 0 and 3 to 0, which are clipped to the same code."""
    model = network({"AB": [[1, 0], [0, 3]], "BC": [[1, 0], [0, 1]]})
    assert model.exact([]) == pytest.approx([0.25, 0.75])
    found = chain_error(machine_of(model, burn_in=100), model, samples=1000)
    assert found.quantising == pytest.approx(
        0.25, abs=1e-9
    )  # the stationary law is exact, however rare a crossing
    assert found.start == pytest.approx(0.5, abs=0.01)
    assert found.effective < 1e-3


def test_too_many_bits_are_not_computed():
    ten = {f"{a}{b}": np.full((2, 2), 0.5) + np.eye(2) for a, b in zip("ABCDEFGHI", "BCDEFGHIJ", strict=True)}
    model = network(ten)
    assert chain_error(machine_of(model), model, samples=10) is None
    model = network(ten, known=("J",))
    assert chain_error(machine_of(model), model, samples=10).share == pytest.approx(0.5)
