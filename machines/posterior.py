"""From counts to probabilities: over all boards of a model, and in one call for a notebook."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine, Start, StopReason
from machines.errors import MachineError, NoPosteriorError, StartError


def joint_posterior(
    counts: Sequence[npt.NDArray[np.uint32]], cycles: Sequence[int]
) -> npt.NDArray[np.float64] | None:
    """The posterior over the lines of all boards, normalised jointly (thesis equation 2.3 for several boards).

    A line's probability is proportional to its count over its board's cycles; a board that ran no cycle (no line
    of it can count) has the weight 0. Boards' counts can't be normalised one by one: each stopped at a cycle of
    its own.

    Args:
        counts: One uint32[lines] per board, in the order of the model's lines.
        cycles: Cycles that each board ran.

    Returns:
        float64[all lines] with the sum 1, or None where every count is 0: there is no posterior then.

    Raises:
        MachineError: There are not as many cycles as boards, or a board has counts and ran no cycle.
    """
    if len(counts) != len(cycles):
        raise MachineError(f"There are counts of {len(counts)} boards and cycles of {len(cycles)}.")
    if not counts:
        return None
    return posterior_of_lines(np.concatenate(counts), [len(count) for count in counts], cycles)


def posterior_of_lines(
    counts: npt.NDArray[np.uint32], lines: Sequence[int], cycles: Sequence[int]
) -> npt.NDArray[np.float64] | None:
    """The same as `joint_posterior`, of counts that lie one after the other.

    Args:
        counts: uint32[all lines], board after board.
        lines: Lines of each board.
        cycles: Cycles that each board ran.

    Returns:
        float64[all lines] with the sum 1, or None where every count is 0.

    Raises:
        MachineError: A board has counts and ran no cycle.
    """
    if min(cycles) <= 0:
        end = 0
        for board, (own, run) in enumerate(zip(lines, cycles, strict=True)):
            end += own
            if run <= 0 and np.any(counts[end - own : end]):
                raise MachineError(f"Board {board} has counts, but ran {run} cycles.")
        cycles = [max(run, 1) for run in cycles]
    joint: npt.NDArray[np.float64] = counts / np.repeat(np.array(cycles, dtype=np.float64), lines)
    total = float(joint.sum())
    return np.divide(joint, total, out=joint) if total > 0 else None


def posterior(
    machine: BM1Machine,
    readings: Sequence[int | None],
    *,
    prior_address: int = 0,
    prior_codes: npt.NDArray[np.uint16] | None = None,
    target_count: int = 255,
    max_cycles: int = 2**17,
    bank: int = 0,
) -> npt.NDArray[np.float64]:
    """The posterior that one machine computes from one set of readings: no board, no process (thesis 2.1.2).

    Args:
        machine: What to run.
        readings: One address per sensor column, columns 1..N; None for a missing reading.
        prior_address: Row of the prior's table.
        prior_codes: uint16[lines], a written prior, where the machine takes one.
        target_count: The count at which the best line stops the machine.
        max_cycles: The cycle at which it stops at the latest.
        bank: Set of seeds; another one gives another draw of the same distribution.

    Returns:
        float64[lines] with the sum 1.

    Raises:
        NoPosteriorError: No line can count for these readings, or none did before `max_cycles`.
        StartError: A reading or another argument is not what this machine can take.
    """
    from machines.kernel import make_kernel

    if len(readings) != machine.parameters.sensors:
        raise StartError(
            f"There are {len(readings)} readings; this machine has {machine.parameters.sensors} sensor columns."
        )
    addresses = []
    for column, reading in enumerate(readings, start=1):
        missing = machine.parameters.missing_address(column)
        if reading == missing:
            raise StartError(
                f"The reading of column {column} is {reading}, the address that stands for a missing one: "
                "give None for that."
            )
        addresses.append(missing if reading is None else reading)
    kernel = make_kernel(machine)
    reason = kernel.start(
        Start(
            addresses=tuple(addresses),
            prior_address=prior_address,
            prior_codes=prior_codes,
            target_count=target_count,
            max_cycles=max_cycles,
            bank=bank,
        )
    )
    joint = joint_posterior([kernel.counts], [kernel.cycles])
    if joint is None:
        cause = (
            "every line has a code 0 among these readings' codes"
            if reason is StopReason.IMPOSSIBLE
            else f"no line counted in {kernel.cycles} cycles"
        )
        raise NoPosteriorError(f"There is no posterior: {cause}.")
    return joint
