"""The memories of a BM2, with a MIF for each: the tables of its CDEs, the seeds of each board, random numbers (thesis 2.1.3)."""

from collections.abc import Iterator, Sequence
from functools import partial

from machines.bm2 import BM2Machine
from machines.parameters import RngKind
from machines.rng import random_numbers, sequencer_seed
from pcie_shim.programming_file import Image
from toolchain.outputs.memories import Memory, rng_table_memory, seed_width


def bm2_memories(images: Sequence[Image]) -> tuple[Memory, ...]:
    """Return the tables, which all boards share, and then the seeds board by board.

    Generators that exist only in emulation (`rng = ideal`) have no memories.
    """
    machine = images[0].machine
    found = list(_cdes(machine))
    for board, image in enumerate(images):
        found += _seeds(image.machine, f"board{board}_")
    if machine.rng_table is not None:
        found.append(rng_table_memory(machine.rng_table, machine.parameters.prob_bits))
    return tuple(found)


def _cdes(machine: BM2Machine) -> Iterator[Memory]:
    parameters, digits = machine.parameters, len(str(machine.parameters.cdes - 1))
    for at, (factor, table) in enumerate(zip(parameters.factors, machine.tables, strict=True)):
        bits = parameters.factor_bits(at)
        if not bits:  # all of its variables have one value
            continue
        yield Memory(
            name=f"cde{at:0{digits}d}.mif",
            width=parameters.prob_bits,
            depth=table.size,
            words=partial(map, int, table),
            comments=(
                f"CDE {at}, of the variables {_listed(factor)}, which are the bits {_listed(bits)} of the state",
                f"address = j * {1 << len(bits) - 1} + the other bits, for the pointed bit number j of these",
            ),
        )


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def _seeds(machine: BM2Machine, prefix: str) -> Iterator[Memory]:
    parameters = machine.parameters
    banks = range(parameters.rng_banks)
    if parameters.rng is RngKind.IDEAL:
        return
    numbers = random_numbers(machine)
    yield Memory(
        name=f"{prefix}rng_seeds.mif",
        width=seed_width(machine),
        depth=parameters.rng_banks * parameters.cdes,
        words=lambda: (int(word) for bank in banks for word in numbers.restart(bank)),
        comments=(
            f"where the generators ({parameters.rng}) start",
            f"address = bank * {parameters.cdes} + CDE",
        ),
    )
    yield Memory(
        name=f"{prefix}sequencer_seeds.mif",
        width=16,
        depth=parameters.rng_banks,
        words=lambda: (sequencer_seed(parameters, bank) for bank in banks),
        comments=("where the generator (lfsr16) of the random sequencer starts", "address = bank"),
    )
