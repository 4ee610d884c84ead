"""Small machines that are simulated, synthesised, and that the estimator is calibrated on."""

from dataclasses import dataclass

import numpy as np

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode

ADDRESS_BITS = 4


@dataclass(frozen=True)
class Case:
    """A small machine; its tables and frames are drawn with `seed`."""

    parameters: BM1Parameters
    seed: int

    @property
    def name(self) -> str:
        """Lines x sensors, and what is not the default."""
        p = self.parameters
        return (
            f"{p.lines}x{p.sensors}, codes {p.prob_bits}, counters {p.counter_bits}, {p.rng}"
            + ("" if p.shared else " a cell")
            + f", {p.steps_per_clock} steps, {p.rng_banks} banks"
            + (", free" if p.rng_reset is RngReset.FREE else "")
            + (", written prior" if p.prior_mode is PriorMode.WRITTEN else "")
            + (f", {p.sensor_mode}" if p.sensor_mode is not SensorMode.COLUMN else "")
            + (f", {p.replicas} replicas" if p.replicas > 1 else "")
        )


def case(lines: int, sensors: int, seed: int, **others) -> Case:
    """Return the case of a machine of these sizes."""
    width = others.get("prob_bits", 8) if others.get("sensor_mode") is SensorMode.THRESHOLD else ADDRESS_BITS
    return Case(BM1Parameters(lines=lines, sensor_bits=(width,) * sensors, **others), seed)


SIMULATED = (
    case(4, 2, 1),
    case(8, 3, 2),
    case(16, 4, 3),
    case(5, 1, 4, prob_bits=4, counter_bits=4, rng=RngKind.LFSR8, rng_banks=1),
    case(6, 3, 5, prob_bits=12, rng=RngKind.LFSR16, steps_per_clock=1, prior_bits=2),
    case(4, 2, 6, rng=RngKind.LFSR24, rng_reset=RngReset.FREE),
    case(4, 2, 7, shared=False, rng_banks=3),
    case(4, 2, 8, prior_mode=PriorMode.WRITTEN),
    case(5, 2, 13, sensor_mode=SensorMode.CELL),
    case(4, 3, 14, sensor_mode=SensorMode.THRESHOLD, prob_bits=6),
    case(4, 2, 15, replicas=3),
    case(3, 2, 16, replicas=5, prior_bits=2, rng=RngKind.LFSR16, steps_per_clock=1),
    case(4, 2, 17, replicas=3, sensor_mode=SensorMode.CELL, rng_banks=1),
    case(3, 2, 18, replicas=4, sensor_mode=SensorMode.THRESHOLD, rng_reset=RngReset.FREE),
    case(3, 2, 19, replicas=3, prior_mode=PriorMode.WRITTEN, shared=False, rng_banks=2),
    case(1, 1, 20, replicas=40, sensor_mode=SensorMode.CELL, counter_bits=4),
)
CELL, THRESHOLD, WRITTEN = SensorMode.CELL, SensorMode.THRESHOLD, PriorMode.WRITTEN
SYNTHESISED = (
    case(12, 5, 4),
    case(24, 2, 5, prob_bits=6),
    case(10, 3, 6, prob_bits=10, counter_bits=12),
    case(6, 4, 7, rng=RngKind.LFSR24, rng_banks=8),
    case(20, 2, 8, counter_bits=20, rng_banks=1),
    case(6, 3, 9, shared=False, rng_banks=1, rng=RngKind.LFSR16),
    case(40, 3, 10),
    case(64, 1, 11, counter_bits=32),
    case(128, 1, 12),
    case(48, 2, 13, sensor_mode=CELL),
    case(24, 3, 14, sensor_mode=THRESHOLD, prob_bits=10),
    case(6, 3, 15, replicas=6),
    case(3, 1, 16, replicas=24, counter_bits=12),
    case(10, 2, 17, replicas=5, sensor_mode=CELL, rng=RngKind.LFSR24),
    case(12, 1, 18, replicas=6, sensor_mode=THRESHOLD, prob_bits=6),
    case(10, 2, 19, replicas=3, prior_mode=WRITTEN),
)
"""None of them is one of those that the estimator is calibrated on."""
_SIZES = {
    "": ((2, 1), (4, 2), (8, 3), (16, 4), (8, 6), (32, 3), (48, 2)),
    "cell": ((4, 2), (8, 3), (16, 2), (32, 2)),
    "threshold": ((4, 2), (8, 3), (16, 2)),
    "written": ((4, 2), (24, 2)),
}
_MODES = {
    "": {},
    "cell": {"sensor_mode": CELL},
    "threshold": {"sensor_mode": THRESHOLD},
    "written": {"prior_mode": WRITTEN},
}
_CHANGES = (
    *({"prob_bits": bits} for bits in (4, 12)),
    *({"rng_banks": banks} for banks in (1, 64)),
    *({"rng": rng} for rng in (RngKind.LFSR16, RngKind.LFSR24)),
    {"steps_per_clock": 1},
    {"rng_reset": RngReset.FREE},
)
CALIBRATION = (
    *(case(*size, 1, **_MODES[mode]) for mode, sizes in _SIZES.items() for size in sizes),
    *(case(8, 3, 1, **changes) for changes in _CHANGES),
    *(case(16, 2, 1, counter_bits=bits) for bits in (16, 4)),
    *(case(16, 2, 1, sensor_mode=THRESHOLD, prob_bits=bits) for bits in (12, 4)),
    *(case(lines, sensors, 1, replicas=count) for lines, sensors, count in ((4, 2, 2), (4, 2, 4), (4, 2, 8))),
    *(
        case(lines, sensors, 1, replicas=count)
        for lines, sensors, count in ((8, 2, 4), (2, 2, 16), (1, 1, 32))
    ),
    case(8, 2, 1, prob_bits=16),
    case(24, 1, 1, counter_bits=32),
    case(6, 5, 1, prob_bits=6, counter_bits=12),
    case(12, 4, 1, prior_bits=3),
    case(8, 2, 1, shared=False, rng_banks=1, rng=RngKind.LFSR16),
    case(4, 3, 1, shared=False, rng_banks=4),
    case(4, 2, 1, replicas=4, counter_bits=16),
    case(4, 2, 1, replicas=4, shared=False, rng_banks=1, rng=RngKind.LFSR16),
    case(16, 1, 1, replicas=3, prob_bits=6, rng=RngKind.LFSR24),
    case(4, 2, 1, replicas=4, prior_mode=WRITTEN),
    case(8, 2, 1, replicas=4, sensor_mode=CELL),
    case(4, 3, 1, replicas=8, sensor_mode=CELL),
    case(8, 2, 1, replicas=4, sensor_mode=THRESHOLD),
)
"""What `toolchain.analysis.resources.logic.COSTS` are fitted to."""


def machine_of(case: Case) -> BM1Machine:
    """Return the case's machine, with random tables, a fifth of their codes 0 or all-ones."""
    parameters = case.parameters
    random = np.random.default_rng(case.seed)

    def codes(rows: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
        table = random.integers(1, parameters.ones_code, (rows, parameters.lines)).astype(np.uint16)
        kind = random.random(table.shape)
        table[kind < 0.05] = 0
        table[kind > 0.85] = parameters.ones_code
        return table

    tables = [codes(1 << bits) for bits in parameters.sensor_bits]
    if not parameters.has_tables:
        tables = []
    for table in tables:
        table[1] = 0  # an address on which no line can count
        table[-1] = parameters.ones_code
    return BM1Machine(parameters, codes(parameters.prior_addresses), tuple(tables))
