"""The design of a BM2 for a network: its plan, its size limits, and one machine per board (thesis 2.1.3)."""

from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from machines import KINDS
from machines.bm2 import CHAINS_MAX, FACTOR_BITS_MAX, BM2Machine, BM2Parameters, start_state
from machines.errors import MachineError, ParameterError
from machines.parameters import RngKind
from pcie_shim import register_map as rm
from toolchain.building.machine import (
    BoardLayout,
    LineBlock,
    check_seeds,
    fitted_layout,
    machine_options,
    option,
)
from toolchain.building.options import BuildOptions, refused_parameter
from toolchain.deployment import BM2Section
from toolchain.errors import BuildError, counted
from toolchain.models.network import NetworkModel
from toolchain.outputs.mif import random_table

_MOST_CODES: Final = 1 << 27
"""Maximum number of codes in the tables of all CDEs, 2 bytes each."""

BM2_KEYS: Final = tuple(key for key in BM2Section.model_fields if key in BM2Parameters.__dataclass_fields__)
"""The names of the BM2's parameters that are also keys of `[machine]` in `deployment.toml`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BM2Plan:
    """The plan of a BM2 for a model. The plan contains no tables."""

    kind: ClassVar = "BM2"
    why: str
    """The reason why the machine is a BM2, as a clause."""
    model: NetworkModel
    options: BuildOptions
    parameters: BM2Parameters
    """The parameters of the first board. Other boards differ only in `chain`, the index of the board."""
    target_count: int
    """The number of samples of each board."""
    max_cycles: int
    """The maximum number of cycles of a frame, as a safety stop. It also limits how long the host waits for a board."""


def plan_bm2(model: NetworkModel, options: BuildOptions, why: str = "it was asked for") -> BM2Plan:
    """Return the plan of a BM2, or raise a BuildError if the network is too large or an option is not possible."""
    _check_sizes(model)
    place = {name: at for at, name in enumerate(model.names)}
    if not 1 <= options.partitions <= CHAINS_MAX:
        raise BuildError(f"--partitions {options.partitions}: expected 1 to {CHAINS_MAX} chains")
    try:
        parameters = BM2Parameters(
            cardinalities=model.cardinalities,
            factors=tuple(tuple(place[name] for name in term.scope) for term in model.factors),
            searched=tuple(place[each.label] for each in model.searched),
            known=tuple(place[name] for name in model.known),
            chains=options.partitions,
            **machine_options(options, BM2_KEYS),
        )
        KINDS["BM2"]().registers(parameters)  # refuses a stream that is too long
    except ParameterError as reason:
        raise refused_parameter(reason) from reason
    target_count, max_cycles = (option(key, options, BM2Section) for key in ("target_count", "max_cycles"))
    if options.max_cycles is None:  # a move takes 3 to 6 cycles in the mean, unless zeros are clipped
        moves = (parameters.burn_in + target_count) * parameters.state_bits
        max_cycles = max(max_cycles, 64 * moves)
    return BM2Plan(
        why=why,
        model=model,
        options=options,
        parameters=parameters,
        target_count=target_count,
        max_cycles=max_cycles,
    )


def _check_sizes(model: NetworkModel) -> None:
    """Raise a BuildError that names the largest factor or variable if a factor's table or the results are too large."""
    bits = {each.name: (each.size - 1).bit_length() for each in model.symbols}
    widths = [sum(bits[name] for name in term.scope) for term in model.factors]
    codes = [width << width >> 1 for width in widths]
    widest = max(range(len(codes)), key=codes.__getitem__)
    too_wide = widths[widest] > FACTOR_BITS_MAX
    if too_wide or sum(codes) > _MOST_CODES:
        limit = (
            f"{FACTOR_BITS_MAX} bits"
            if too_wide
            else f"{_MOST_CODES} codes of all CDEs, which need {sum(codes)}"
        )
        raise BuildError(
            f"{model.titles[widest]} is over {widths[widest]} bits, so its CDE needs {codes[widest]} codes; the maximum "
            f"is {limit}: give its variables fewer values, or fix one with --given"
        )
    room, words = rm.RESULTS.words, sum(1 << width for width in bits.values())
    joint = 1 << sum(bits[each.label] for each in model.searched)
    if words + joint > room:
        largest = max(model.symbols, key=lambda each: each.size)
        most = 1 << bits[largest.name]
        if joint > words:
            advice = "search fewer variables"
        elif 2 * most > words:
            advice = f"give {largest.name} fewer values"
        else:
            advice = f"ask about fewer than {len(bits)} variables, or fix some with --given"
        raise BuildError(
            f"the results of {model.name} are {words} words of histograms ({most} of {largest.name} with {largest.size} "
            f"values) and {joint} for the searched variables together, but the register map has room for {room}: {advice}"
        )


def chain_machines(plan: BM2Plan) -> tuple[BM2Machine, ...]:
    """Return each board's machine, with equal tables but its own seeds. Raise a BuildError if no state is possible."""
    parameters, table = plan.parameters, plan.options.rng_table
    if table is None and parameters.rng is RngKind.TABLE:
        table = random_table(parameters.prob_bits)
    try:
        first = BM2Machine.from_factors(parameters, [term.table for term in plan.model.factors], table)
        if start_state(first, {}) is None:
            raise BuildError(f"{plan.model.name}: the given values are impossible together")
    except MachineError as reason:
        raise BuildError(f"{plan.model.name}: {str(reason).rstrip('.')}") from reason
    return tuple(
        BM2Machine(replace(parameters, chain=chain), first.tables, first.supports, first.rng_table)
        for chain in range(parameters.chains)
    )


def clipped(factor: NDArray[np.float64], prob_bits: int) -> tuple[int, int, int]:
    """Count the odds in a factor. Return three counts: clipped odds, odds clipped because of a zero, and all odds.

    Odds compare two values of one variable, with all other variables unchanged. The binary codes of the two values
    differ in one bit. Odds are clipped if they are too extreme for a probability code.
    """
    clips = zeros = count = 0
    for axis, size in enumerate(factor.shape):
        for bit in (1 << k for k in range((size - 1).bit_length())):
            low = [code for code in range(size) if not code & bit and code | bit < size]
            zero, one = np.take(factor, low, axis), np.take(factor, [code | bit for code in low], axis)
            both = zero + one
            share = np.divide(np.minimum(zero, one), both, out=np.ones_like(both), where=both > 0)
            clips += int((share < 0.5 / 2**prob_bits).sum())
            zeros += int((share == 0).sum())
            count += both.size
    return clips, zeros, count


def chain_layout(parameters: BM2Parameters, interface: tuple[int, int] | None) -> BoardLayout:
    """Return the layout of boards with one chain each.

    Raises:
        BuildError: A board has too many seeds, or the registers that a board uses do not fit the interface.
    """
    check_seeds(parameters)
    what = (
        f"a state of {counted(parameters.state_bits, 'bit')}, {parameters.histogram_words} words of histograms and "
        f"{parameters.joint_words} of the searched variables"
    )
    blocks = tuple(LineBlock(chain, 1) for chain in range(parameters.chains))
    return fitted_layout(blocks, KINDS["BM2"]().registers(parameters), interface, what)
