"""Advice on whether to answer a question with a BM1, a BM2 or exact inference on a CPU (thesis 5.2).

Both machines are emulated on readings drawn from the model. Frames are lengthened until the mean total variation from
exact inference is small enough. If a machine does not reach the requested accuracy within `MOST_CYCLES` cycles, the
advice gives the total variation reached, and the reason why it is no smaller.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median
from time import perf_counter
from typing import Final, TypeAlias

import numpy as np

from machines.bm1 import BM1Machine
from toolchain.analysis import AdviceOptions, with_unit
from toolchain.analysis.accuracy import Accuracy, measure
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.analysis.logic import Device, device_named
from toolchain.analysis.readings import sample_readings
from toolchain.analysis.resources import Estimate, boards_needed, estimate
from toolchain.analysis.sampling import Addresses, chain_resources, drawn_readings, run_chains
from toolchain.building.bm2_machine import chain_machines, plan_bm2
from toolchain.building.choice import network_for
from toolchain.building.machine import partition_lines, plan_machine, whole_machine
from toolchain.building.options import BuildOptions
from toolchain.deployment import Stop
from toolchain.errors import ToolchainError
from toolchain.models.joint import Question
from toolchain.models.model import Model
from toolchain.models.network import NetworkModel

MOST_CYCLES: Final = 30_000_000
"""Maximum number of cycles of a frame, because more cycles would take too long to emulate."""
_NEAR: Final = 0.8
"""A value above this share of its limit is near it: an error near the accuracy asked for, cycles near `MOST_CYCLES`."""
_ATTEMPTS: Final = 8
_WIDTHS: Final = (8, 12, 16)


_Run: TypeAlias = tuple[int, tuple[int, float, float], int, Estimate]
"""The bits of a code, the results of a run, the number of boards, and the resources of one board.

The results are `setting`, `total_variation` and `cycles` of `Candidate`.
"""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A machine for a question. If the machine is refused, all fields after `refused` keep their defaults.

    Attributes:
        refused: Reason why the machine cannot answer the question, or empty.
        setting: Target count of a BM1, or number of samples of a BM2.
        total_variation: Mean distance from exact inference with this setting. A frame without a posterior counts as 1.
        cycles: Median cycles of a frame.
        seconds: Time of `cycles` at the clock frequency.
        alms, blocks: Estimated numbers of ALMs and of memory blocks on one board.
        unfit: Reason why the FPGA `Advice.device` cannot hold the machine, or empty.
    """

    machine: str
    refused: str = ""
    prob_bits: int = 0
    setting: int = 0
    total_variation: float = 1.0
    cycles: float = 0.0
    seconds: float = 0.0
    boards: int = 1
    alms: float = 0.0
    blocks: int = 0
    unfit: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Advice:
    """The results of each machine for a question, the median time of exact inference, and a recommendation."""

    model: str
    question: str
    accuracy: float
    frames: int
    clock_hz: float
    device: str
    machines: tuple[Candidate, ...]
    exact_seconds: float
    recommendation: str

    def as_json(self) -> str:
        """Return the advice as one JSON object."""
        content = asdict(self)
        for each in content["machines"]:
            if each["refused"]:
                each |= {key: None for key in each if key not in {"machine", "refused"}}
        return json.dumps(content) + "\n"

    def report(self) -> str:
        """Return the advice as text: a table, followed by sentences."""
        exact = f"Exact inference on this host: {with_unit(self.exact_seconds, 's')}."
        shown = [each for each in self.machines if not each.refused]
        cells = {
            "": [each.machine for each in shown],
            "bits of a code": [str(each.prob_bits) for each in shown],
            "target count or samples": [f"{each.setting:,}" for each in shown],
            "total variation": [f"{each.total_variation:.4f}" for each in shown],
            "cycles of a frame": [f"{each.cycles:,.0f}" for each in shown],
            f"time at {with_unit(self.clock_hz, 'Hz')}": [with_unit(each.seconds, "s") for each in shown],
            "boards": [str(each.boards) for each in shown],
            "ALMs of a board": [f"{each.alms:,.0f}" for each in shown],
            "its memory blocks": [f"{each.blocks:,}" for each in shown],
        }
        rows = [f"{name:23}" + "".join(f"{cell:>14}" for cell in row) for name, row in cells.items()]
        for each in self.machines:
            if each.refused or each.unfit:
                rows.append(f"{each.machine}: {each.refused or f'on a {self.device} {each.unfit}'}.")
            elif each.total_variation > self.accuracy:
                rows.append(_why_short(each, self.accuracy))
        heading = (
            f"{self.model}: {self.question}, to a mean total variation of {self.accuracy:g} over "
            f"{self.frames} readings"
        )
        return "\n".join([heading, *rows, exact, self.recommendation]) + "\n"


def advise(
    source: Model | Question, options: AdviceOptions, begun: Callable[[str], None] = lambda _: None
) -> Advice:
    """Compare a BM1, a BM2 and exact inference for a model or a question.

    `begun` is called at the start of each run, with a text about the run. Raises a ToolchainError if exact inference
    is impossible.
    """
    device = device_named(options.device)
    network = network_for(source)
    begun("exact inference")
    readings = drawn_readings(network, options.frames, options.seed)
    times = []
    for addresses in readings:
        began = perf_counter()
        network.exact(addresses)
        times.append(perf_counter() - began)
    machines = (
        _candidate("BM1", options.clock_hz, lambda: _bm1(source, options, device, begun)),
        _candidate("BM2", options.clock_hz, lambda: _bm2(network, readings, options, device, begun)),
    )
    exact = median(times)
    known = f" | {', '.join(network.known)}" if network.known else ""
    return Advice(
        model=network.name,
        question=f"P({', '.join(each.label for each in network.searched)}{known})",
        accuracy=options.accuracy,
        frames=options.frames,
        clock_hz=options.clock_hz,
        device=device.title,
        machines=machines,
        exact_seconds=exact,
        recommendation=_recommendation(machines, exact, options.accuracy),
    )


def _candidate(machine: str, clock_hz: float, run: Callable[[], _Run]) -> Candidate:
    """Return the results of `run`, which runs a machine, or why the machine is refused if `run` raises an error."""
    try:
        prob_bits, (setting, variation, cycles), boards, cost = run()
    except ToolchainError as reason:
        return Candidate(machine, str(reason).rstrip("."))
    seconds, blocks = cycles / clock_hz, cost.memories.blocks
    return Candidate(
        machine, "", prob_bits, setting, variation, cycles, seconds, boards, cost.alms, blocks, cost.why_not
    )


def _bm1(
    source: Model | Question, options: AdviceOptions, device: Device, begun: Callable[[str], None]
) -> _Run:
    """Run a BM1 with the narrowest codes whose quantisation loss is small enough, on the boards that its lines need."""
    model = source.model() if isinstance(source, Question) else source
    readings = sample_readings(model, options.frames, seed=options.seed)

    def measured(machine: BM1Machine, target: int) -> Accuracy:
        boards = EmulatedBoards([machine], target_count=target, max_cycles=4 * MOST_CYCLES, stop=Stop.SLICES)
        return measure(boards, readings, model, banks=1)

    for prob_bits in _WIDTHS:
        begun(f"BM1, codes of {prob_bits} bits")
        plan = plan_machine(model, BuildOptions(prob_bits=prob_bits, counter_bits=32))
        machine = whole_machine(plan, plan.quantised())
        lost = measured(machine, 1).quantising
        if lost is not None and lost.total_variation.value <= options.accuracy / 2:
            break

    def run(target: int) -> tuple[float, float]:
        begun(f"BM1, target count {target:,}")
        found = measured(machine, target)
        return found.machine.total_variation.value if found.machine else 1.0, found.cycles.median.value

    best = _run_until(run, 255, options.accuracy)
    parameters = replace(machine.parameters, counter_bits=best[0].bit_length())
    boards, _ = boards_needed(parameters, device)
    lines = partition_lines(parameters.lines, boards)[0].lines
    return prob_bits, best, boards, estimate(replace(parameters, lines=lines), device)


def _bm2(
    network: NetworkModel,
    readings: Sequence[Addresses],
    options: AdviceOptions,
    device: Device,
    begun: Callable[[str], None],
) -> _Run:
    """Run a BM2 with the default options on one board."""
    plan = plan_bm2(network, BuildOptions())
    machines = chain_machines(plan)

    def run(samples: int) -> tuple[float, float]:
        begun(f"BM2, {samples:,} samples")
        found = run_chains(machines, readings, network, samples=samples, max_cycles=plan.max_cycles)
        return found.total_variation.value if found.total_variation else 1.0, found.cycles.median.value

    best = _run_until(run, 1000, options.accuracy)
    return plan.parameters.prob_bits, best, 1, chain_resources(machines[0], device)


def _run_until(
    run: Callable[[int], tuple[float, float]], setting: int, accuracy: float
) -> tuple[int, float, float]:
    """Return the best setting tried, its total variation and its cycles.

    The best one is the lowest that is accurate enough, or else the most accurate. The error is inversely proportional
    to the square root of the setting, so every run predicts the next setting.
    """
    tried: dict[int, tuple[float, float]] = {}
    while len(tried) < _ATTEMPTS and setting not in tried:
        variation, cycles = tried[setting] = run(setting)
        if _NEAR * accuracy <= variation <= accuracy:
            break
        growth = min((variation / (0.9 * accuracy)) ** 2, MOST_CYCLES / max(cycles, 1))
        setting = max(1, round(setting * float(np.clip(growth, 1 / 8, 8))))
    enough = {each: tv for each, (tv, _) in tried.items() if tv <= accuracy}
    best = min(enough) if enough else min(tried, key=lambda each: tried[each][0])
    return (best, *tried[best])


def _why_short(machine: Candidate, accuracy: float) -> str:
    """Return the sentence that says why a machine is less accurate than asked, and what to change."""
    if machine.cycles < _NEAR * MOST_CYCLES:
        return (
            f"{machine.machine}: its codes of {machine.prob_bits} bits, not its cycles, limit its accuracy; ask for less with "
            "--accuracy."
        )
    # the error is inversely proportional to the square root of the setting
    enough = float(f"{machine.setting * (machine.total_variation / accuracy) ** 2:.1e}")
    flag = "--samples" if machine.machine == "BM2" else "--target-count"
    return (
        f"{machine.machine}: frames end at the limit of {MOST_CYCLES:,} cycles; ask for less with --accuracy, or build it with "
        f"about {flag} {enough:.0f}."
    )


def _recommendation(machines: Sequence[Candidate], exact: float, accuracy: float) -> str:
    possible = [each for each in machines if not each.refused and not each.unfit]
    useful = [each for each in possible if each.total_variation <= accuracy]
    cpu = f"exact inference on a CPU takes {with_unit(exact, 's')}"
    if not useful:
        return f"Use a CPU: {cpu}, and no machine {'is as accurate' if possible else 'can answer this question'}."
    best = min(useful, key=lambda each: each.seconds)
    ours = f"a {best.machine} takes {with_unit(best.seconds, 's')}"
    if best.seconds < exact:
        return f"Use a {best.machine}: {ours}, and {cpu}, each without the way from and to ROS."
    return f"Use a CPU: {cpu}, and {ours}."
