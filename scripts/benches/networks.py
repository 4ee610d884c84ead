"""Distance of the marginals of BM2 and of other Gibbs samplers from exact inference, on published networks.

pgmpy's wheel --> *.bif.gz --> our reader --> BM2, linear and coloured --> marginals --> total variation, per variable
                    │              └──▶ Gibbs sampler of THRML, with --thrml ───────────────▲
                    ├──▶ pyagrum ──▶ Gibbs sampler of pyagrum ──────────────────────────────┤
                    └──▶ pyagrum ──▶ exact inference ───────────────────────────────────────┘
"""

import argparse
import gzip
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from machines import make_bm2_kernel, warm_up
from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, start_state, unpack
from machines.bm2_estimate import batch_effective_samples
from machines.bm2_kernel import BM2Kernel
from machines.parameters import Sequencer
from scripts.benches.samplers import CHAINS, THRML_LOCK, Factor, Known, Sampled, pyagrum_gibbs, thrml_gibbs
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.verifications.installation import use_packages
from scripts.verifications.networks import EXAMPLES, LOCK, load
from services.errors import SettingsError
from toolchain.building.options import BuildOptions
from toolchain.checks.check import check_model
from toolchain.checks.findings import Finding, Severity
from toolchain.models.network import NetworkModel
from toolchain.networks import read_network

NETWORKS: Final = ("asia", "cancer", "earthquake", "survey", "sachs", "child", "alarm", "insurance")
NO_ZEROS: Final = ("cancer", "earthquake", "survey", "sachs")
"""Networks without zero probabilities: any state leads to any other by changes of one variable at a time."""
AIM: Final = 0.01
"""Maximum total variation of a marginal on the networks `NO_ZEROS`, after a million sweeps."""
COLUMNS: Final = (
    "known", "sampler", "largest TV", "mean TV", "effective", "sweeps", "cycles", "per sweep", "seconds", "stop",
)  # fmt: skip
SEQUENCERS: Final = (Sequencer.LINEAR, Sequencer.COLOURED)
BURN_IN: Final = 1000
BATCHES: Final = 64
"""Number of batches of samples in a run; the batches' means give the effective samples."""
MAX_CYCLES: Final = 2**32
LEAVES: Final = 3
"""Maximum number of variables in a set of evidence."""
POSSIBLE: Final = 1e-9
"""Least probability of an unlikely state, far above the rounding of exact inference."""

Marginals: TypeAlias = Mapping[int, NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Network:
    """A Bayesian network, read by this project's toolchain and by pyagrum. Variables are numbered as in the machine."""

    model: NetworkModel
    zeros: int
    """The number of zeros in the tables."""
    warnings: list[Finding]
    """The warnings of `toolchain check`."""
    pyagrum: Any
    theirs: Any
    """The network in pyagrum."""

    @classmethod
    def read(cls, pyagrum: Any, archive: Path) -> "Network":
        """Read a compressed BIF file, with this project's reader and with pyagrum's."""
        joint = read_network(archive, on_missing="missing")
        zeros = sum(int(np.count_nonzero(factor.table == 0)) for factor in joint.factors)
        names = [symbol.name for symbol in joint.symbols]
        model = joint.ask(names, ()).network()
        options = BuildOptions(
            uri="ws://127.0.0.1:9090", topic="/readings", type="std_msgs/Float64MultiArray"
        )
        # a question in which any variable but one may be known or not
        found = check_model(joint.ask(names[:1], names[1:]).network(), options)
        warnings = [each for each in found if each.severity is Severity.WARNING]
        with tempfile.TemporaryDirectory(prefix="networks-rosbayes-") as folder:
            path = Path(folder, archive.name.removesuffix(".gz"))
            path.write_bytes(gzip.decompress(archive.read_bytes()))
            return cls(model, zeros, warnings, pyagrum, load(pyagrum, path))

    def exact(self, known: Known) -> Marginals:
        """Return the exact marginals of the unknown variables."""
        names = self.model.names
        inference = self.pyagrum.LazyPropagation(self.theirs)
        inference.setEvidence({names[variable]: value for variable, value in known.items()})
        inference.makeInference()
        unknown = [variable for variable in range(len(names)) if variable not in known]
        return {variable: inference.posterior(names[variable]).toarray() for variable in unknown}

    def evidences(self) -> dict[str, Known]:
        """Return three sets of evidence: `none` is empty, `likely` and `unlikely` fix the first leaves of the network.

        Each leaf gets its most or least likely state, given the states of the leaves before it. Only possible states
        are used, so all states of a set are possible together.
        """
        leaves = [
            variable
            for variable, name in enumerate(self.model.names)
            if not self.theirs.children(self.theirs.idFromName(name))
        ]
        likely: dict[int, int] = {}
        unlikely: dict[int, int] = {}
        for leaf in leaves[:LEAVES]:
            likely[leaf] = int(self.exact(likely)[leaf].argmax())
            chances = self.exact(unlikely)[leaf]
            unlikely[leaf] = int(np.where(chances > POSSIBLE, chances, np.inf).argmin())
        return {"none": {}, "likely": likely, "unlikely": unlikely}


def factors_of(model: NetworkModel) -> list[Factor]:
    """Return the variables of each factor, and its table."""
    number = {name: at for at, name in enumerate(model.names)}
    return [(tuple(number[name] for name in term.scope), term.table) for term in model.factors]


def machine_of(model: NetworkModel, sequencer: Sequencer) -> BM2Machine:
    """Return the machine that holds a network."""
    factors = factors_of(model)
    parameters = BM2Parameters(
        cardinalities=model.cardinalities,
        factors=tuple(scope for scope, _ in factors),
        sequencer=sequencer,
        burn_in=BURN_IN,
    )
    return BM2Machine.from_factors(parameters, [table for _, table in factors])


def start_of(machine: BM2Machine, known: Known, samples: int, bank: int = 0) -> BM2Start:
    """Return the start of a run from a possible state."""
    parameters, state = machine.parameters, start_state(machine, known)
    assert state is not None  # the evidence is possible
    return BM2Start(
        state=state,
        known=sum(parameters.masks[variable] for variable in known),
        samples=samples,
        burn_in=parameters.burn_in,
        ops_timeout=parameters.ops_timeout,
        max_cycles=MAX_CYCLES,
        bank=bank,
        sequencer=parameters.sequencer,
    )


def run(kernel: BM2Kernel, known: Known, sweeps: int, bank: int) -> Sampled:
    """Run one chain in batches."""
    parameters = kernel.machine.parameters
    start = start_of(kernel.machine, known, sweeps // BATCHES, bank)
    began = time.perf_counter()
    kernel.start(start)
    batches = [kernel.results]
    while kernel.reason is BM2StopReason.SAMPLES and len(batches) < BATCHES:
        kernel.resume(sweeps * (len(batches) + 1) // BATCHES)
        batches.append(kernel.results)
    seconds = time.perf_counter() - began
    marginals, effective, word = {}, [], 0
    for variable, (bits, size) in enumerate(zip(parameters.bits, parameters.cardinalities, strict=True)):
        if variable not in known:
            counts = np.array([each[word : word + size] for each in batches])
            marginals[variable] = counts[-1] / max(1, counts[-1].sum())
            effective.append(batch_effective_samples(counts).min())
        word += 1 << bits
    stop = "" if kernel.reason is BM2StopReason.SAMPLES else kernel.reason.name.lower()
    return Sampled(marginals, kernel.samples, seconds, min(effective), kernel.cycles, stop)


def variation(found: Marginals, exact: Marginals) -> list[float]:
    """Return the total variation of each variable's marginal."""
    return [float(np.abs(found[variable] - each).sum()) / 2 for variable, each in exact.items()]


def compare(network: Network, arguments: argparse.Namespace) -> tuple[float, float]:
    """Print a table that compares the samplers for all evidences of a network.

    Returns two total variations of the machine: the largest of the median banks, and the largest of all banks.
    """
    names, sweeps = network.model.names, arguments.sweeps
    zeros = f"{network.zeros} zeros, which limit Gibbs samplers" if network.zeros else "no zeros"
    rows: list[list[str] | None] = []
    kernels = {f"BM2 {each}": make_bm2_kernel(machine_of(network.model, each)) for each in SEQUENCERS}
    median, largest = [], []
    for title, known in network.evidences().items():
        exact = network.exact(known)
        runs = {}
        for name, kernel in kernels.items():
            found = [run(kernel, known, sweeps, bank) for bank in range(arguments.banks)]
            found.sort(key=lambda each: max(variation(each.marginals, exact)))
            runs[name] = found[len(found) // 2]
            median.append(max(variation(runs[name].marginals, exact)))
            largest.append(max(variation(found[-1].marginals, exact)))
        theirs = (network.pyagrum, network.theirs, names, known)
        runs["pyAgrum's Gibbs"] = pyagrum_gibbs(
            *theirs, sweeps=sweeps, burn_in=BURN_IN, limit=arguments.seconds
        )
        if arguments.thrml:
            machine = kernels["BM2 linear"].machine
            start = unpack(machine.parameters, start_state(machine, known) or 0)
            blocks = (factors_of(network.model), start, known, machine.parameters.colours)
            runs[f"THRML, {CHAINS} chains"] = thrml_gibbs(*blocks, sweeps=sweeps, burn_in=BURN_IN)
        for sampler, each in runs.items():
            off = variation(each.marginals, exact)
            effective = cycles = per_sweep = ""
            if each.cycles:
                # where fewer, the batches are too short to tell
                effective = f"< {2 * BATCHES}" if each.effective < 2 * BATCHES else f"{each.effective:.0f}"
                cycles, per_sweep = str(each.cycles), f"{each.cycles / (each.sweeps + BURN_IN):.1f}"
            figures = [f"{max(off):.4f}", f"{fmean(off):.4f}", effective, str(each.sweeps), cycles, per_sweep]
            evidence = f"{len(known)} {title}" if known else title
            rows.append([evidence, sampler, *figures, f"{each.seconds:.2f}", each.stop])
        rows.append(None)
    print_table(f"{network.model.name}: {len(names)} variables, {zeros}", COLUMNS, rows, left=2)
    for warning in network.warnings:
        print(f"toolchain check: {warning.about}: {warning.what}")
    return max(median), max(largest)


def bench(arguments: argparse.Namespace) -> int:
    """Compare all networks; with --check, return 1 if one missed the aim."""
    arguments.network = arguments.network or list(NO_ZEROS if arguments.check else NETWORKS)
    arguments.sweeps = arguments.sweeps or (1_000_000 if arguments.check else 20_000)
    arguments.banks = 5 if arguments.check else 1
    if arguments.sweeps < BATCHES:
        raise SettingsError(f"--sweeps must be {BATCHES} or more, not {arguments.sweeps}")
    packages = use_packages("networks", LOCK)
    if arguments.thrml:
        use_packages("thrml", THRML_LOCK)
    import pyagrum

    warm_up()
    missed = False
    for name in arguments.network:
        archive = packages / EXAMPLES / f"{name}.bif.gz"
        median, largest = compare(Network.read(pyagrum, archive), arguments)
        if arguments.check:
            missed |= median > AIM
            print(
                f"{name}: total variation at most {median:.4f} from the median of {arguments.banks} banks "
                f"({largest:.4f} from any); the aim of {AIM} is {'missed' if median > AIM else 'held'}\n"
            )
    return int(missed)


if __name__ == "__main__":
    parser = ScriptParser("scripts/bench networks", __doc__)
    parser.flag("--network", "only this one; repeat for more", action="append", choices=NETWORKS)
    parser.flag(
        "--sweeps",
        f"samples, after {BURN_IN} sweeps of burn-in",
        type=int,
        shown="20000, with --check 1000000",
    )
    parser.flag("--seconds", "limit of each run of pyAgrum's sampler, which may do fewer sweeps", 5.0)
    parser.switch("--thrml", "also compare THRML; installs it, in a folder of its own (530 MB)")
    parser.switch(
        "--check",
        f"run networks without zeros from 5 banks of seeds; exit 1 if a median total variation is above {AIM}",
    )
    parser.run_at_once(bench)
