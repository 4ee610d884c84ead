"""Simulation by GHDL and cocotb: analysis of an image's hardware, and runs of benches on it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hdl.test.project import write_hardware_files

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hdl.test.project import Image

HDL: Final = Path(__file__).resolve().parent.parent
ROOT: Final = HDL.parent

SOURCES: Final = (
    "bm_register_map.vhd",
    "bm1_utilities.vhd",
    "bm_register_block.vhd",
    "bm1_table.vhd",
    "bm1_stochastic_bitstream_generator.vhd",
    "bm1_prior_element.vhd",
    "bm1_tile_element.vhd",
    "bm1_counter.vhd",
    "bm1_lfsr.vhd",
    "bm1_table_player.vhd",
    "bm1_generators.vhd",
    "bm1_control.vhd",
    "bm1_matrix.vhd",
    "bm1_core.vhd",
    "bm1_words.vhd",
    "bm1_readout.vhd",
    "bm1_guard.vhd",
    "bm1_registers.vhd",
    "bm1_axi.vhd",
    "bm1.vhd",
)
"""The hardware's files in the order of analysis, after the generated package of parameters."""

SIMULATED_TABLE: Final = "simulation/bm1_table_textio.vhd"

_LIMIT_S: Final = 1200.0


class HardwareToolError(Exception):
    """A tool is missing or failed; the text names it and ends with its output."""


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
        hdl: Folder of the VHDL, which differs for mutants.
        more_sources: Further files, relative to `hdl`, after the others.

    Raises:
        HardwareToolError: GHDL is not installed or refused a file.
    """
    write_hardware_files(image, folder)
    sources = [hdl / SOURCES[0], folder / "bm1_parameters.vhd", *(hdl / name for name in SOURCES[1:])]
    sources += [hdl / SIMULATED_TABLE, *(hdl / name for name in more_sources)]
    run_tool(["ghdl", "-a", "--std=08", *map(str, sources)], folder)


def run_bench(
    module: str,
    folder: Path,
    top: str = "bm1",
    variables: Mapping[str, str] | None = None,
    options: Sequence[str] = (),
) -> Outcome:
    """Run a cocotb module on an analysed design, and return what failed.

    Args:
        module: The bench's module, such as `hdl.test.bench_board`.
        folder: Folder in which `prepare` analysed the design.
        top: The entity under test.
        variables: Further environment variables for the bench.
        options: Further options of the simulation, such as generics.

    Raises:
        HardwareToolError: The simulation did not end, or ended without a verdict.
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


def run_tool(
    command: Sequence[str],
    folder: Path,
    environment: Mapping[str, str] | None = None,
    *,
    separate: bool = False,
) -> str:
    """Run a tool in a folder and return its output, with `separate` without its warnings.

    Raises:
        HardwareToolError: It is not installed, failed, or did not end in time.
    """
    if shutil.which(command[0]) is None:
        message = f"{command[0]} is not installed (Debian: apt-get install {command[0]})"
        raise HardwareToolError(message)
    try:
        done = subprocess.run(
            command, check=True, cwd=folder, env=environment, capture_output=True, text=True, timeout=_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        message = f"{command[0]} did not end within {_LIMIT_S:.0f} s"
        raise HardwareToolError(message) from None
    except subprocess.CalledProcessError as error:
        message = f"{command[0]} failed: {(error.stdout + error.stderr).strip()[-1500:]}"
        raise HardwareToolError(message) from None
    return done.stdout if separate else done.stdout + done.stderr


def unit_benches() -> dict[str, tuple[str, dict[str, int]]]:
    """Return the benches of single units: the module of each, and the unit with its generics."""
    from hdl.test.guard_generics import GENERICS

    return {
        "hdl.test.bench_register_block": ("bm_register_block", {}),
        "hdl.test.bench_guard": ("bm1_guard", GENERICS),
    }
