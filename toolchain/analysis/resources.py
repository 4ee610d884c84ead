"""Resources and energy of a BM1 on the FPGAs of its boards, and the number of boards that the BM1 needs.

Tables are stored in memories, so new tables need no new compilation. Nothing here was measured on a board. Logic is
estimated. Energy is estimated from toggles of nets, and each toggle of any net costs the same energy. `ASSUMPTIONS`
lists the constants.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from machines.bm1 import BM1Machine
from machines.bm1_kind import BM1
from machines.parameters import REPLICAS_MAX, BM1Parameters
from pcie_shim.register_layout import interface_room
from toolchain.analysis.emulation import addressed_chances, one_replica
from toolchain.analysis.logic import MLAB_ALMS, MLAB_SHARE, Device, Logic, Memories, logic_of, place_memories
from toolchain.analysis.readings import Readings
from toolchain.building.machine import partition_lines
from toolchain.errors import BuildError
from toolchain.outputs.mif import LENGTH, table_length


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Estimated resources of a machine on an FPGA. The PCIe controller is a hard block, so it needs no logic."""

    device: Device
    logic: Logic
    memories: Memories

    @property
    def alms(self) -> float:
        """Number of ALMs: those of the memories, plus those for look-up tables or for registers, whichever are more."""
        logic = max(self.logic.alms, self.logic.registers / self.device.registers_per_alm)
        return logic + self.memories.alms

    @property
    def alm_share(self) -> float:
        """Share of the device's ALMs that the machine takes."""
        return self.alms / self.device.alms

    @property
    def block_share(self) -> float:
        """Share of the device's memory blocks."""
        return self.memories.blocks / self.device.blocks

    @property
    def fits(self) -> bool:
        """True if the device has enough usable resources."""
        return self.why_not == ""

    @property
    def why_not(self) -> str:
        """A clause that names the insufficient resource. It is empty if the machine fits."""
        usable = self.device.usable
        if self.memories.blocks > usable * self.device.blocks:
            room = math.floor(usable * self.device.blocks)
            return f"the machine takes {self.memories.blocks:,} memory blocks, but only {room:,} of {self.device.blocks:,} can be used"
        if self.alm_share > usable:
            return f"the machine takes {self.alms:,.0f} ALMs, but only {usable * self.device.alms:,.0f} of {self.device.alms:,} can be used"
        mlabs = self.device.alms * MLAB_SHARE / MLAB_ALMS
        if self.memories.mlabs > mlabs:
            return f"the machine's tables take {self.memories.mlabs:,} memory LABs, but there are only {mlabs:,.0f}"
        return ""


def estimate(
    parameters: BM1Parameters, device: Device, *, table_length: int = LENGTH, inputs: int = 0
) -> Estimate:
    """Return the resources of a machine on a device. Raises a BuildError if the machine exists only in emulation.

    `inputs` is the number of input words that the board's registers have. If `inputs` is smaller than the number of
    input words that the machine needs, the needed number is used. Results take no memory, because they are counters.
    """
    return Estimate(
        device=device,
        logic=logic_of(parameters, table_length=table_length, inputs=inputs),
        memories=place_memories(parameters, device, table_length, inputs),
    )


def _why_not(
    machine: BM1Parameters, device: Device, table_length: int, interface: tuple[int, int] | None
) -> str:
    """Return as a clause why a machine does not fit the device or the interface of a board, or "" if it fits.

    `interface` is the value of `--interface` (inputs, results). None means the most that the register map has room for.
    """
    used = BM1.registers(machine)
    whose = "the map" if interface is None else "the interface"
    for what, needed, room in zip(
        ("input", "result"),
        (used.input_words, used.result_words),
        interface or interface_room(used),
        strict=True,
    ):
        if needed > room:
            return f"the machine takes {needed:,} {what} registers, but {whose} has only {room:,}"
    return estimate(machine, device, table_length=table_length, inputs=(interface or (0, 0))[0]).why_not


def most_replicas(
    board: BM1Parameters,
    device: Device,
    *,
    table_length: int = LENGTH,
    interface: tuple[int, int] | None = None,
) -> tuple[int, str]:
    """Return how many replicas of a machine fit a board, at least 0, and a clause that says why no more fit."""

    def why_not(replicas: int) -> str:
        return _why_not(replace(board, replicas=replicas), device, table_length, interface)

    most = bisect_left(range(1, REPLICAS_MAX + 1), True, key=lambda replicas: why_not(replicas) != "")
    if most == REPLICAS_MAX:
        return most, "a board has at most that many"
    return most, f"with {most + 1}, {why_not(most + 1)}"


def boards_needed(
    parameters: BM1Parameters,
    device: Device,
    *,
    table_length: int = LENGTH,
    interface: tuple[int, int] | None = None,
) -> tuple[int, str]:
    """Return the minimum number of boards for a machine, and sentences that explain the number.

    Raises:
        BuildError: Not even one line fits a board.
    """

    def why_not(lines: int) -> str:
        return _why_not(replace(parameters, lines=lines), device, table_length, interface)

    def replicas_on_a_board(lines: int) -> int:
        board = replace(parameters, lines=lines)
        return most_replicas(board, device, table_length=table_length, interface=interface)[0]

    most = bisect_left(range(1, parameters.lines + 1), True, key=lambda lines: why_not(lines) != "")
    if most == 0:
        fewer = replicas_on_a_board(1)
        change = f"--replicas {fewer} or fewer" if fewer else "narrower tables or another device"
        raise BuildError(f"not even one line fits a {device.title}: {why_not(1)}; use {change}")
    count = math.ceil(parameters.lines / most)
    largest = partition_lines(parameters.lines, count)[0].lines
    took = estimate(
        replace(parameters, lines=largest), device, table_length=table_length, inputs=(interface or (0, 0))[0]
    )
    share = f"{took.alms:,.0f} ALMs ({took.alm_share:.0%}) and {took.memories.blocks:,} memory blocks ({took.block_share:.0%})"
    if count == 1:
        return 1, f"All {parameters.lines} lines fit one {device.title}: {share}."
    boards = f"{count} boards" if count > 2 else "two boards"
    reason = f"One {device.title} is too small: {why_not(parameters.lines)}"
    why = (
        f"{parameters.lines} lines need {boards}. {reason}. With {largest} lines, a board takes {share}. "
        "This is an estimate, not a compilation."
    )
    if parameters.replicas > 1 and (whole := replicas_on_a_board(parameters.lines)):
        why += f" With --replicas {whole} or fewer, all lines fit one board."
    return count, why


CORE_VOLTAGE: Final = 0.9
"""Core voltage of a Stratix V in volts."""
NET_CAPACITANCE: Final = 1.2e-12
"""Assumed capacitance of a net with its routing, in farads."""
TOGGLE_J: Final = 0.5 * NET_CAPACITANCE * CORE_VOLTAGE**2
CLOCK_J: Final = 0.05e-12
"""Assumed energy that the clock of one register takes in a cycle, in joules."""
COMPARATOR_ACTIVITY: Final = 0.25
"""Assumed number of toggles per cycle of each look-up table and each carry inside a comparator."""
STATIC_W: Final = 2.0
"""Assumed leakage power of an FPGA, in watts."""

ASSUMPTIONS: Final = (
    (
        f"a toggle of a net costs C V^2 / 2 with C = {NET_CAPACITANCE * 1e12:g} pF and V = {CORE_VOLTAGE:g} V, that is "
        f"{TOGGLE_J * 1e12:.2f} pJ"
    ),
    f"a register's clock costs {CLOCK_J * 1e12:g} pJ per cycle",
    "a random bit toggles every other cycle, at every cell that it reaches",
    f"nets inside a comparator toggle {COMPARATOR_ACTIVITY:g} times per cycle",
    "a cell's bit of probability p toggles 2 p (1 - p) times, a counter twice and its comparison once for each count",
    f"an FPGA leaks {STATIC_W:g} W; memories and the PCIe link are not included",
)
_FRAMES: Final = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Energy:
    """The energy model for all boards together.

    Attributes:
        toggles: Number of toggles per cycle.
        cycle_j: Energy per cycle without leakage, in joules.
        static_w: Leakage power in watts.
    """

    toggles: float
    cycle_j: float
    static_w: float

    def frame_j(self, cycles: float, clock_hz: float) -> tuple[float, float]:
        """Return the energy of a frame in joules: first for toggles and clocks, then for leakage."""
        return cycles * self.cycle_j, cycles / clock_hz * self.static_w


def energy(machines: Sequence[BM1Machine], readings: Readings) -> Energy:
    """Return the energy model for all boards. Toggles are averaged over the first 50 frames of `readings`."""
    toggles = clocked = 0.0
    ends = np.cumsum([machine.parameters.lines for machine in machines]).tolist()
    for machine, end in zip(machines, ends, strict=True):
        p = machine.parameters
        logic = logic_of(p, table_length=table_length(machine))
        parts = {part.name: part for part in logic.parts}
        generators = parts["generators"]
        cells = p.replicas * p.lines * p.columns
        toggles += (generators.registers + generators.aluts) / 2
        toggles += cells * p.prob_bits / 2
        toggles += parts["cells"].aluts * COMPARATOR_ACTIVITY
        toggles += p.replicas * _stream_toggles(one_replica(machine), readings, slice(end - p.lines, end))
        clocked += sum(parts[each].registers for each in ("generators", "counters", "inputs", "control"))
    return Energy(
        toggles=toggles, cycle_j=toggles * TOGGLE_J + clocked * CLOCK_J, static_w=len(machines) * STATIC_W
    )


def _stream_toggles(machine: BM1Machine, readings: Readings, lines: slice) -> float:
    """Return the toggles per cycle of cells, ANDs, counters and their comparators, averaged over frames."""
    found = []
    for frame in range(min(len(readings), _FRAMES)):
        addresses, row = readings.of_machine(frame, machine)
        own = addresses if isinstance(addresses, tuple) else addresses[:, lines]
        chances = addressed_chances(machine, own, row)
        line = np.prod(chances, axis=0)
        bits = float((2 * chances * (1 - chances)).sum())
        found.append(bits + float((2 * line * (1 - line)).sum()) + 3 * float(line.sum()))
    return float(np.mean(found))
