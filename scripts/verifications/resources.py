"""Comparison of the resource estimator with syntheses by GHDL and yosys (scripts/verify resources).

small machines --> VHDL --> Verilog (GHDL) --> yosys --> as many look-up tables, ALMs and registers as estimated?
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hdl.test.netlist import Netlist, synthesised
from hdl.test.project import HardwareToolError, image_of_parameters
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from scripts.running.flags import ScriptParser
from scripts.verifications.installation import install_programs
from services.errors import SettingsError
from toolchain.analysis.logic import COSTS, WORST_ERROR, Of, logic_of

_CELL, _THRESHOLD, _WRITTEN = SensorMode.CELL, SensorMode.THRESHOLD, PriorMode.WRITTEN


def machine(lines: int, sensors: int, **others: Any) -> BM1Parameters:
    """Return a machine of these sizes."""
    is_code = others.get("sensor_mode") is _THRESHOLD
    width = others.get("prob_bits", 8) if is_code else 4
    return BM1Parameters(lines=lines, sensor_bits=(width,) * sensors, **others)


HELD_OUT: Final = (
    machine(12, 5),
    machine(24, 2, prob_bits=6),
    machine(10, 3, prob_bits=10, counter_bits=12),
    machine(6, 3, shared=False, rng=RngKind.LFSR16, rng_banks=1),
    machine(48, 1, counter_bits=20),
    machine(80, 2),
    machine(20, 2, sensor_mode=_CELL),
    machine(12, 3, sensor_mode=_THRESHOLD, prob_bits=10),
    machine(5, 3, replicas=6),
    machine(6, 2, replicas=5, sensor_mode=_CELL, rng=RngKind.LFSR24),
    machine(10, 2, replicas=3, prior_mode=_WRITTEN),
)
"""Machines on which the estimator was not calibrated."""

CALIBRATION: Final = (
    *(machine(*size) for size in ((2, 1), (8, 3), (16, 4), (32, 3), (64, 1), (100, 2))),
    *(machine(16, 3, prob_bits=bits) for bits in (4, 12)),
    *(machine(16, 2, counter_bits=bits) for bits in (4, 16)),
    machine(8, 2, prob_bits=16),
    machine(24, 1, counter_bits=32),
    *(machine(8, 3, steps_per_clock=steps) for steps in (1, 16)),
    *(machine(8, 3, rng=rng) for rng in (RngKind.LFSR16, RngKind.LFSR24)),
    machine(8, 3, rng_banks=64),
    machine(8, 3, rng_reset=RngReset.FREE),
    machine(12, 4, prior_bits=3),
    machine(8, 3, shared=False, rng=RngKind.LFSR16),
    machine(4, 2, shared=False, steps_per_clock=1),
    machine(6, 2, shared=False, rng=RngKind.TABLE),
    machine(12, 2, rng=RngKind.TABLE, prob_bits=12),
    machine(8, 3, sensor_mode=_CELL),
    machine(16, 2, sensor_mode=_CELL),
    machine(8, 3, sensor_mode=_THRESHOLD),
    machine(16, 2, sensor_mode=_THRESHOLD, prob_bits=12),
    machine(16, 2, prior_mode=_WRITTEN),
    *(machine(4, 2, replicas=count) for count in (2, 8)),
    machine(8, 2, replicas=4),
    machine(1, 1, replicas=32),
    machine(2, 2, replicas=24, counter_bits=12),
    machine(16, 1, replicas=12, sensor_mode=_THRESHOLD, prob_bits=6),
    machine(8, 2, replicas=4, sensor_mode=_CELL),
    machine(8, 2, replicas=4, sensor_mode=_THRESHOLD),
    machine(4, 2, replicas=4, prior_mode=_WRITTEN),
)
"""Machines from which the estimator's `COSTS` are fitted; GHDL 2.0 needs at least one sensor.
"""


def verify(arguments: argparse.Namespace) -> int:
    """Synthesise the machines one after the other; exit 1 if an error exceeds `WORST_ERROR`."""
    machines = CALIBRATION if arguments.calibrate else HELD_OUT
    machines = tuple(each for each in machines if arguments.only in described(each))
    if not machines:
        print(f"error: no machine's parameters have {arguments.only!r} in them", file=sys.stderr)
        return 1
    try:
        install_programs({"ghdl": "ghdl"})
        netlists = [_compared(each) for each in machines]
    except (SettingsError, HardwareToolError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    errors = [_errors(*each) for each in zip(machines, netlists, strict=True)]
    for at, kind in enumerate(("ALUTs", "ALMs")):
        found = [abs(each[at]) for each in errors]
        print(f"{kind}: {statistics.median(found):.1%} off in the median, {max(found):.1%} at worst")
    if arguments.calibrate:
        _fit(machines, netlists)
        return 0
    failed = sum(not _is_near(each) for each in errors)
    print(f"{len(errors) - failed} passed, {failed} failed")
    return 1 if failed else 0


def described(p: BM1Parameters) -> str:
    """Describe a machine by the parameters that distinguish it."""
    plain = machine(1, 1)
    names = (name for name in p.__slots__ if name not in {"lines", "sensor_bits"})
    others = [f"{name}={getattr(p, name)}" for name in names if getattr(p, name) != getattr(plain, name)]
    return " ".join([f"{p.lines}x{p.sensors}", *others])


def _compared(p: BM1Parameters) -> Netlist:
    """Return a machine's netlist, after printing it next to the estimate."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="resources-rosbayes-") as folder:
        found = synthesised(image_of_parameters(p), Path(folder))
    ours = logic_of(p)
    print(
        f"{'ok  ' if _is_near(_errors(p, found)) else 'FAIL'} {described(p)}: "
        f"ALUTs {ours.aluts:,.0f} / {found.aluts:,}, ALMs {ours.alms:,.0f} / {found.alms:,.0f}, "
        f"registers {ours.registers:,} / {found.registers:,} ({time.monotonic() - began:.0f} s)",
        flush=True,
    )
    return found


def _errors(p: BM1Parameters, found: Netlist) -> tuple[float, float, int]:
    """Return the relative errors of the estimated ALUTs and ALMs, and the error of the registers."""
    ours = logic_of(p)
    return ours.aluts / found.aluts - 1, ours.alms / found.alms - 1, ours.registers - found.registers


def _is_near(errors: tuple[float, float, int]) -> bool:
    return max(map(abs, errors[:2])) <= WORST_ERROR and errors[2] == 0


def _fit(machines: Sequence[BM1Parameters], netlists: Sequence[Netlist]) -> None:
    """Print the costs that minimise the sum of squared relative errors, next to the current costs."""
    parts = [logic_of(each).parts for each in machines]
    counts = np.array([[sum(part.counts.get(of, 0) for part in each) for of in Of] for each in parts], float)
    aluts = _costs(counts / np.array([[each.aluts] for each in netlists]))
    alms = _costs(counts / np.array([[each.alms] for each in netlists]))
    for of, *new in zip(Of, aluts, alms, strict=True):
        print(
            f"{of:12} ALUTs {new[0]:8.3f} ({COSTS[of].aluts:8.3f})   ALMs {new[1]:8.3f} ({COSTS[of].alms:8.3f})"
        )


def _costs(relative: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return non-negative costs, one per column, with which the sums of the rows are nearest to 1 (least squares)."""
    kept = np.full(relative.shape[1], True)
    while True:
        costs = np.zeros(len(kept))
        costs[kept] = np.linalg.lstsq(relative[:, kept], np.ones(len(relative)), rcond=None)[0]
        if (costs >= 0).all():
            return costs
        kept &= costs >= 0


if __name__ == "__main__":
    parser = ScriptParser("scripts/verify resources", __doc__)
    parser.switch("--calibrate", "fit the costs again to other machines")
    parser.flag("--only", "machines whose parameters have this in it", "")
    parser.run_at_once(verify)
