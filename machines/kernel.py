"""Which kernel runs a machine: the fast one where it can, else the reference."""

from machines.bm1 import BM1Kernel, BM1Machine
from machines.reference import ReferenceBM1, ReferenceReplicas


def make_kernel(machine: BM1Machine) -> BM1Kernel:
    """A kernel for a machine; counts, cycles, reasons and states are the same to the bit whichever it is."""
    if machine.parameters.shared and machine.parameters.rng.lfsr_bits is not None:
        # Here, not above: numba is loaded by who runs such machines, not by who describes them.
        from machines.fast import FastBM1, FastReplicas

        return FastBM1(machine) if machine.parameters.replicas == 1 else FastReplicas(machine)
    return ReferenceBM1(machine) if machine.parameters.replicas == 1 else ReferenceReplicas(machine)


def warm_up() -> None:
    """Load (the first time: compile) the fast kernel, so that no frame waits for it.

    A process that is forked from one that has called this starts with it loaded.
    """
    from machines import fast

    fast.warm_up()
