"""The number of boards for a machine, according to FPGA resources and the register map."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from machines.parameters import SensorMode
from pcie_shim.programming_file import interface_room
from toolchain.analysis.resources.estimate import Pcie, estimate
from toolchain.building.machine import partition_lines
from toolchain.errors import BuildError
from toolchain.outputs.mif import LENGTH

if TYPE_CHECKING:
    from collections.abc import Callable

    from machines.parameters import BM1Parameters
    from toolchain.analysis.resources.device import Device
    from toolchain.analysis.resources.estimate import Estimate


def boards_needed(
    parameters: BM1Parameters,
    device: Device,
    *,
    largest_lines: int = 4096,
    pcie: Pcie = Pcie.HARD,
    table_length: int = LENGTH,
) -> tuple[int, str]:
    """Return the minimum number of boards for a machine, and the reason as a sentence, or raise a BuildError."""

    def on(lines: int) -> Estimate:
        return estimate(replace(parameters, lines=lines), device, pcie=pcie, table_length=table_length)

    room = interface_room(parameters)
    largest_lines = min(largest_lines, room[1] // parameters.replicas)
    if parameters.sensor_mode is not SensorMode.COLUMN and parameters.sensors:
        largest_lines = min(largest_lines, room[0] // (parameters.replicas * parameters.sensors))
    most = _most_lines(lambda lines: on(lines).fits, min(parameters.lines, largest_lines))
    if most == 0 and largest_lines == 0:
        raise BuildError(
            f"not even one line of {parameters.replicas} replicas fits the register map: it has room for {room[0]} inputs "
            f"and {room[1]} results; use fewer --replicas"
        )
    if most == 0:
        raise BuildError(
            f"not even one line fits a {device.title}: {on(1).why_not}; use narrower tables or another device"
        )
    count = math.ceil(parameters.lines / most)
    largest = partition_lines(parameters.lines, count)[0].lines
    took = on(largest)
    share = f"{took.alms:,.0f} ALMs ({took.alm_share:.0%}) and {took.memories.blocks:,} memory blocks ({took.block_share:.0%})"
    if count == 1:
        return 1, f"All {parameters.lines} lines fit one {device.title}: {share}."
    if largest_lines < parameters.lines and on(largest_lines).fits:
        reason = f"the register map has room for {largest_lines} lines per board"
    else:
        reason = f"on one {device.title} {on(parameters.lines).why_not}"
    boards = f"{count} boards" if count > 2 else "two boards"
    return count, (
        f"{parameters.lines} lines need {boards}: {reason}; {largest} lines per board take {share}. An estimate, not a "
        "compilation."
    )


def _most_lines(fits: Callable[[int], bool], highest: int) -> int:
    """Return the maximum number of lines that fit, 0 to `highest`, by bisection."""
    low, high = 0, highest + 1
    while high - low > 1:
        middle = (low + high) // 2
        if fits(middle):
            low = middle
        else:
            high = middle
    return low
