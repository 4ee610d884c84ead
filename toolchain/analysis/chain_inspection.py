"""Inspection of a BM2's deployment: sizes, cycles, accuracy and resources, as text or as a JSON object."""

import json
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from machines.bm2 import BM2Machine
from toolchain.analysis import InspectOptions, Progress, with_unit
from toolchain.analysis.chain import ChainError, chain_error
from toolchain.analysis.logic import device_named
from toolchain.analysis.resources import Estimate
from toolchain.analysis.sampling import Sampled, chain_resources, drawn_readings, run_chains
from toolchain.building.build import read_images
from toolchain.building.report import edited_sentence
from toolchain.cluster import Run
from toolchain.deployment import Deployment
from toolchain.errors import BuildError, counted
from toolchain.models.network import NetworkModel

_FRAMES: Final = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ChainInspection:
    """Results of an inspection.

    `exact` is the result of `chain_error`. If the chain is too large for this function, `exact` is None.
    """

    deployment: Deployment
    machine: BM2Machine
    readings: str
    sampled: Sampled
    exact: ChainError | None
    resources: Estimate
    clock_hz: float

    def as_json(self) -> str:
        """Return the inspection as one JSON object."""
        p, cost = self.machine.parameters, self.resources
        content = {
            "deployment": self.deployment.name,
            "hash": self.deployment.hash,
            "boards": p.chains,
            "edited_boards": self.deployment.edited_boards,
            "state_bits": p.state_bits,
            "table_words": [table.size for table in self.machine.tables],
            "result_words": p.result_words,
            "readings": self.readings,
            "clock_hz": self.clock_hz,
            "sampled": asdict(self.sampled),
            "exact": None if self.exact is None else asdict(self.exact),
            "resources": {"alms": cost.alms, "blocks": cost.memories.blocks, "fits": cost.fits},
        }
        return json.dumps(content) + "\n"

    def report(self) -> str:
        """Return the inspection as sentences."""
        p, ran, cost = self.machine.parameters, self.sampled, self.resources
        count, sizes = self.deployment.machine.target_count, [table.size for table in self.machine.tables]
        lengths = (ran.cycles.median.value, ran.cycles.percentile_95.value, float(ran.cycles.worst))
        shown = [f"{each:,.0f} ({with_unit(each / self.clock_hz, 's')})" for each in lengths]
        at_95 = f"{ran.cycles.percentile_95.low:,.0f}..{ran.cycles.percentile_95.high:,.0f}"
        cycles = f"{shown[0]} in the median, {shown[1]} at 95 % (95 % interval {at_95}), {shown[2]} at worst"
        resources = f"{cost.alms:,.0f} ALMs ({cost.alm_share:.1%}), "
        resources += f"{cost.memories.blocks:,} memory blocks ({cost.block_share:.1%}); "
        resources += "it fits" if cost.fits else f"it does not fit: {cost.why_not}"
        accuracy = "Give the model with --model for the accuracy."
        if (tv := ran.total_variation) is not None:
            accuracy = f"Total variation from exact inference: {tv.value:.4f} ({tv.low:.4f}..{tv.high:.4f})"
            if ran.without and ran.alone is not None:
                accuracy += (
                    f" over all frames, and 1 for the {ran.without:.1%} of them without a posterior; over the others "
                    f"{ran.alone.value:.4f} ({ran.alone.low:.4f}..{ran.alone.high:.4f})"
                )
            accuracy += "."
        if (e := self.exact) is not None:
            accuracy += (
                f" Computed: {e.quantising:.2g} by the codes, {e.start:.2g} by the start state, "
                f"{e.sampling:.2g} by too few samples."
            )
        r_hat = f"; R-hat {ran.r_hat:.4g}" if p.chains > 1 else ""
        bits = counted(p.state_bits, "bit")
        stops = ", ".join(f"{name} {n}" for name, n in sorted(ran.reasons.items()))
        rows = (
            (
                f"Deployment {self.deployment.name} ({self.deployment.hash[:16]}): a BM2 with "
                f"{counted(p.chains, 'chain')}, one per board."
            ),
            (
                f"{counted(len(p.cardinalities), 'variable')} in {bits}; {counted(p.cdes, 'CDE')} with {sum(sizes):,} "
                f"codes of {p.prob_bits} bits, at most {max(sizes):,}."
            ),
            (
                f"{count:,} samples after {p.burn_in:,} sweeps, {p.sequencer} order, {p.rng} "
                f"({counted(p.steps_per_clock, 'step')} per clock, {counted(p.rng_banks, 'bank')})."
            ),
            *([edited_sentence(self.deployment)] if self.deployment.edited_boards else []),
            f"Readings: {self.readings}. Boards stopped by: {stops}. Without a posterior: {ran.without:.1%} of frames.",
            (
                f"Cycles of a frame, and time at {with_unit(self.clock_hz, 'Hz')} (no link, no ROS): {cycles}; "
                f"{ran.sweep_cycles:.2f} per sweep."
            ),
            (
                f"Its samples are worth {ran.effective_samples[0]:,.0f} independent ones in the median, "
                f"{ran.effective_samples[1]:,.0f} at least{r_hat}."
            ),
            accuracy,
            f"Resources of a {cost.device.title}, estimated from the units of a BM1: {resources}.",
        )
        return "\n".join(rows) + "\n"


def inspect_chain(
    deployment: Deployment, model: NetworkModel | None, options: InspectOptions, progress: Progress, run: Run
) -> ChainInspection:
    """Run a deployment's chains on drawn readings, and estimate the resources, or raise a ToolchainError."""
    machines = [image.machine for image in read_images(deployment)]
    machine, limits, frames = machines[0], deployment.machine, options.frames or _FRAMES
    if options.readings is not None:
        raise BuildError(f"--readings {options.readings}: the readings of a BM2 are drawn; omit it")
    if model is None:
        source = f"{frames} frames of values drawn uniformly (seed {options.seed})"
        sizes = [each.values for each in deployment.variables]
        drawn = np.random.default_rng(options.seed).integers(0, sizes, (frames, len(sizes)))
        readings, exact = [tuple(each) for each in drawn.tolist()], None
    else:
        check_same(deployment, machine, model)
        source = f"{frames} frames drawn from the model (seed {options.seed})"
        readings = drawn_readings(model, frames, options.seed)
        exact = chain_error(machine, model, samples=limits.target_count)
    with progress(len(readings)) as advance:
        sampled = run_chains(
            machines,
            readings,
            model,
            samples=limits.target_count,
            max_cycles=limits.max_cycles,
            advance=lambda: advance("frames"),
            run=run,
        )
    return ChainInspection(
        deployment=deployment,
        machine=machine,
        readings=source,
        sampled=sampled,
        exact=exact,
        resources=chain_resources(machine, device_named(options.device)),
        clock_hz=options.clock_hz,
    )


def check_same(deployment: Deployment, machine: BM2Machine, model: NetworkModel) -> None:
    """Raise a BuildError if a build from `model` would give another machine than the deployment's.

    If files of the deployment were edited by hand after the build, the codes of the two machines are not compared.
    """
    p = machine.parameters
    place = {name: at for at, name in enumerate(model.names)}.__getitem__
    scopes = tuple(tuple(map(place, term.scope)) for term in model.factors)
    asked = (tuple(place(each.label) for each in model.searched), tuple(map(place, model.known)))
    if (model.cardinalities, scopes, asked) == (p.cardinalities, p.factors, (p.searched, p.known)):
        tables = [term.table for term in model.factors]
        if deployment.edited_boards or BM2Machine.from_factors(p, tables, machine.rng_table) == machine:
            return
    raise BuildError(
        f"{deployment.directory} was not built from the model {model.name} with these settings: its codes differ; give "
        "the same --set and question as for the build, or build it again"
    )
