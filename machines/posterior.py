"""Posteriors from the counts of all boards of a model. The function `posterior` also runs the machines."""

from collections.abc import Sequence, Sized
from typing import TypeAlias, cast

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine, Start, StopReason
from machines.errors import MachineError, NoPosteriorError, StartError
from machines.parameters import BM1Parameters, SensorMode


def joint_posterior(
    counts: Sequence[npt.NDArray[np.uint32]], cycles: Sequence[int]
) -> npt.NDArray[np.float64] | None:
    """Return the posterior over the lines of all boards, normalised jointly (thesis equation 2.3).

    The probability of a line is proportional to the line's count divided by the cycles of its board. Each board stops
    at its own cycle, so counts must not be normalised for each board separately. If no line of a board can count, the
    board has 0 cycles, and its lines get the probability 0.

    Args:
        counts: Counts of each board, uint32[lines of the board], in the order of the model's lines.
        cycles: Number of cycles that each board ran.

    Returns:
        float64[all lines], or None if every count is 0.

    Raises:
        MachineError: The numbers of counts and of cycles differ, or a board has counts without cycles.
    """
    if len(counts) != len(cycles):
        raise MachineError(f"There are counts of {len(counts)} boards and cycles of {len(cycles)}.")
    if not counts:
        return None
    return posterior_of_lines(np.concatenate(counts), [len(count) for count in counts], cycles)


def posterior_of_lines(
    counts: npt.NDArray[np.uint32], lines: Sequence[int], cycles: Sequence[int]
) -> npt.NDArray[np.float64] | None:
    """Return the same posterior as `joint_posterior`, from the concatenated counts of all boards, uint32[all lines].

    Raises a MachineError if a board has counts without cycles.
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


def posteriors_of_replicas(
    counts: Sequence[npt.NDArray[np.uint32]], cycles: Sequence[Sequence[int]]
) -> npt.NDArray[np.float64] | None:
    """Return each replica's `joint_posterior`, float64[replicas, all lines], or None if no replica has a posterior.

    Each board has counts, uint32[replicas, lines], and a number of cycles for each replica. The row of a replica
    without a posterior contains zeros.
    """
    joints = [
        joint_posterior([own[replica] for own in counts], [own[replica] for own in cycles])
        for replica in range(len(counts[0]))
    ]
    if all(joint is None for joint in joints):
        return None
    lines = sum(own.shape[1] for own in counts)
    return np.stack([np.zeros(lines) if joint is None else joint for joint in joints])


Reading: TypeAlias = int | Sequence[int] | npt.NDArray[np.integer] | None
"""Reading of a sensor column: an address, or None if missing. With inputs per cell, an address or code per line."""


def posterior(
    machine: BM1Machine | Sequence[BM1Machine],
    readings: Sequence[Reading] | Sequence[Sequence[Reading]] | npt.NDArray[np.integer],
    *,
    prior_address: int | tuple[int, ...] = 0,
    prior_codes: npt.NDArray[np.uint16] | None = None,
    target_count: int = 255,
    max_cycles: int = 2**17,
    bank: int = 0,
) -> npt.NDArray[np.float64]:
    """Run a machine in this process, without boards, and return the posterior for its readings (thesis 2.1.2).

    Args:
        machine: The machine to run, or a list of the machines of all boards, in the order of their lines. Machines
            in a list get the same readings, and each stops at its own cycle.
        readings: One address per sensor column, columns 1..N, or None for a missing reading. If the machine has inputs
            per cell (`sensor_mode`), a reading is a row with one address or one code per line. If the machine has
            several replicas, pass a list with the readings of each replica. If no reading is missing, one array of
            integers of shape `machine.parameters.input_shape` is accepted instead.
        prior_address: Row of the prior's table. If the machine has replicas, an integer is the row of all replicas,
            and a tuple has one row for each replica.
        prior_codes: uint16[lines], a written prior, if the machine uses one. An array uint16[replicas, lines] has one
            prior for each replica.
        target_count: The count at which the best line stops the machine.
        max_cycles: Maximum number of cycles.
        bank: Index of a set of seeds. Each set gives another draw from the same distribution.

    Returns:
        float64[lines] with the sum 1, or float64[replicas, lines] for several replicas. The row of a replica without
        a posterior contains zeros.

    Raises:
        NoPosteriorError: All counts of all replicas are 0 for these readings.
        StartError: A reading or another argument does not fit the machine.
    """
    from machines import make_kernel

    if not isinstance(readings, Sized):
        raise StartError(f"Readings must be a list with one for each sensor column, not {readings!r}.")
    machines = [machine] if isinstance(machine, BM1Machine) else machine
    parameters = machines[0].parameters
    sets = [readings] if parameters.replicas == 1 else readings
    if len(sets) != parameters.replicas:
        raise StartError(
            f"There are readings of {len(sets)} machines; this machine has {parameters.replicas} replicas."
        )
    kernels = []
    for each in machines:
        inputs = [_inputs(each.parameters, cast("Sequence[Reading]", own)) for own in sets]
        kernels.append(make_kernel(each))
        kernels[-1].start(
            Start(
                addresses=np.reshape(inputs, each.parameters.input_shape),
                prior_address=prior_address,
                prior_codes=prior_codes,
                target_count=target_count,
                max_cycles=max_cycles,
                bank=bank,
            )
        )
    counts = [kernel.counts.reshape(parameters.replicas, -1) for kernel in kernels]
    rows = posteriors_of_replicas(counts, [kernel.replica_cycles for kernel in kernels])
    if rows is None:
        cause = (
            "these readings select a code 0 on every line"
            if all(kernel.reason is StopReason.IMPOSSIBLE for kernel in kernels)
            else f"all counts are 0 after {max(kernel.cycles for kernel in kernels)} cycles"
        )
        raise NoPosteriorError(f"There is no posterior: {cause}.")
    return rows[0] if parameters.replicas == 1 else rows


def _inputs(parameters: BM1Parameters, readings: Sequence[Reading]) -> npt.NDArray[np.integer]:
    """Return the inputs of one replica: int64[sensors], or int64[sensors, lines]."""
    if len(readings) != parameters.sensors:
        raise StartError(
            f"There are {len(readings)} readings; this machine has {parameters.sensors} sensor columns."
        )
    per_cell = parameters.sensor_mode is not SensorMode.COLUMN
    shape = (parameters.lines,) if per_cell else ()
    inputs = np.empty((parameters.sensors, *shape), dtype=np.int64)
    for column, reading in enumerate(readings, start=1):
        missing = parameters.missing_address(column)
        if reading is None:
            inputs[column - 1] = missing
            continue
        try:
            row = np.asarray(reading)
        except ValueError:  # rows of different lengths
            row = np.empty(0, dtype=object)
        if row.shape != shape or row.dtype.kind not in "ui":
            wanted = f"{parameters.lines} integers, one per line" if per_cell else "one integer"
            raise StartError(
                f"The reading of column {column} has the shape {row.shape} and holds {row.dtype}; "
                f"this machine takes {wanted}, or None."
            )
        # as a code, the top value is an ordinary probability: certainty
        if parameters.has_tables and (row == missing).any():
            raise StartError(
                f"The reading of column {column} is {missing}, the address of a missing reading: use None instead."
            )
        inputs[column - 1] = row
    return inputs
