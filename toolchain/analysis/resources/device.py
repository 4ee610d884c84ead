"""FPGAs of boards, with their resources and the usable share of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from toolchain.errors import BuildError


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """An FPGA and its board; a design that needs more than the share `usable` cannot be placed and routed."""

    name: str
    title: str
    alms: int
    registers_per_alm: int
    blocks: int
    usable: float = 0.8
    hard_pcie: bool = True


DEVICES: Final = {
    device.name: device
    for device in (
        Device(
            name="proce-v-d8",
            title="Gidel Proce V D8 (Stratix V GS D8)",
            alms=262_400,
            registers_per_alm=4,
            blocks=2_567,
        ),
    )
}
"""The devices for `--device`."""


def device_named(name: str) -> Device:
    """Return a device by its name, or raise a BuildError."""
    try:
        return DEVICES[name]
    except KeyError:
        raise BuildError(f"--device {name}: expected one of {', '.join(DEVICES)}") from None
