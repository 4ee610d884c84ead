"""Verification of the VHDL: comparison with the emulated board, and proofs (scripts/verify hdl).

random machines --> GHDL, driven through AXI4-Lite --> what the emulated board answers?
the boat        --> GHDL or Verilator, behind the link   --> what four emulated boards answer?
units           --> GHDL                           --> values that no machine reaches
VHDL            --> Verilog (GHDL) --> yosys        --> properties for every input
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from hdl.test.mutants import MUTANTS, Mutant, caught_by
from hdl.test.project import HardwareToolError
from hdl.test.verification import Check, formal, sessions, units
from scripts.running.flags import ScriptParser
from scripts.verifications.installation import install_programs
from scripts.verifications.simulated_boat import FRAMES, SimulatedBoat
from services.errors import SettingsError
from toolchain.hardware.simulation import Simulator

_Item = TypeVar("_Item")

SESSIONS = 60
"""Number of random machines in the matrix."""


def main() -> int:
    """Run the matrix or the mutants; exit 1 if a check fails or a mutant is not found."""
    parser = ScriptParser(prog="scripts/verify hdl", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--mutants", action="store_true", help="check that mistakes in the VHDL are found, one by one"
    )
    parser.add_argument("--sessions", type=int, default=SESSIONS, metavar="N", help="random machines")
    parser.add_argument("--only", default="", metavar="TEXT", help="what has this in its name")
    arguments = parser.parse_args()
    try:
        install_programs(
            {"ghdl": "ghdl"} if arguments.mutants else {tool: tool for tool in Simulator.VERILATOR.tools}
        )
    except SettingsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    began = time.monotonic()
    if arguments.mutants:
        mutants = [each for each in MUTANTS if arguments.only in each.name]
        verdicts = _together(_try_mutant, mutants)
    else:
        boat = [SimulatedBoat("verilator", FRAMES), SimulatedBoat("ghdl", 1)]
        every: list[Check | SimulatedBoat] = [*boat, *units(), *formal(), *sessions(arguments.sessions)]
        checks = [each for each in every if arguments.only in each.name]
        verdicts = _together(_try_check, checks)
    passed = sum(verdicts)
    if not verdicts:
        print(f"error: nothing has {arguments.only!r} in its name", file=sys.stderr)
    print(f"{passed} passed, {len(verdicts) - passed} failed ({time.monotonic() - began:.0f} s)")
    return 0 if verdicts and all(verdicts) else 1


def _together(run: Callable[[_Item], bool], items: Sequence[_Item]) -> list[bool]:
    """Run all checks, one per core at a time."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return list(pool.map(run, items))


def _try_check(check: Check | SimulatedBoat) -> bool:
    began = time.monotonic()
    try:
        why = check.failure()
    except HardwareToolError as error:
        why = str(error)
    verdict = "ok  " if why is None else "FAIL"
    print(
        f"{verdict} {check.name}{'' if why is None else f': {why}'} ({time.monotonic() - began:.1f} s)",
        flush=True,
    )
    return why is None


def _try_mutant(mutant: Mutant) -> bool:
    began = time.monotonic()
    try:
        found = caught_by(mutant)
    except (HardwareToolError, ValueError) as error:
        print(f"FAIL {mutant.name}: {error}", flush=True)
        return False
    said = "FAIL not found" if found is None else f"ok   found by {found[0].name}"
    print(f"{said}: {mutant.name} ({time.monotonic() - began:.1f} s)", flush=True)
    return found is not None


if __name__ == "__main__":
    sys.exit(main())
