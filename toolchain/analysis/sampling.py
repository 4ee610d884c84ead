"""Runs of a BM2 on drawn readings, compared with exact inference, and its resources on an FPGA."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from machines import make_bm2_kernel
from machines.bm2 import BM2Machine
from machines.bm2_estimate import Chain, estimate, searched_counts
from machines.bm2_kind import run_batches
from machines.kind import FrameInput
from machines.parameters import SampleEvery
from toolchain.analysis.accuracy import Cycles, Interval, bootstrap
from toolchain.analysis.chain import distance
from toolchain.analysis.logic import (
    MLAB_ALMS,
    MLAB_SHAPE,
    WORD_BITS,
    Device,
    Logic,
    LogicPart,
    Memories,
    Of,
    blocks_of,
)
from toolchain.analysis.readings import check_frames
from toolchain.analysis.resources import Estimate
from toolchain.deployment import Dimension
from toolchain.errors import BuildError
from toolchain.models.network import NetworkModel

_INFINITE: Final = 1e9
Addresses = tuple[int, ...]
"""A frame's readings: an address per known variable."""


def drawn_readings(model: NetworkModel, frames: int, seed: int) -> list[Addresses]:
    """Draw readings of all known variables from the model, each one given those before it."""
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
    """Results of a BM2 on some readings; intervals are of 95 %, over frames.

    Attributes:
        frames: Frames with a posterior.
        total_variation: Mean distance of the posteriors from exact inference; None without a model.
        cycles: Cycles of the longest-running board.
        sweep_cycles: Cycles of a sweep, in the mean; 0 if samples are taken after every move.
        effective_samples: Effective samples of a frame, in the median and at least; 0 if unknown.
        r_hat: The median of frames; 0 for one board, 1e9 if it is infinite.
        reasons: How often boards stopped for each reason; `impossible` for readings without a possible state.
    """

    frames: int
    total_variation: Interval | None
    cycles: Cycles
    sweep_cycles: float
    effective_samples: tuple[float, float]
    r_hat: float
    reasons: Mapping[str, int]


class SampledBoards:
    """Boards that each run a chain of the same machine."""

    def __init__(self, machines: Sequence[BM2Machine], max_cycles: int) -> None:
        # a stream changes nothing but the way of the samples to the host
        self.machines = [
            replace(machine, parameters=replace(machine.parameters, stream=0)) for machine in machines
        ]
        self._kernels = [make_bm2_kernel(machine) for machine in self.machines]
        self._max_cycles = max_cycles

    def run(self, addresses: Addresses, bank: int, samples: int) -> tuple[list[Chain], int]:
        """Run a frame in batches like the host; return the chains and the cycles of the longest-running board."""
        p = self.machines[0].parameters
        frame = FrameInput(
            addresses=addresses, target_count=samples, max_cycles=self._max_cycles, bank=bank % p.rng_banks
        )
        ended = run_batches(self._kernels, frame)
        chains = [
            Chain(kernel.reason, searched_counts(p, np.array(batches)))
            for kernel, batches in zip(self._kernels, ended, strict=True)
        ]
        return chains, max(kernel.cycles for kernel in self._kernels)

    def measure(
        self,
        readings: Sequence[Addresses],
        samples: int,
        model: NetworkModel | None,
        advance: Callable[[], None] = lambda: None,
    ) -> Sampled:
        """Run every reading and compare with the model; a BuildError if no reading gives a posterior."""
        p = self.machines[0].parameters
        rows, reasons = [], Counter[str]()
        for frame, addresses in enumerate(readings):
            chains, cycles = self.run(addresses, frame, samples)
            reasons.update(chain.reason.name.lower() for chain in chains)
            found = estimate(chains)
            if (posterior := found.posterior) is not None:
                exact = posterior if model is None else model.exact(addresses)
                rows.append((distance(posterior, exact), found.effective_samples, found.r_hat, cycles))
            advance()
        if not rows:
            ends = ", ".join(f"{name} {count}" for name, count in sorted(reasons.items()))
            raise BuildError(f"none of the readings gives a posterior; boards stopped by: {ends}")
        distances, effective, r_hat, lengths = np.nan_to_num(
            np.array(rows, dtype=np.float64), posinf=_INFINITE
        ).T
        percentile = bootstrap(lengths, lambda a, **k: np.quantile(a, 0.95, **k))
        sweeps = p.burn_in + samples if p.sample_every is SampleEvery.SWEEP else 0
        return Sampled(
            frames=len(rows),
            total_variation=None if model is None else bootstrap(distances, np.mean),
            cycles=Cycles(
                median=bootstrap(lengths, np.median), percentile_95=percentile, worst=int(lengths.max())
            ),
            sweep_cycles=float(lengths.mean() / sweeps) if sweeps else 0.0,
            effective_samples=(float(np.median(effective)), float(effective.min())),
            r_hat=float(np.median(r_hat)),
            reasons=dict(reasons),
        )


def chain_resources(machine: BM2Machine, device: Device) -> Estimate:
    """Return the resources of a board, estimated from the units of a BM1; there is no VHDL of a BM2 to compare."""
    p = machine.parameters
    seed, adders = p.rng.lfsr_bits or 16, len([bits for bits in p.bits if bits]) + 1
    # each local bit of a CDE moves by one place in the address if the pointer is below it
    moved, state = sum(len(p.factor_bits(cde)) for cde in range(p.cdes)), p.cdes * seed + 16
    counts: dict[str, tuple[dict[Of, float], int]] = {
        "CDEs": ({Of.CODE_BIT: p.cdes * p.prob_bits, Of.STATE_BIT: moved}, 0),
        "histograms": ({Of.COUNTER_BIT: adders * WORD_BITS}, adders * WORD_BITS),
        "generators": ({Of.STATE_BIT: state, Of.STEP: p.cdes * p.steps_per_clock + 16}, state),
        "inputs": (
            {Of.WORD: 2 * p.state_words, Of.MEMORY: 2, Of.STATE_BIT: 2 * p.state_bits},
            3 * p.state_bits,
        ),
        "control": ({Of.BOARD: 1}, 1032),
    }
    parts = tuple(LogicPart(name=name, counts=of, registers=own) for name, (of, own) in counts.items())
    small = [table for table in machine.tables if 0 < table.size <= MLAB_SHAPE[0]]
    labs = len(small) * math.ceil(p.prob_bits / MLAB_SHAPE[1])
    blocks = [(table.size, p.prob_bits) for table in machine.tables if table.size > MLAB_SHAPE[0]]
    blocks += [
        (p.rng_banks * p.cdes, seed),
        (p.result_words, WORD_BITS),
        (p.stream * p.state_words, WORD_BITS),
    ]
    memories = Memories(
        table_bits=sum(table.size for table in machine.tables) * p.prob_bits,
        blocks=sum(blocks_of(words, width) for words, width in blocks),
        logic_tables=len(small),
        mlabs=labs,
        alms=float(MLAB_ALMS * labs),
    )
    return Estimate(device=device, logic=Logic(parts), memories=memories)
