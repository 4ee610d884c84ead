"""Schedules of the campaign: seeded, within the limits of a master, and shortened when they fail."""

import random
from collections import Counter

import pytest

from scripts.campaigning.faults import ENDS, MOST_ENDS, Fault, Kind, Schedule, ended_roles, excuses_of
from scripts.campaigning.shrinking import shrink
from scripts.campaigning.stack import Topology

CONTAINERS = Topology.CONTAINERS


@pytest.mark.parametrize("topology", Topology)
def test_a_seed_gives_the_same_steps_within_what_a_master_forgives(topology):
    for seed in range(30):
        steps, again = (Schedule(random.Random(seed), topology, list(Kind)).steps(10) for _ in range(2))
        assert steps == again
        ends = Counter(role for step in steps for fault in step for role in ended_roles(fault))
        assert all(number <= ENDS.get(role, MOST_ENDS) for role, number in ends.items())


@pytest.mark.parametrize("kind", Kind)
def test_only_faults_of_a_kind_are_drawn(kind):
    topology = Topology.CONTAINERS if kind is Kind.CONTAINERS else Topology.APART
    steps = Schedule(random.Random(1), topology, [kind]).steps(10)
    assert steps
    assert kind in {fault.kind for step in steps for fault in step}


def test_containers_have_only_faults_that_an_engine_can_inject():
    steps = [
        step for seed in range(30) for step in Schedule(random.Random(seed), CONTAINERS, list(Kind)).steps(10)
    ]
    faults = {fault for step in steps for fault in step}
    assert {fault.kind for fault in faults} == {Kind.SIGNALS, Kind.ROSBRIDGE, Kind.INPUT, Kind.CONTAINERS}
    targets = {fault.target for fault in faults} - {"rosbridge", "readings"}
    assert targets == {"hub", "boards", "subscriber", "publisher", "pcie-app", "master"}
    assert {fault.target for fault in faults if fault.what == "cut-off"} == {"subscriber", "publisher"}


@pytest.mark.parametrize(
    ("fault", "readings", "results"),
    [
        (Fault("signals", "kill", "pcie-app"), False, False),
        (Fault("signals", "kill", "board0"), False, False),
        (Fault("signals", "stop", "subscriber", 1.0), False, False),
        (Fault("signals", "kill", "subscriber"), True, False),
        (Fault("signals", "kill", "publisher"), False, True),
        (Fault("rosbridge", "hold", "rosbridge", 1.0), False, False),
        (Fault("rosbridge", "gone", "rosbridge", 1.0), True, True),
        (Fault("links", "corrupt", "board1", 1.0, 1), False, False),
        (Fault("input", "burst", "readings", 0.0, 10_000), False, False),
        (Fault("containers", "cut-off", "subscriber", 1.0), True, False),
        (Fault("containers", "restart", "publisher"), False, True),
        (Fault("containers", "full", "boards", 1.0), False, False),
    ],
    ids=str,
)
def test_a_fault_excuses_only_what_nobody_can_count(fault, readings, results):
    excuses = excuses_of((fault,), Topology.APART)
    assert (excuses.readings, excuses.results) == (readings, results)


@pytest.mark.parametrize("culprits", [{9}, {0}, {3, 7}, {0, 4, 9}, set(range(10))], ids=str)
async def test_the_shortest_failing_list_is_found(culprits):
    async def fails(parts):
        return culprits <= set(parts)

    assert await shrink(list(range(10)), fails, seconds=60) == sorted(culprits)


async def test_shortening_ends_with_its_time():
    async def fails(parts):
        raise AssertionError(parts)

    assert await shrink([1, 2, 3], fails, seconds=0) == [1, 2, 3]
