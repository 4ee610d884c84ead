"""Bayesian machines, emulated bit for bit, without sockets and files.

- `machines.posterior` computes a BM1's posterior in one call, for example in a notebook.
- `make_kernel` and `make_bm2_kernel` return the running machine of a board.
- `machines.bm1` and `machines.bm2` define the machines.
- `machines.reference` and `machines.bm2_reference` run a machine cycle by cycle.
- `machines.fast`, `machines.bm2_fast` and `machines.bm2_chains` get equal results faster, with numba.
- `machines.kind` is the interface for all other packages.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from machines.bm1 import BM1Machine
    from machines.bm2 import BM2Machine
    from machines.bm2_kernel import BM2Kernel
    from machines.kernel import BM1Kernel
    from machines.kind import MachineKind

FAST_CODES_MAX: Final = 2**24
"""Maximum value of `columns * 2**prob_bits` for the fast kernel. The kernel has a table of this size."""


def make_kernel(machine: "BM1Machine", *, boards: int = 1) -> "BM1Kernel":
    """Return the fastest kernel that can run the machine.

    `boards` is the number of kernels that share the usual cache size for random bits. Each kernel gets an equal share.
    """
    parameters = machine.parameters
    codes = parameters.columns << parameters.prob_bits
    if parameters.shared and parameters.rng.lfsr_bits is not None and codes <= FAST_CODES_MAX:
        # only a process that runs such machines imports numba
        from machines.fast import KEPT_BYTES, FastBM1

        return FastBM1(machine, kept_bytes=KEPT_BYTES // boards)
    from machines.reference import ReferenceBM1

    return ReferenceBM1(machine)


def make_bm2_kernel(machine: "BM2Machine") -> "BM2Kernel":
    """Return the fastest kernel that can run the machine."""
    if machine.parameters.rng.lfsr_bits is not None:
        from machines.bm2_fast import FastBM2

        return FastBM2(machine)
    from machines.bm2_reference import ReferenceBM2

    return ReferenceBM2(machine)


def warm_up() -> None:
    """Load the fast kernels before the first frame, or compile them if Numba's cache on disk does not have them.

    Processes that are forked afterwards inherit the loaded kernels.
    """
    from machines import bm2_fast, fast

    fast.warm_up()
    bm2_fast.warm_up()
    for kind in KINDS.values():
        kind()


def _bm1() -> "MachineKind":
    from machines.bm1_kind import BM1

    return BM1


def _bm2() -> "MachineKind":
    from machines.bm2_kind import BM2

    return BM2


KINDS: Final[dict[str, Callable[[], "MachineKind"]]] = {"BM1": _bm1, "BM2": _bm2}
"""Functions that import and return a kind of machine, by the kind's name. Importing a kind also imports NumPy."""


def kind_of(parameters: object) -> "MachineKind":
    """Return the kind of a machine with these parameters."""
    return next(
        kind for kind in (each() for each in KINDS.values()) if isinstance(parameters, kind.parameters)
    )
