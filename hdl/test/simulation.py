"""Simulation by GHDL and cocotb: analysis of an image's hardware, and runs of benches on it."""

from __future__ import annotations

import os
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from hdl.test.project import (
    HDL,
    PARAMETERS,
    SOURCES,
    HardwareToolError,
    in_order,
    run_tool,
    write_hardware_files,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from hdl.test.project import Image

ROOT: Final = HDL.parent

SIMULATED_TABLE: Final = "simulation/bm1_table_textio.vhd"


@dataclass(frozen=True)
class Outcome:
    """The failures that a bench found."""

    failures: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """True if every test of the bench passed."""
        return not self.failures


def prepare(image: Image, folder: Path, hdl: Path = HDL, more_sources: Sequence[str] = ()) -> None:
    """Write an image's files into a folder and analyse its hardware there.

    Args:
        image: Image of the board.
        folder: Folder of the simulation.
        hdl: Folder of the VHDL. A changed copy of `HDL` is a mutant.
        more_sources: Further VHDL files to analyse last, relative to `hdl`.

    Raises:
        HardwareToolError: GHDL is not installed or refused a file.
    """
    write_hardware_files(image, folder)
    names = [*SOURCES, SIMULATED_TABLE, *more_sources]
    sources = in_order([hdl / name for name in names], folder / PARAMETERS)
    run_tool(["ghdl", "-a", "--std=08", *sources], folder)


def run_bench(
    module: str,
    folder: Path,
    top: str = "bm1",
    variables: Mapping[str, str] | None = None,
    options: Sequence[str] = (),
) -> Outcome:
    """Run a cocotb module on an analysed design, and return the failures.

    Args:
        module: Name of the cocotb module, such as `hdl.test.bench_board`.
        folder: Folder in which `prepare` has analysed the design.
        top: Name of the entity under test.
        variables: Additional environment variables for the cocotb module.
        options: Additional options of the simulation, such as generics.

    Raises:
        HardwareToolError: The simulation did not end, or it ended without a verdict.
    """
    import cocotb_tools.config
    import find_libpython

    results = folder / f"{module.rpartition('.')[2]}.xml"
    results.unlink(missing_ok=True)
    python_library = find_libpython.find_libpython() or ""
    users = (python_library, cocotb_tools.config.pygpi_entry_point())
    environment = os.environ | {
        "COCOTB_TEST_MODULES": module,
        "COCOTB_TOPLEVEL": top,
        "TOPLEVEL_LANG": "vhdl",
        "COCOTB_RESULTS_FILE": str(results),
        "COCOTB_LOG_LEVEL": "WARNING",
        "COCOTB_TRUST_INERTIAL_WRITES": "1",
        "GPI_USERS": ";".join(users),
        "PYGPI_PYTHON_BIN": sys.executable,
        "PYTHONPATH": str(ROOT),
        **(variables or {}),
    }
    library = cocotb_tools.config.lib_entry("vpi", "ghdl")
    command = ["ghdl", "-r", "--std=08", top, f"--vpi={library}", "--ieee-asserts=disable-at-0", *options]
    try:
        said = run_tool(command, folder, environment)
    except HardwareToolError as error:
        # it ran and failed, for example by an index out of bounds or an assertion
        if "simulation failed" not in str(error):
            raise
        return Outcome((next(line for line in str(error).splitlines() if ":error:" in line),))
    if not results.is_file():
        message = f"the simulation of {top} ended without a verdict: {said.strip()[-600:]}"
        raise HardwareToolError(message)
    found = ET.parse(results).getroot()  # noqa: S314 - our own cocotb wrote it
    failures = [
        (failure.get("error_msg") or failure.get("message") or failure.text or "").strip()
        for test in found.iter("testcase")
        for failure in test.iter("failure")
    ]
    if not list(found.iter("testcase")):
        message = f"{module} has no test"
        raise HardwareToolError(message)
    return Outcome(tuple(failures))


def unit_benches() -> dict[str, tuple[str, dict[str, int]]]:
    """Return the benches of single units by module: for each, the unit and its generics."""
    from hdl.test.guard_generics import GENERICS

    return {
        "hdl.test.bench_register_block": ("bm_register_block", {}),
        "hdl.test.bench_guard": ("bm1_guard", GENERICS),
    }
