"""Speed of the fast kernels on one core: BM1, and BM2 as one chain and as many.

The networks of the BM2 are the sprinkler with wet grass, and pgmpy's alarm with nothing known.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from casestudies.sprinkler.model import model as sprinkler
from machines.bm1 import BM1Machine, Start
from machines.bm2 import BM2Machine, BM2Start, start_state
from machines.bm2_chains import Chains
from machines.bm2_fast import FastBM2
from machines.fast import FastBM1
from machines.parameters import BM1Parameters, Sequencer
from scripts.benches.networks import machine_of
from scripts.benches.samplers import Known
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.verifications.installation import use_packages
from scripts.verifications.networks import EXAMPLES, LOCK
from toolchain.models.network import NetworkModel
from toolchain.networks import read_network

SINGLE_AIMS: Final = {"sprinkler": 6e7, "alarm": 2e7}
"""Cycles a second of one chain."""
RATIO_AIMS: Final = {"sprinkler": 10, "alarm": 2}
"""Cycles a second of many chains, over those of one."""
MANY: Final = {"sprinkler": 512, "alarm": 32}
"""Number of chains."""
TURNS: Final = 3
"""Times that each alternative is measured; the fastest counts, because other processes only slow it down."""


@dataclass(frozen=True, slots=True)
class Speed:
    """A measured run; cycles and sweeps are those of all chains."""

    cycles: int
    sweeps: int
    seconds: float
    """Time of the processor."""


def bm1(cycles: int) -> Speed:
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
    return Speed(kernel.cycles, 0, time.process_time() - began)


def chains_of(
    model: NetworkModel, known: Known, arguments: argparse.Namespace
) -> dict[str, Callable[[], Speed]]:
    """Return functions that run one chain, and many."""
    machine = machine_of(model, Sequencer.LINEAR)
    parameters = machine.parameters
    state = start_state(machine, known)
    assert state is not None  # the evidence is possible
    start = BM2Start(
        state=state,
        known=sum(parameters.masks[variable] for variable in known),
        samples=arguments.sweeps,
        burn_in=100,
        ops_timeout=parameters.ops_timeout,
        max_cycles=2**40,
    )
    kernel = FastBM2(machine)
    many = MANY[model.name]
    chains = Chains(
        [
            BM2Machine(replace(parameters, chain=at, chains=many), machine.tables, machine.supports)
            for at in range(many)
        ]
    )
    # as many moves in all for both networks
    moves = many * len(parameters.moves(start.known, start.sequencer))
    short = replace(start, samples=1 + 2 * arguments.chain_sweeps // moves)

    def single() -> Speed:
        began = time.process_time()
        kernel.start(start)
        return Speed(kernel.cycles, kernel.samples, time.process_time() - began)

    def together() -> Speed:
        began = time.process_time()
        results = chains.run([short] * many)
        seconds = time.process_time() - began
        return Speed(sum(each.cycles for each in results), sum(each.samples for each in results), seconds)

    return {f"BM2, {model.name}, one chain": single, f"BM2, {model.name}, {many} chains": together}


def measure(runs: dict[str, Callable[[], Speed]]) -> dict[str, Speed]:
    """Run all in turns, and return the fastest run of each; the first turn, which compiles, does not count."""
    best: dict[str, Speed] = {}
    for turn in range(1 + TURNS):
        for name, run in runs.items():
            speed = run()
            if turn and (name not in best or speed.seconds < best[name].seconds):
                best[name] = speed
    return best


def bench(arguments: argparse.Namespace) -> int:
    """Measure everything on one core; return 1 if an aim is missed and --check is given."""
    archive = use_packages("networks", LOCK) / EXAMPLES / "alarm.bif.gz"
    joint = read_network(archive, on_missing="missing")
    alarm = joint.ask([symbol.name for symbol in joint.symbols], ()).network()
    wet = sprinkler().network()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    speeds = measure({"BM1, 1024 lines x 7 columns, nothing kept": lambda: bm1(arguments.sweeps)})
    missed, verdicts = False, []
    for model, known in ((wet, {wet.names.index("G"): 1}), (alarm, {})):
        found = measure(chains_of(model, known, arguments))
        speeds |= found
        single, many = (each.cycles / each.seconds for each in found.values())
        single_aim, ratio_aim = SINGLE_AIMS[model.name], RATIO_AIMS[model.name]
        missed |= single < single_aim or many < ratio_aim * single
        verdicts.append(
            f"{model.name}: one chain {single:.2e} cycles/s (aim {single_aim:.0e}); many chains {many / single:.1f} times "
            f"that (aim {ratio_aim})"
        )
    rows = [
        (name, *(f"{n / each.seconds:.2e}" if n else "" for n in (each.cycles, each.sweeps)))
        for name, each in speeds.items()
    ]
    print_table("one core", ("kernel", "cycles/s", "sweeps/s"), rows)
    print(*verdicts, sep="\n")
    return int(missed and arguments.check)


if __name__ == "__main__":
    parser = ScriptParser("scripts/bench kernel", __doc__)
    parser.flag("--sweeps", "samples of one chain, and cycles of the BM1", 200_000)
    parser.flag("--chain-sweeps", "samples of all of many chains, fewer if they are long", 80_000_000)
    parser.switch("--check", "exit 1 if an aim is missed")
    parser.run_at_once(bench)
