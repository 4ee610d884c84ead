"""Gibbs samplers of other projects, for comparison: that of pyAgrum, and THRML's block sampler on JAX."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

THRML_LOCK: Final = Path(__file__).with_name("thrml.lock")
CHAINS: Final = 64
"""Chains that THRML runs side by side."""
_LEAST: Final = 1e-30
"""The probability that replaces a zero of a table for THRML, whose weights are logarithms."""
Factor: TypeAlias = tuple[tuple[int, ...], NDArray[np.float64]]
"""The indices of a factor's variables, and the factor's table."""
Known: TypeAlias = Mapping[int, int]
"""The values of the known variables, by index."""


@dataclass(frozen=True, slots=True)
class Sampled:
    """Marginals by index of the unknown variable (none if only the speed counts), and the cost of the run.

    Sweeps and cycles are summed over all chains; only a BM2 sets `effective`, `cycles` and `stop`.
    """

    marginals: dict[int, NDArray[np.float64]]
    sweeps: int
    seconds: float
    effective: float = 0.0
    """The number of effective samples of the value that has the fewest."""
    cycles: int = 0
    stop: str = ""
    """The reason, if not all samples were drawn."""


def pyagrum_gibbs(
    pyagrum: Any, network: Any, names: Sequence[str], known: Known, *, sweeps: int, burn_in: int, limit: float
) -> Sampled:
    """Run pyAgrum's Gibbs sampler, variable after variable, for `sweeps` sweeps or at most `limit` seconds."""
    gibbs = pyagrum.GibbsSampling(network)
    gibbs.setEvidence({names[variable]: value for variable, value in known.items()})
    gibbs.setDrawnAtRandom(False)
    gibbs.setNbrDrawnVar(len(names))  # it takes at most the unknown ones, so an iteration is a sweep
    gibbs.setBurnIn(burn_in)
    gibbs.setMaxIter(sweeps)
    gibbs.setMaxTime(limit)
    gibbs.setPeriodSize(100)
    gibbs.setEpsilon(1e-300)  # no stop by accuracy
    gibbs.setMinEpsilonRate(1e-300)
    began = time.perf_counter()
    gibbs.makeInference()
    seconds = time.perf_counter() - began
    unknown = [variable for variable in range(len(names)) if variable not in known]
    marginals = {variable: gibbs.posterior(names[variable]).toarray() for variable in unknown}
    return Sampled(marginals, gibbs.nbrIterations(), seconds)


def thrml_gibbs(
    factors: Sequence[Factor],
    start: Sequence[int],
    known: Known,
    colours: Sequence[int],
    *,
    sweeps: int,
    burn_in: int,
) -> Sampled:
    """Run THRML's block Gibbs sampler with 64 chains of sweeps/64 sweeps, all from `start`.

    The compilation is not timed.

    Args:
        factors: The network.
        start: A possible state of the network: the value of each variable.
        known: The evidence.
        colours: The colour of each variable. Variables of one colour share no factor, and are drawn together.
        sweeps: The number of sweeps of all chains together, without the burn-in.
        burn_in: The number of first sweeps that each chain discards.
    """
    import jax
    from jax import numpy as jnp
    from thrml import Block, CategoricalNode
    from thrml.block_sampling import BlockGibbsSpec, sample_blocks
    from thrml.factor import FactorSamplingProgram
    from thrml.models.discrete_ebm import CategoricalEBMFactor, CategoricalGibbsConditional

    nodes = [CategoricalNode() for _ in start]
    sizes = {each: size for scope, table in factors for each, size in zip(scope, table.shape, strict=True)}
    alike: dict[tuple[int, ...], list[Factor]] = {}  # factors with tables of one shape
    for factor in factors:
        alike.setdefault(factor[1].shape, []).append(factor)
    energies = [
        CategoricalEBMFactor(
            [Block([nodes[scope[axis]] for scope, _ in each]) for axis in range(len(shape))],
            jnp.asarray(np.log(np.maximum([table for _, table in each], _LEAST)), jnp.float32),
        )
        for shape, each in alike.items()
    ]
    members: dict[tuple[int, int], list[int]] = {}  # of each block: variables of one colour and size
    for variable in sorted(set(sizes) - set(known), key=lambda each: (colours[each], sizes[each])):
        members.setdefault((colours[variable], sizes[variable]), []).append(variable)
    free: dict[int, list[Any]] = {}  # blocks that are drawn together
    for (colour, _), each in members.items():
        free.setdefault(colour, []).append(Block([nodes[variable] for variable in each]))
    clamped = [Block([nodes[variable] for variable in known])] if known else []
    values = [jnp.asarray(list(known.values()), jnp.uint8)] if known else []
    specification = BlockGibbsSpec(list(map(tuple, free.values())), clamped)
    conditionals = [CategoricalGibbsConditional(size) for _, size in members]
    program = FactorSamplingProgram(specification, conditionals, energies, [])

    def chain(key: Any, count: Any) -> Any:
        def sweep(number: Any, carried: Any) -> Any:
            states, _ = sample_blocks(
                jax.random.fold_in(key, number), list(carried[0]), values, program, [None] * len(members)
            )
            drawn = [
                old + (number >= burn_in) * jax.nn.one_hot(state, old.shape[1], dtype=jnp.int32)
                for old, state in zip(carried[1], states, strict=True)
            ]
            return states, drawn

        states = [jnp.asarray([start[variable] for variable in each], jnp.uint8) for each in members.values()]
        counts = [jnp.zeros((len(each), size), jnp.int32) for (_, size), each in members.items()]
        return jax.lax.fori_loop(0, burn_in + count, sweep, (states, counts))[1]

    keys = jax.random.split(jax.random.key(1), CHAINS)
    compiled = jax.jit(jax.vmap(chain, in_axes=(0, None))).lower(keys, 1).compile()
    began = time.perf_counter()
    found = jax.block_until_ready(compiled(keys, max(1, sweeps // CHAINS)))
    seconds = time.perf_counter() - began
    marginals = {}
    for each, counts in zip(members.values(), found, strict=True):
        for variable, row in zip(each, np.asarray(counts).sum(axis=0), strict=True):
            marginals[variable] = row / row.sum()
    return Sampled(marginals, max(1, sweeps // CHAINS) * CHAINS, seconds)
