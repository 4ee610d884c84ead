"""Runs of a BM2 on drawn readings, compared with exact inference, and estimates of a BM2's FPGA resources."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np

from machines.bm2 import BM2Machine
from machines.bm2_kind import BM2, kernels_of, run_batches
from machines.kind import FrameInput
from machines.parameters import RngReset, SampleEvery
from toolchain.analysis.accuracy import Cycles, Interval, bootstrap
from toolchain.analysis.chain import distance
from toolchain.analysis.logic import (
    MLAB_ALMS,
    MLAB_SHAPE,
    WORD_BITS,
    Device,
    EqualMemories,
    Logic,
    LogicPart,
    Memories,
    Of,
    random_memories_of,
)
from toolchain.analysis.readings import check_frames
from toolchain.analysis.resources import Estimate
from toolchain.cluster import Run, Work, in_order, in_this_process
from toolchain.deployment import Dimension
from toolchain.errors import BuildError
from toolchain.models.network import NetworkModel
from toolchain.outputs.memories import seed_width
from toolchain.outputs.mif import table_length

_INFINITE: Final = 1e9
_SEQUENCER_BITS: Final = 16  # the sequencer has an LFSR16 of its own, and seeds for it
Addresses = tuple[int, ...]
"""A frame's readings, one address for each known variable."""


def drawn_readings(model: NetworkModel, frames: int, seed: int) -> list[Addresses]:
    """Draw readings of all known variables for each frame. Each variable is drawn given those drawn before it."""
    check_frames(frames)
    random = np.random.default_rng(seed)
    given_earlier = [
        replace(
            model, searched=(Dimension(label=each.name, size=each.values),), variables=model.variables[:at]
        )
        for at, each in enumerate(model.variables)
    ]
    readings = []
    for _ in range(frames):
        drawn: list[int] = []
        for part in given_earlier:
            chances = part.exact(drawn)
            drawn.append(int(random.choice(len(chances), p=chances)))
        readings.append(tuple(drawn))
    return readings


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampled:
    """Results of a BM2 on some readings. Intervals are 95 % confidence intervals over frames.

    The fields from `alone` to `r_hat` use only the frames with a posterior.

    Attributes:
        frames: Number of all frames.
        without: Share of frames without a posterior.
        total_variation: Mean total variation from exact inference, or None without a model. A frame without a
            posterior has a total variation of 1.
        alone: Mean total variation over only the frames with a posterior, or None without a model.
        cycles: Statistics of the cycles of a frame. These cycles are those of the board that runs longest.
        sweep_cycles: Mean cycles of a sweep, or 0 if samples are taken after every move.
        effective_samples: Median and minimum of the effective samples of a frame. Unknown numbers are 0.
        r_hat: Median R-hat of a frame. A frame without an R-hat, for example of a single board, counts as 0. An
            infinite R-hat counts as 1e9.
        reasons: How often boards stopped for each reason. Boards stop with `impossible` if no state is possible.
    """

    frames: int
    without: float
    total_variation: Interval | None
    alone: Interval | None
    cycles: Cycles
    sweep_cycles: float
    effective_samples: tuple[float, float]
    r_hat: float
    reasons: Mapping[str, int]


_Frame: TypeAlias = tuple[list[str], tuple[float, ...] | None]
"""The stop reason of each board; and distance, effective samples, R-hat and cycles, or None without a posterior."""


@dataclass(frozen=True, slots=True)
class _Frames:
    """The job of running the readings: piece n is reading n."""

    machines: Sequence[BM2Machine]
    readings: Sequence[Addresses]
    model: NetworkModel | None
    settings: FrameInput
    """Number of samples and maximum number of cycles, the same for every frame."""

    def prepare(self) -> Work:
        """Return the function that runs a reading on all boards."""
        kernels, banks = kernels_of(self.machines), self.machines[0].parameters.rng_banks

        def measured(number: int) -> _Frame:
            addresses, row = self.readings[number], None
            frame = replace(self.settings, addresses=addresses, bank=number % banks)
            found = BM2.infer(run_batches(kernels, frame))
            if found.posterior is not None:
                exact = found.posterior if self.model is None else self.model.exact(addresses)
                details = (float(found.details.get(key, 0)) for key in ("effective_samples", "r_hat"))
                cycles = max(kernel.cycles for kernel in kernels)
                row = (distance(found.posterior, exact), *details, cycles)
            return [kernel.reason.name.lower() for kernel in kernels], row

        return measured


def run_chains(
    machines: Sequence[BM2Machine],
    readings: Sequence[Addresses],
    model: NetworkModel | None,
    *,
    samples: int,
    max_cycles: int,
    advance: Callable[[], None] = lambda: None,
    run: Run = in_this_process,
) -> Sampled:
    """Run every reading on boards with these machines. Raises a BuildError if no reading gets a posterior."""
    p = machines[0].parameters
    if p.rng_reset is RngReset.FREE:
        run = in_this_process  # the generators run on from frame to frame
    settings = FrameInput(addresses=(), target_count=samples, max_cycles=max_cycles)
    job = _Frames(machines, readings, model, settings)
    frames: list[_Frame] = in_order(run, job, range(len(readings)), advance)
    reasons = Counter(reason for stopped, _ in frames for reason in stopped)
    rows = [row for _, row in frames if row is not None]
    if not rows:
        ends = ", ".join(f"{name} {count}" for name, count in sorted(reasons.items()))
        raise BuildError(f"none of the readings gives a posterior; boards stopped by: {ends}")
    distances, effective, r_hat, lengths = np.nan_to_num(np.array(rows), posinf=_INFINITE).T
    sweeps = p.burn_in + samples if p.sample_every is SampleEvery.SWEEP else 0
    lost = len(readings) - len(rows)
    everywhere = np.concatenate([distances, np.ones(lost)])
    return Sampled(
        frames=len(readings),
        without=lost / len(readings),
        total_variation=None if model is None else bootstrap(everywhere, np.mean),
        alone=None if model is None else bootstrap(distances, np.mean),
        cycles=Cycles.of(lengths),
        sweep_cycles=float(lengths.mean() / sweeps) if sweeps else 0.0,
        effective_samples=(float(np.median(effective)), float(effective.min())),
        r_hat=float(np.median(r_hat)),
        reasons=dict(reasons),
    )


def chain_resources(machine: BM2Machine, device: Device) -> Estimate:
    """Estimate the FPGA resources of a board from the parts of a BM1, because there is no VHDL of a BM2."""
    p = machine.parameters
    seed, adders = seed_width(machine), len([bits for bits in p.bits if bits]) + 1
    # each bit of a CDE's factor moves by one place in the address if the pointer is below it
    moved, state = sum(len(p.factor_bits(cde)) for cde in range(p.cdes)), p.cdes * seed + _SEQUENCER_BITS
    counts: dict[str, tuple[dict[Of, float], int]] = {
        "CDEs": ({Of.CODE_BIT: p.cdes * p.prob_bits, Of.STATE_BIT: moved}, 0),
        "histograms": ({Of.COUNTER_BIT: adders * WORD_BITS}, adders * WORD_BITS),
        "generators": ({Of.STATE_BIT: state, Of.STEP: p.cdes * p.steps_per_clock + _SEQUENCER_BITS}, state),
        "inputs": (
            {Of.WORD: 2 * p.state_words, Of.MEMORY: 2, Of.STATE_BIT: 2 * p.state_bits},
            3 * p.state_bits,
        ),
        "control": ({Of.BOARD: 1}, 1032),
    }
    parts = tuple(LogicPart(name=name, counts=of, registers=own) for name, (of, own) in counts.items())
    small = [table for table in machine.tables if 0 < table.size <= MLAB_SHAPE[0]]
    labs = len(small) * math.ceil(p.prob_bits / MLAB_SHAPE[1])
    placed = random_memories_of(p, table_length(machine))
    placed += [
        EqualMemories(words, width, 1)
        for words, width in (
            *((table.size, p.prob_bits) for table in machine.tables if table.size > MLAB_SHAPE[0]),
            (p.rng_banks, _SEQUENCER_BITS),
            (p.result_words, WORD_BITS),
            (p.stream * p.state_words, WORD_BITS),
        )
    ]
    memories = Memories(
        table_bits=sum(table.size for table in machine.tables) * p.prob_bits,
        blocks=sum(each.count * each.blocks for each in placed),
        logic_tables=len(small),
        mlabs=labs,
        alms=float(MLAB_ALMS * labs),
    )
    return Estimate(device=device, logic=Logic(parts), memories=memories)
