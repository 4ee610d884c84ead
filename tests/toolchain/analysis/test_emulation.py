"""Boards in one process: the bits of the reference, stopped by the host's rule."""

import pytest

from machines.bm1 import Start, StopReason, first_slice
from machines.reference import ReferenceBM1
from tests.toolchain.corridor import corridor, machine_of
from toolchain.analysis.emulation import EmulatedBoards, joined
from toolchain.building.machine import split
from toolchain.deployment import Stop
from toolchain.errors import BuildError

MACHINE = machine_of(corridor(13, sigma=0.7))


def test_boards_split_and_joined():
    parts = split(MACHINE, 4)
    assert [part.parameters.lines for part in parts] == [4, 3, 3, 3]
    assert joined(parts) == MACHINE


@pytest.mark.parametrize("address", [(9, 0), (9, 1), (20, 1)])
def test_slices_are_those_of_the_reference(address):
    target, limit = 200, 3000
    parts = split(MACHINE, 3)
    boards = EmulatedBoards(parts, target_count=target, max_cycles=limit, stop=Stop.SLICES)
    for bank in (0, 3):
        ran = boards.run(address, 0, bank)
        kernels = [ReferenceBM1(part) for part in parts]
        end = first_slice(target)
        for kernel in kernels:
            kernel.start(
                Start(addresses=address, target_count=target, max_cycles=limit, bank=bank, run_until=end)
            )
        while not any(kernel.reason is StopReason.OVERFLOW for kernel in kernels):
            left = [kernel for kernel in kernels if kernel.reason is StopReason.SLICE]
            if not left:
                break
            end *= 2
            for kernel in left:
                kernel.resume(end if end < limit else 0)
        assert ran.cycles == tuple(kernel.cycles for kernel in kernels)
        assert ran.reasons == tuple(kernel.reason for kernel in kernels)
        assert [counts.tolist() for counts in ran.counts] == [kernel.counts.tolist() for kernel in kernels]


def test_own_stops_each_board_by_itself():
    boards = EmulatedBoards(split(MACHINE, 2), target_count=255, max_cycles=100_000, stop=Stop.OWN)
    ran = boards.run((2, 1), 0, 0)
    assert ran.reasons[0] is StopReason.OVERFLOW
    assert ran.cycles[0] != ran.cycles[1]
    assert ran.length == max(ran.cycles)
    posterior = ran.posterior
    assert posterior is not None
    assert posterior.sum() == pytest.approx(1)


def test_a_run_of_a_given_length_is_stopped_by_no_counter():
    boards = EmulatedBoards([MACHINE], target_count=3, max_cycles=100, stop=Stop.OWN)
    ran = boards.run_for((2, 1), 0, 0, 5000)
    assert ran.cycles == (5000,)
    assert ran.counts[0].max() > 255


def test_limits_that_make_no_sense():
    with pytest.raises(BuildError, match="256"):
        EmulatedBoards([MACHINE], target_count=256, max_cycles=10, stop=Stop.OWN)
    with pytest.raises(BuildError, match="max_cycles"):
        EmulatedBoards([MACHINE], target_count=5, max_cycles=0, stop=Stop.OWN)
