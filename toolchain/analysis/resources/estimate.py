"""Resources of a BM1 on a board's FPGA: logic, memories and PCIe controller.

Tables are memories, so that their content can be changed without a new compilation.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from toolchain.analysis.resources.logic import Logic, logic_of
from toolchain.analysis.resources.table_memories import MLAB_ALMS, MLAB_SHARE, Memories, place_memories
from toolchain.errors import BuildError
from toolchain.outputs.mif import LENGTH

if TYPE_CHECKING:
    from machines.parameters import BM1Parameters
    from toolchain.analysis.resources.device import Device

SOFT_PCIE_ELEMENTS: Final = (8_000, 30_000)
"""Minimum and maximum number of logic elements of a soft PCIe controller (thesis 2.3)."""

ELEMENTS_PER_ALM: Final = 2.65
"""Number of logic elements per ALM according to the vendor."""


class Pcie(StrEnum):
    """The kind of PCIe controller."""

    HARD = "hard"
    """A block of the device, as in the thesis: no logic."""
    SOFT = "soft"
    """Logic: 8,000 to 30,000 elements."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Resources of a machine on an FPGA; `pcie_alms` are the minimum and maximum of the PCIe controller."""

    device: Device
    logic: Logic
    memories: Memories
    pcie: Pcie
    pcie_alms: tuple[float, float]

    @property
    def alms(self) -> float:
        """All ALMs: logic, registers that don't fit into its ALMs, tables, and the largest PCIe controller."""
        logic = max(self.logic.alms, self.logic.registers / self.device.registers_per_alm)
        return logic + self.memories.alms + self.pcie_alms[1]

    @property
    def alm_share(self) -> float:
        """Share of the device's ALMs."""
        return self.alms / self.device.alms

    @property
    def block_share(self) -> float:
        """Share of the device's memory blocks."""
        return self.memories.blocks / self.device.blocks

    @property
    def mlab_share(self) -> float:
        """Share of the device's memory LABs."""
        return self.memories.mlabs * MLAB_ALMS / (self.device.alms * MLAB_SHARE)

    @property
    def fits(self) -> bool:
        """True if the machine can be placed and routed."""
        return self.why_not == ""

    @property
    def why_not(self) -> str:
        """The insufficient resource, as a clause; empty if the machine fits."""
        usable = self.device.usable
        if self.memories.blocks > usable * self.device.blocks:
            return f"it takes {self.memories.blocks:,} memory blocks, and there are {self.device.blocks:,}"
        if self.alm_share > usable:
            return f"it takes {self.alms:,.0f} ALMs, and {usable * self.device.alms:,.0f} of {self.device.alms:,} can be used"
        if self.mlab_share > 1:
            mlabs = self.device.alms * MLAB_SHARE / MLAB_ALMS
            return f"its tables take {self.memories.mlabs:,} memory LABs, and there are {mlabs:,.0f}"
        return ""


def estimate(
    parameters: BM1Parameters,
    device: Device,
    *,
    pcie: Pcie = Pcie.HARD,
    table_length: int = LENGTH,
) -> Estimate:
    """Return the resources of a machine on a device, or raise a BuildError if it lacks a part."""
    if pcie is Pcie.HARD and not device.hard_pcie:
        raise BuildError(f"{device.title} has no hard PCIe controller; use --soft-pcie")
    soft = tuple(elements / ELEMENTS_PER_ALM for elements in SOFT_PCIE_ELEMENTS)
    return Estimate(
        device=device,
        logic=logic_of(parameters, table_length=table_length),
        memories=place_memories(parameters, device, table_length),
        pcie=pcie,
        pcie_alms=(0.0, 0.0) if pcie is Pcie.HARD else (soft[0], soft[1]),
    )
