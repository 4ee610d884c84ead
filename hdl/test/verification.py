"""Named checks of the hardware: sessions on random machines, benches of units, and proofs."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdl.test.project import HDL
from hdl.test.proofs import failed_proof, proofs
from hdl.test.random_machines import random_case
from hdl.test.simulation import prepare, run_bench, unit_benches

BOARD_BENCH: Final = "hdl.test.bench_board"
_OPTIONS: Final = ("-gMEMORY_FOLDER=Memory_MIFs/",)


@dataclass(frozen=True)
class Check:
    """One check of the VHDL.

    Attributes:
        kind: Kind of the check: `session`, `unit` or `proof`.
        what: The seed of the session, the module of the unit's bench, or the name of the proof.
    """

    kind: str
    what: str

    @property
    def name(self) -> str:
        """Description of the check, for people."""
        if self.kind == "session":
            return random_case(int(self.what)).name
        return f"{self.kind}: {self.what.rpartition('.')[2]}"

    def failure(self, hdl: Path = HDL, frames: int | None = None) -> str | None:
        """Run the check, and return why the check fails, or None if it succeeds.

        Args:
            hdl: Folder of the VHDL, either `HDL` or a changed copy (a mutant).
            frames: Number of frames in a session, or None for the usual number.

        Raises:
            HardwareToolError: A tool is missing or refuses the hardware.
        """
        with tempfile.TemporaryDirectory(prefix="hdl-rosbayes-") as where:
            folder = Path(where)
            if self.kind == "proof":
                return failed_proof(self.what, folder, hdl)
            if self.kind == "unit":
                top, generics = unit_benches()[self.what]
                prepare(random_case(0).image, folder, hdl)
                options = [f"-g{name}={value}" for name, value in generics.items()]
                outcome = run_bench(self.what, folder, top, options=options)
            else:
                prepare(random_case(int(self.what)).image, folder, hdl)
                variables = {"HDL_SEED": self.what} | ({} if frames is None else {"HDL_FRAMES": str(frames)})
                outcome = run_bench(BOARD_BENCH, folder, variables=variables, options=_OPTIONS)
        return "; ".join(failure.splitlines()[0] for failure in outcome.failures) or None


def sessions(count: int) -> list[Check]:
    """Return the checks that run a session of frames on each of the first `count` random machines."""
    return [Check("session", str(seed)) for seed in range(count)]


def units() -> list[Check]:
    """Return the benches of single units."""
    return [Check("unit", module) for module in unit_benches()]


def formal() -> list[Check]:
    """Return the proofs."""
    return [Check("proof", name) for name in proofs()]
