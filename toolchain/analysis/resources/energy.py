"""Energy of a frame, by a model that counts toggles of nets and states its assumptions.

Nothing here was measured on a board. Toggles follow from the structure of the machine and from its codes; a
toggle costs the same on all nets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from machines.bm1 import Start, addressed_codes
from machines.encode import decode_code
from toolchain.analysis.accuracy.emulation import one_replica
from toolchain.analysis.resources.logic import logic_of
from toolchain.outputs.mif import table_length

if TYPE_CHECKING:
    from collections.abc import Sequence

    from machines.bm1 import BM1Machine
    from toolchain.analysis.accuracy.readings import Readings

CORE_VOLTAGE: Final = 0.9
"""Core voltage of a Stratix V in volts."""
NET_CAPACITANCE: Final = 1.2e-12
"""Assumed capacitance of a net with its routing, in farads."""
TOGGLE_J: Final = 0.5 * NET_CAPACITANCE * CORE_VOLTAGE**2
CLOCK_J: Final = 0.05e-12
"""Assumed energy for the clock of a register per cycle, in joules."""
COMPARATOR_ACTIVITY: Final = 0.25
"""Assumed toggles per cycle of a look-up table or a carry inside a comparator."""
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
        """Return the energy of a frame in joules: for toggles, and for leakage."""
        return cycles * self.cycle_j, cycles / clock_hz * self.static_w


def energy(machines: Sequence[BM1Machine], readings: Readings) -> Energy:
    """Return the energy model for all boards; activity is averaged over the first 50 frames of readings."""
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
        toggles=toggles,
        cycle_j=toggles * TOGGLE_J + clocked * CLOCK_J,
        static_w=len(machines) * STATIC_W,
    )


def _stream_toggles(machine: BM1Machine, readings: Readings, lines: slice) -> float:
    """Toggles of cells, ANDs, counters and their comparators, averaged over frames."""
    width = machine.parameters.prob_bits
    found = []
    for frame in range(min(len(readings), _FRAMES)):
        addresses, row = readings.of_machine(frame, machine)
        own = addresses if isinstance(addresses, tuple) else addresses[:, lines]
        start = Start(addresses=own, prior_address=row, target_count=1, max_cycles=1)
        chances = decode_code(addressed_codes(machine, start), width)
        line = np.prod(chances, axis=0)
        bits = float((2 * chances * (1 - chances)).sum())
        found.append(bits + float((2 * line * (1 - line)).sum()) + 3 * float(line.sum()))
    return float(np.mean(found))
