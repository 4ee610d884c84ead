"""Synthesis of small machines by yosys, and the estimator's calibration on it."""

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.verification.resources.cases import CALIBRATION, Case, machine_of
from tests.verification.resources.tools import run
from tests.verification.resources.verilog import verilog
from toolchain.analysis.resources.logic import COSTS, Of, logic_of

FIT_ROUNDS = 20_000
"""Of a descent along one cost after the other; further ones change no third digit."""


@dataclass(frozen=True, kw_only=True)
class Alms:
    """Logic: look-up tables of up to 4, 5 and 6 inputs, bits of carry chains, registers."""

    luts: float = 0.0
    luts5: float = 0.0
    luts6: float = 0.0
    sums: float = 0.0
    registers: float = 0.0

    @property
    def aluts(self) -> float:
        """Look-up tables of all kinds, carry chains among them."""
        return self.luts + self.luts5 + self.luts6 + self.sums

    @property
    def alms(self) -> float:
        """ALMs: one holds a 6-input table, or two of up to 4, or two bits of a carry chain; a 5-input one shares if it can."""
        return self.luts6 + 0.75 * self.luts5 + 0.5 * (self.luts + self.sums)


def synthesised(case: Case, folder: Path) -> Alms:
    """Return what yosys makes of the text, its tables left out."""
    text = folder / "bm1.v"
    text.write_text(verilog(machine_of(case), tables=False))
    stat = folder / "stat.json"
    script = f"read_verilog {text}; synth_intel_alm -top bm1 -family cyclonev -noiopad -noclkbuf; tee -o {stat} stat -json"
    run(["yosys", "-q", "-p", script])
    cells = json.loads(stat.read_text())["modules"]["\\bm1"]["num_cells_by_type"]
    cells = {name.removeprefix("MISTRAL_"): count for name, count in cells.items()}
    return Alms(
        luts=sum(cells.get(f"ALUT{inputs}", 0) for inputs in range(2, 5)) + cells.get("NOT", 0),
        luts5=cells.get("ALUT5", 0),
        luts6=cells.get("ALUT6", 0),
        sums=cells.get("ALUT_ARITH", 0),
        registers=cells.get("FF", 0),
    )


def calibrate(cases, folder):
    """Synthesise the machines that the estimator is calibrated on, and print the best costs beside the present ones."""
    counted, aluts, alms = [], [], []
    for each in cases:
        found = synthesised(each, folder)
        estimate = logic_of(each.parameters, whole_words=False)
        bits = dict.fromkeys(Of, 0.0)
        for part in estimate.parts:
            for of, count in part.counts.items():
                bits[of] += count
        sums = sum(part.sums for part in estimate.parts)
        counted.append(list(bits.values()))
        aluts.append((found.aluts, sums))
        alms.append((found.alms, sums / 2))
        print(f"synthesised {each.name}", file=sys.stderr)
    luts, luts_error = fitted(np.array(counted), np.array(aluts))
    modules, alms_error = fitted(np.array(counted), np.array(alms))
    for of, lut, module in zip(Of, luts, modules, strict=True):
        print(
            f"{of:12} luts {lut:8.3f}  ({COSTS[of].luts:8.3f})   ALMs {module:8.3f}  ({COSTS[of].alms:8.3f})"
        )
    print(f"largest relative error of {len(cases)} machines: ALUTs {luts_error:.1%}, ALMs {alms_error:.1%}")


def fitted(counted, found):
    """Return costs of 0 or more with the least squares of relative errors, and the largest of these.

    Args:
        counted: float64[machines, kinds], what each machine has of each kind.
        found: float64[machines, 2], what a synthesis found and how much of that is carry chains, which are counted exactly.
    """
    whole, chains = found.T
    fixed = list(Of).index(Of.RESULT_BIT)
    costs = np.zeros(len(Of))
    costs[fixed] = COSTS[Of.RESULT_BIT].luts
    relative = counted / whole[:, np.newaxis]
    products, wanted = relative.T @ relative, relative.T @ ((whole - chains) / whole)
    for _ in range(FIT_ROUNDS):
        for at in range(len(costs)):
            if at != fixed:
                costs[at] += (wanted[at] - products[at] @ costs) / products[at, at]
                costs[at] = max(costs[at], 0.0)
    return costs.tolist(), float(np.abs((counted @ costs + chains) / whole - 1).max())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="resources-rosbayes-") as where:
        calibrate(CALIBRATION, Path(where))
