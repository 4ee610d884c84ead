"""Speed of the fast kernels on one core: a BM1 alone, and a BM2 in comparison with other Gibbs samplers.

sprinkler (the case study), wet grass ──┬──▶ BM2 with one chain
alarm (of pgmpy), nothing known ────────┼──▶ BM2 with many chains
                                        ├──▶ plain Gibbs sampler in numba
                                        ├──▶ Gibbs sampler of pyAgrum
                                        └──▶ Gibbs sampler of THRML (only with --thrml)
"""

import argparse
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Final, TypeAlias, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from casestudies.sprinkler.model import model as sprinkler
from machines.bm1 import BM1Machine, Start
from machines.bm2 import BM2Machine, unpack
from machines.bm2_chains import Chains
from machines.bm2_fast import FastBM2
from machines.fast import FastBM1
from machines.parameters import BM1Parameters, Sequencer
from scripts.benches.networks import factors_of, machine_of, start_of
from scripts.benches.samplers import CHAINS, THRML_LOCK, Factor, Known, Sampled, pyagrum_gibbs, thrml_gibbs
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.verifications.installation import use_packages
from scripts.verifications.networks import EXAMPLES, LOCK
from toolchain.models import JointDistribution
from toolchain.models.distribution import Distribution
from toolchain.networks import read_network

SINGLE_AIMS: Final = {"sprinkler": 6e7, "alarm": 2e7}
"""Minimum number of cycles per second of one chain, by network."""
RATIO_AIMS: Final = {"sprinkler": 10, "alarm": 2}
"""Minimum ratio of the cycles per second of many chains to those of one chain."""
MANY: Final = {"sprinkler": 512, "alarm": 32}
"""Number of chains of a network that run at once, for comparison with one chain."""
TURNS: Final = 3
"""Number of measurements of each alternative. The fastest counts, because other processes only slow programs down."""
BURN_IN: Final = 100
Ints: TypeAlias = NDArray[np.int64]
Floats: TypeAlias = NDArray[np.float64]


def bm1(cycles: int) -> Sampled:
    """Run a BM1 of 1024 lines and 7 columns, from another bank each time, for some cycles."""
    random = np.random.default_rng(1)
    codes = [random.integers(0, 255, (4, 1024), dtype=np.uint16) for _ in range(6)]
    for table in codes:
        table[-1] = 255
    parameters = BM1Parameters(lines=1024, sensor_bits=(2,) * 6, counter_bits=32)
    kernel = FastBM1(
        BM1Machine(parameters, np.full((1, 1024), 255, dtype=np.uint16), tuple(codes)), kept_bytes=0
    )
    began = time.process_time()
    kernel.start(Start(addresses=(0,) * 6, target_count=2**32 - 1, max_cycles=cycles))
    return Sampled({}, 0, time.process_time() - began, cycles=kernel.cycles)


def _sweep(
    values: Ints,
    unknown: Ints,
    sizes: Ints,
    first: Ints,
    held: Ints,
    tables: Floats,
    counts: Ints,
    sweeps: int,
) -> None:
    """Draw each unknown variable in turn, from the product of its factors."""
    weights = np.empty(sizes.max())
    for _ in range(sweeps):
        for variable in unknown:
            total = 0.0
            for value in range(sizes[variable]):
                values[variable] = value
                weight = 1.0
                for factor in range(first[variable], first[variable + 1]):
                    place = held[factor, 0]
                    for i in range(held[factor, 1]):
                        place += held[factor, 2 + 2 * i] * values[held[factor, 3 + 2 * i]]
                    weight *= tables[place]
                total += weight
                weights[value] = total
            drawn = np.random.random() * total  # noqa: NPY002 - numba's own generator
            value = 0
            while weights[value] <= drawn:
                value += 1
            values[variable] = value
        for variable in unknown:
            counts[variable, values[variable]] += 1


_compiled_sweep = cast("Callable[..., None]", njit(_sweep))


def numba_gibbs(factors: Sequence[Factor], start: Sequence[int], known: Known, sweeps: int) -> Sampled:
    """Run a plain Gibbs sampler over the variables' values, as one would write it in numba."""
    sizes = {each: size for scope, table in factors for each, size in zip(scope, table.shape, strict=True)}
    bases = np.cumsum([0, *(table.size for _, table in factors)])
    first, held = [0], []
    for variable in range(len(sizes)):
        for base, (scope, table) in zip(bases, factors, strict=False):
            if variable in scope:
                steps = [np.prod(table.shape[axis + 1 :], dtype=int) for axis in range(table.ndim)]
                held.append([base, len(scope), *(n for pair in zip(steps, scope, strict=True) for n in pair)])
        first.append(len(held))
    rows = np.zeros((len(held), max(map(len, held))), dtype=np.int64)
    for at, row in enumerate(held):
        rows[at, : len(row)] = row
    arguments = (
        np.array(start, dtype=np.int64),
        np.array([variable for variable in range(len(sizes)) if variable not in known], dtype=np.int64),
        np.array([sizes[variable] for variable in range(len(sizes))], dtype=np.int64),
        np.array(first, dtype=np.int64),
        rows,
        np.concatenate([table.ravel() for _, table in factors]).astype(np.float64),
        np.zeros((len(sizes), max(sizes.values())), dtype=np.int64),
    )
    _compiled_sweep(*arguments, 1)
    began = time.process_time()
    _compiled_sweep(*arguments, sweeps)
    return Sampled({}, sweeps, time.process_time() - began)


def in_pyagrum(pyagrum: Any, joint: JointDistribution) -> Any:
    """Return a network as one of pyAgrum, whose variables have the same names."""
    network = pyagrum.BayesNet(joint.name)
    for symbol in joint.symbols:
        network.add(symbol.name, symbol.size)
    for factor in joint.factors:
        assert isinstance(factor, Distribution)
        # its arrays have the axes in the reverse order of its arcs, and the child last
        for parent in reversed(factor.given):
            network.addArc(parent.name, factor.symbol.name)
        network.cpt(factor.symbol.name)[:] = np.ascontiguousarray(np.moveaxis(factor.table, 0, -1))
    return network


def alternatives(
    pyagrum: Any, joint: JointDistribution, known: Known, arguments: argparse.Namespace
) -> dict[str, Callable[[], Sampled]]:
    """Return, for each sampler to compare, a function that runs it once and measures its processor time."""
    model = joint.ask(joint.symbols).network()
    machine = machine_of(model, Sequencer.LINEAR)
    parameters = machine.parameters
    start = replace(start_of(machine, known, arguments.sweeps), burn_in=BURN_IN, max_cycles=2**40)
    kernel = FastBM2(machine)
    many = MANY[model.name]
    each_chain = (replace(parameters, chain=at, chains=many) for at in range(many))
    chains = Chains([BM2Machine(each, machine.tables, machine.supports) for each in each_chain])
    # as many moves in all for both networks
    moves = many * len(parameters.moves(start.known, start.sequencer))
    short = replace(start, samples=1 + 2 * arguments.chain_sweeps // moves)

    def single() -> Sampled:
        began = time.process_time()
        kernel.start(start)
        return Sampled({}, kernel.samples, time.process_time() - began, cycles=kernel.cycles)

    def together() -> Sampled:
        began = time.process_time()
        results = chains.run([short] * many)
        seconds = time.process_time() - began
        cycles, samples = (sum(getattr(each, name) for each in results) for name in ("cycles", "samples"))
        return Sampled({}, samples, seconds, cycles=cycles)

    def others(run: Callable[..., Sampled], *given: Any, **options: Any) -> Callable[[], Sampled]:
        @cache  # once is enough to tell, and THRML compiles in each run
        def once() -> Sampled:
            began = time.process_time()
            sampled = run(*given, burn_in=BURN_IN, **options)
            # their seconds exclude compilation, and those of the processor what other processes took
            return replace(sampled, seconds=min(sampled.seconds, time.process_time() - began))

        return once

    sweeps, factors, values = arguments.sweeps, factors_of(model), unpack(parameters, start.state)
    theirs = (pyagrum, in_pyagrum(pyagrum, joint), model.names, known)
    runs = {
        "BM2, one chain": single,
        f"BM2, {many} chains": together,
        "Gibbs in numba": lambda: numba_gibbs(factors, values, known, sweeps),
        "pyAgrum's Gibbs": others(pyagrum_gibbs, *theirs, sweeps=sweeps, limit=arguments.seconds),
    }
    if arguments.thrml:
        blocks = (factors, values, known, parameters.colours)
        runs[f"THRML, {CHAINS} chains"] = others(thrml_gibbs, *blocks, sweeps=sweeps)
    return runs


def measure(runs: dict[str, Callable[[], Sampled]]) -> dict[str, Sampled]:
    """Run the functions in turns, and return the fastest run of each; the first turn compiles and does not count."""
    best: dict[str, Sampled] = {}
    for turn in range(1 + TURNS):
        for name, run in runs.items():
            speed = run()
            if turn and (name not in best or speed.seconds < best[name].seconds):
                best[name] = speed
    return best


def show(title: str, speeds: dict[str, Sampled]) -> None:
    """Print a table of speeds. The last column is each row's sweeps per second, divided by the first row's."""
    rows = []
    single = next(iter(speeds.values()))
    for name, each in speeds.items():
        per_second = [f"{n / each.seconds:.2e}" if n else "" for n in (each.cycles, each.sweeps)]
        ratio = each.sweeps / each.seconds * single.seconds / single.sweeps if single.sweeps else 0
        rows.append((name, *per_second, f"{ratio:.3g}" if ratio else ""))
    print_table(title, ("kernel or sampler", "cycles/s", "sweeps/s", "ratio"), rows)


def bench(arguments: argparse.Namespace) -> int:
    """Measure everything on one core; return 1 if an aim is missed and --check is given."""
    archive = use_packages("networks", LOCK) / EXAMPLES / "alarm.bif.gz"
    if arguments.thrml:
        use_packages("thrml", THRML_LOCK)
    import pyagrum

    alarm, wet = read_network(archive, on_missing="missing"), sprinkler().joint
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    show("BM1, 1024 lines x 7 columns", measure({"BM1, nothing kept": lambda: bm1(arguments.sweeps)}))
    missed = False
    for joint, known in ((wet, {[each.name for each in wet.symbols].index("G"): 1}), (alarm, {})):
        speeds = measure(alternatives(pyagrum, joint, known, arguments))
        show(f"{joint.name}, {len(known)} known", speeds)
        single, many = (each.cycles / each.seconds for each in list(speeds.values())[:2])
        single_aim, ratio_aim = SINGLE_AIMS[joint.name], RATIO_AIMS[joint.name]
        missed |= single < single_aim or many < ratio_aim * single
        print(
            f"{joint.name}: one chain {single:.2e} cycles/s (aim {single_aim:.0e}); many chains {many / single:.1f} times "
            f"that (aim {ratio_aim})\n"
        )
    return int(missed and arguments.check)


if __name__ == "__main__":
    parser = ScriptParser("scripts/bench kernel", __doc__)
    parser.flag("--sweeps", "samples of one chain, and cycles of the BM1", 200_000)
    parser.flag("--chain-sweeps", "samples of all of many chains, fewer if they are long", 80_000_000)
    parser.flag("--seconds", "limit of each run of pyAgrum's sampler", 3.0)
    parser.switch("--thrml", "also compare THRML; installs it, in a folder of its own (530 MB)")
    parser.switch("--check", "exit 1 if an aim is missed")
    parser.run_at_once(bench)
