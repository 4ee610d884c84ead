"""Rates and latencies of PCIe and USB/JTAG, from which the transfer times of a link are modelled."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final


@dataclass(frozen=True, slots=True)
class LinkFigures:
    """Figures of a kind of link.

    Attributes:
        mbps: Rate in 10^6 bits per second.
        latency_us: Latency of a transfer in one direction in microseconds, without the time for the bits.
        shared: True if one wire connects all boards. Only one board can then transfer at a time.
    """

    mbps: float
    latency_us: float
    shared: bool

    def seconds(self, size: int, transfers: int = 1) -> float:
        """Return the seconds that `size` bytes take in `transfers` transfers, one after another."""
        return 8e-6 * size / self.mbps + 1e-6 * transfers * self.latency_us


class LinkRate(StrEnum):
    """The kinds of links whose transfer times can be modelled."""

    NONE = "none"
    PCIE_GEN2 = "pcie-gen2"
    JTAG = "jtag"


WIRES: Final[Mapping[str, LinkFigures]] = {
    # Thesis 2.3: 20,800 Mbps, measured with the vendor's diagnostics. A read of a device takes about 1 us there and
    # back (Neugebauer et al., "Understanding PCIe performance for end host networking", SIGCOMM 2018). Each board has
    # lanes of its own.
    LinkRate.PCIE_GEN2: LinkFigures(20_800, 0.5, shared=False),
    # Thesis 2.3: at most 24 Mbps. A transfer waits for the next micro-frame of high-speed USB, 125 us (USB 2.0
    # specification, 8.4.3). JTAG is a chain: one cable for all boards, and one transfer at a time.
    LinkRate.JTAG: LinkFigures(24, 125, shared=True),
}
