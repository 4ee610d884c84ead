"""Many chains at a time against one kernel for each, to the bit, over random networks."""

import dataclasses
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from machines import bm2_chains, make_bm2_kernel
from machines.bm2 import BM2Machine, BM2StopReason
from machines.bm2_chains import ChainResult, Chains
from machines.errors import ParameterError, StartError
from machines.parameters import RngReset, SampleEvery, Sequencer
from tests.machines.random_networks import LFSRS, runs
from tests.machines.test_bm2_fast import contradiction, network, start_of


def boards(machine, count, **changes):
    """The machines of the chains of a model."""
    return [
        BM2Machine(
            dataclasses.replace(machine.parameters, chain=at, chains=count, **changes),
            machine.tables,
            machine.supports,
        )
        for at in range(count)
    ]


def shown(result):
    """All that a result or a kernel shows."""
    values = {field.name: getattr(result, field.name) for field in dataclasses.fields(ChainResult)}
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()
    }


def run_both(machines, starts):
    """Run the chains together and one by one, see that they agree, and return the former."""
    results = Chains(machines).run(starts)
    for at, (machine, start, result) in enumerate(zip(machines, starts, results, strict=True)):
        kernel = make_bm2_kernel(machine)
        kernel.start(start)
        assert shown(result) == shown(kernel), f"chain {at}"
    return results


@pytest.mark.parametrize("examples", [60, pytest.param(1000, marks=pytest.mark.thorough)])
def test_equals_single_chains(examples):
    """Small networks are sliced, larger ones go in step, unless a chain may have reached a limit."""
    ran = []

    def compare(run, count, lengths, seed):
        random = np.random.default_rng(seed)
        changes = {"rng_reset": RngReset.BANK, "sample_every": SampleEvery.SWEEP, "stream": 0}
        machines = boards(run.machine, count, **changes)
        parameters = machines[0].parameters
        samples, burn_in, max_cycles, ops_timeout = lengths
        start = dataclasses.replace(
            run.courses[0].start,
            samples=samples,
            burn_in=burn_in,
            max_cycles=max_cycles,
            ops_timeout=ops_timeout,
            sequencer=Sequencer.LINEAR,
        )
        free = ~start.known & ((1 << parameters.state_bits) - 1)
        starts = [
            dataclasses.replace(
                start,
                state=start.state & start.known | int.from_bytes(random.bytes(8), "little") & free,
                bank=int(random.integers(parameters.rng_banks)),
            )
            for _ in range(count)
        ]
        run_both(machines, starts)

    lengths = st.tuples(
        st.integers(1, 100),
        st.sampled_from([0, 1, 15, 16, 40]),
        st.integers(1, 4000),
        st.sampled_from([32, 70, 2**20]),
    )
    search = given(runs(LFSRS, variables=4), st.sampled_from([16, 25]), lengths, st.integers(0, 2**32))(
        compare
    )
    sliced, in_step = bm2_chains.run_sliced, bm2_chains.run_in_step
    with mock.patch.multiple(
        bm2_chains,
        SLICED_MIN=2,
        UNKNOWN_MAX=6,
        run_sliced=lambda *given: ran.append(("sliced", sliced(*given))) or ran[-1][1],
        run_in_step=lambda *given: ran.append(("in step", in_step(*given))) or ran[-1][1],
    ):
        settings(max_examples=examples, suppress_health_check=list(HealthCheck))(search)()
    assert set(ran) == {(kernel, drawn) for kernel in ("sliced", "in step") for drawn in (True, False)}


def test_chains_fill_several_vectors_and_know_different_things():
    """The last vector is not full, and the known variable has a value of its own in each chain."""
    machines = boards(network(searched=(0, 2)), 600)
    known = machines[0].parameters.masks[2]
    results = run_both(
        machines, [start_of(state=at % 4 << 3, known=known, bank=at % 16) for at in range(600)]
    )
    assert {result.reason for result in results} == {BM2StopReason.SAMPLES}
    assert len({tuple(result.rng_state.tolist()) for result in results}) == 600


@pytest.mark.parametrize("count", [32, 64])
def test_a_chain_of_one_bit_can_sample_in_every_cycle(count):
    """Its one CDE agrees with itself, so a sweep takes a cycle, and every cycle of a block can be the last."""
    machines = boards(network(cardinalities=(2,), factors=((0,),)), count)
    for samples in range(1, 36):
        for burn_in in (0, 8, 17):
            results = Chains(machines).run(
                [start_of(samples=samples, burn_in=burn_in, max_cycles=100)] * count
            )
            assert {(each.cycles, each.samples) for each in results} == {(samples + burn_in, samples)}


@pytest.mark.parametrize("count", [32, 64])
def test_one_chain_times_out_by_one_cycle(count):
    """In step, and sliced."""
    machines = boards(contradiction(), count)
    moves = [each.cycles for each in run_both(machines, [start_of(samples=1, ops_timeout=2**22)] * count)]
    results = run_both(machines, [start_of(samples=1, ops_timeout=max(moves) - 1)] * count)
    assert max(moves) > 2**16
    assert [each.reason for each in results].count(BM2StopReason.OPS_TIMEOUT) == 1


def test_other_chains_run_one_by_one():
    """Orders and settings that slices do not have; free generators go on from frame to frame."""
    machines = boards(network(), 40, rng_reset=RngReset.FREE)
    together, alone = Chains(machines), [make_bm2_kernel(machine) for machine in machines]
    for sequencer in Sequencer:
        starts = [start_of(sequencer=sequencer, samples=10 + at) for at in range(40)]
        for result, kernel, start in zip(together.run(starts), alone, starts, strict=True):
            kernel.start(start)
            assert shown(result) == shown(kernel)


def test_impossible_evidence():
    results = run_both(boards(network(), 40), [start_of(samples=0)] * 40)
    assert {result.reason for result in results} == {BM2StopReason.IMPOSSIBLE}


def test_bad_chains_and_starts_are_refused():
    with pytest.raises(ParameterError, match="machines of the chains differ"):
        Chains([network(), network(prob_bits=8)])
    chains = Chains(boards(network(), 2))
    with pytest.raises(StartError, match="There are 1 starts for 2 chains"):
        chains.run([start_of()])
    with pytest.raises(StartError, match="bank is 16"):
        chains.run([start_of(), start_of(bank=16)])
