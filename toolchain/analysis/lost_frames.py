"""Prediction of lost frames, for which a BM1 has no posterior, and of options that avoid lost frames.

The prediction uses the codes of the BM1, before it runs. A frame is lost if every line has a code 0, or if no line
counts in any cycle of the frame. A sample of frames is drawn from the model. The probability that a frame is lost is (1
- u)^cycles, where u is the probability that some line counts in a cycle.

All lines use one random number per column, so u is the volume of a union of boxes. Each line has a box, whose sides are
the codes of the line's cells. The method of Karp and Luby estimates the volume. It draws points in the boxes, and each
point has the weight 1 / n, where n is the number of boxes that contain the point.
"""

from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from machines.parameters import PROB_BITS_MAX, RngKind, SensorMode
from toolchain.analysis.emulation import addressed_chances, one_replica
from toolchain.analysis.readings import Readings, readings_of_lines, sample_readings
from toolchain.building.machine import MachinePlan, plan_machine, whole_machine
from toolchain.building.options import BuildOptions
from toolchain.building.quantise import Quantised
from toolchain.deployment import Scale
from toolchain.errors import BuildError

TOLERATED: Final = 0.01
"""A build and a check warn if a larger share of the frames is lost."""
_WORK: Final = 2**26
"""Maximum number of comparisons of points with codes, for less than a second of computing.

A very large model exceeds it, because at least `_LEAST_FRAMES` frames are computed.
"""
_MOST_FRAMES: Final = 1000
_LEAST_FRAMES: Final = 10
_POINTS: Final = 16
"""Number of random points from which the probability of a frame is estimated."""
_SEED: Final = 1
_MOST_CYCLES: Final = 2**26
"""Longer frames are tried for the advice until they have at least this many cycles: 0.7 s at 100 MHz."""


class LostFrames(NamedTuple):
    """The expected share of lost frames, a clause about it, and advice. If few frames are lost, the advice is empty."""

    share: float
    what: str
    advice: str


def lost_frames(plan: MachinePlan, quantised: Quantised) -> LostFrames:
    """Predict the share of lost frames of a machine. If it exceeds `TOLERATED`, find options that reduce it."""
    size = plan.model.lines * plan.parameters.columns
    frames = min(_MOST_FRAMES, max(_LEAST_FRAMES, _WORK // (_POINTS * size)))
    drawn = sample_readings(plan.model, frames, seed=_SEED)
    chances = _chances(plan, quantised, drawn)
    share = _share(chances, plan.options, plan.max_cycles)
    what = (
        f"of {frames} frames drawn from the model, {share:.1%} are expected to get no posterior: "
        f"{(chances == 0).mean():.1%} because every line has a code 0, and the rest because no line counts in "
        f"{plan.max_cycles} cycles"
    )
    return LostFrames(share, what, _advice(plan, drawn) if share > TOLERATED else "")


def _chances(plan: MachinePlan, quantised: Quantised, drawn: Readings) -> NDArray[np.float64]:
    """Return the probability that at least one line counts a one in a cycle, for each frame: float64[frames]."""
    machine = one_replica(whole_machine(plan, quantised))
    if machine.parameters.sensor_mode is not SensorMode.COLUMN:
        drawn = readings_of_lines(drawn, plan.model, machine, scale=plan.options.scaling, seed=_SEED)
    random = np.random.default_rng(_SEED)
    frames = (addressed_chances(machine, *drawn.of_machine(at, machine)) for at in range(len(drawn)))
    return np.array([_union(each, random, shared=machine.parameters.shared) for each in frames])


def _union(chances: NDArray[np.float64], random: np.random.Generator, *, shared: bool) -> float:
    """Return the probability that at least one line counts a one in a cycle.

    `chances` are the probabilities that cells make a 1: float64[columns, lines].
    """
    lines = np.prod(chances, axis=0)
    total = float(lines.sum())
    if total == 0:  # or so small that doubles underflow
        return float(np.finfo(np.float64).tiny) if chances.all(axis=0).any() else 0.0
    if not shared:  # lines are independent
        return 1.0 - float(np.prod(1 - lines)) if lines.max() > 1e-9 else total
    chosen = random.choice(len(lines), _POINTS, p=lines / total)
    inside = np.ones((_POINTS, len(lines)), dtype=np.bool_)
    for column in chances:
        point = random.random(_POINTS) * column[chosen]
        inside &= point[:, np.newaxis] < column
    return min(1.0, total * float((1 / inside.sum(axis=1)).mean()))


def _share(chances: NDArray[np.float64], options: BuildOptions, cycles: int) -> float:
    """Return the expected share of lost frames after `cycles` cycles.

    Cycles beyond the period of the LFSRs do not reduce this share.
    """
    width = options.rng.lfsr_bits
    return float(((1 - chances) ** (cycles if width is None else min(cycles, 2**width - 1))).mean())


def _advice(plan: MachinePlan, drawn: Readings) -> str:
    """Return advice: the options with which few enough frames are lost.

    If some options are enough by themselves, the advice lists each of them. If none is enough, the advice combines all
    options. If the combination is not enough either, the advice also omits sensors.
    """
    options, sensors = plan.options, len(plan.model.known)
    may_scale = options.sensor_mode is SensorMode.COLUMN and options.scaling is not Scale.ADDRESS
    rng: dict[str, Any] = {"rng": RngKind.LFSR32} if options.rng.lfsr_bits not in {None, 32} else {}
    groups: list[list[dict[str, Any]]] = [
        [{"scale": Scale.ADDRESS}] if may_scale else [],
        [{"prob_bits": bits} for bits in (12, PROB_BITS_MAX) if bits > plan.parameters.prob_bits],
    ]
    ways = []
    for group, longer in (*((group, False) for group in groups), ([rng], True)):
        tries = (_expected(plan, changes, drawn, sensors, longer=longer) for changes in group)
        if enough := next((each for each in tries if each[1] <= TOLERATED), None):
            ways.append(enough)
    changes = rng | {key: value for group in groups for last in group[-1:] for key, value in last.items()}
    count, more = sensors, ""
    while not ways:
        flags, share = _expected(plan, changes, drawn, count, longer=True)
        if count < sensors:
            flags = f"{flags} with only the first {count} known variables".strip()
            more = "; 'toolchain advise' also tries a BM2"
        if share <= TOLERATED or count <= 1:
            ways.append((flags or "another model", share))
        count = count * 3 // 4
    return "use " + " or ".join(f"{flags} (then {share:.2%})" for flags, share in ways) + more


def _expected(
    plan: MachinePlan, changes: dict[str, Any], drawn: Readings, count: int, *, longer: bool
) -> tuple[str, float]:
    """Return `changes` as flags, and the share of frames that are lost with these flags and only `count` sensors.

    If `longer`, the maximum number of cycles is also raised (as a further flag) until few frames are lost.
    """
    model, options = replace(plan.model, known=plan.model.known[:count]), replace(plan.options, **changes)
    try:
        own = plan_machine(model, options)
    except BuildError:  # such as codes that are wider than the random numbers
        return "", 1.0
    chances = _chances(own, own.quantised(), replace(drawn, addresses=drawn.addresses[:, :count]))
    cycles = own.max_cycles
    while longer and _share(chances, options, cycles) > TOLERATED and cycles < _MOST_CYCLES:
        cycles *= 4
    shown = changes if cycles == own.max_cycles else changes | {"max_cycles": cycles}
    flags = " ".join(f"--{key.replace('_', '-')} {value}" for key, value in shown.items())
    return flags, _share(chances, options, cycles)
