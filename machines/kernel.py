"""Which kernel runs a machine: the fast one where it can, else the reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

from machines.errors import MachineError
from machines.reference import ReferenceBM1

if TYPE_CHECKING:
    from machines.bm1 import BM1Kernel, BM1Machine


def make_kernel(machine: BM1Machine) -> BM1Kernel:
    """A kernel for a machine; counts, cycles and states are the same to the bit whichever it is."""
    # Here, not above: numba is loaded by who runs machines, not by who describes them.
    from machines.fast import FastBM1

    try:
        return FastBM1(machine)
    except MachineError:
        return ReferenceBM1(machine)


def warm_up() -> None:
    """Load (the first time: compile) the fast kernel, so that no frame waits for it."""
    from machines import fast

    fast.warm_up()
