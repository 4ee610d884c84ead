"""Simulations of a board's hardware, compiled once for each image into a folder that the user names."""

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from machines.parameters import RngKind
from pcie_shim.programming_file import Image
from toolchain.hardware.board_files import MEMORY_FOLDER, board_memories, write_board_files
from toolchain.hardware.sources import HDL, SOURCES, in_order, verilog
from toolchain.hardware.tools import HardwareToolError, missing, run_tool

_BUILDING: Final = "building-"
_TABLE_VHDL: Final = "simulation/bm1_table_textio.vhd"
_BENCH_VHDL: Final = "simulation/bm1_simulated.vhd"
_TABLE_VERILOG: Final = "simulation/bm1_table.v"
_BENCH_CPP: Final = "simulation/bm1_simulated.cpp"
_QUOTED_BITS: Final = re.compile(r'= "([01]+)";')
_EXECUTABLE: Final = "Vbm1"


class Simulator(StrEnum):
    """A simulator of the hardware."""

    GHDL = "ghdl"
    """GHDL: interprets the VHDL; compiled within seconds."""
    VERILATOR = "verilator"
    """Verilator, after a translation to Verilog by GHDL: a hundred times as fast, compiled within minutes."""

    @property
    def tools(self) -> tuple[str, ...]:
        """The programs that it needs, which are also names of Debian's packages."""
        return ("ghdl",) if self is Simulator.GHDL else ("ghdl", "verilator", "make", "g++")


@dataclass(frozen=True, slots=True)
class Compiled:
    """A compiled simulation, which executes requests from its standard input (docs/hardware/simulation.md)."""

    command: tuple[str, ...]
    """Its command."""
    folder: Path
    """The folder in which the command runs."""


def check_tools(simulator: Simulator) -> None:
    """Raise a HardwareToolError unless the simulator, and the VHDL that it reads, are installed."""
    absent = missing(simulator.tools)
    if absent:
        raise HardwareToolError(
            f"{' and '.join(absent)} not found: a simulation of the hardware needs them "
            f"(Debian: apt-get install {' '.join(absent)})"
        )
    if not (HDL / _BENCH_VHDL).is_file():
        raise HardwareToolError(
            f"{HDL / _BENCH_VHDL} does not exist: the wheel has no VHDL, so simulate the hardware with the project's folder"
        )


def compiled(image: Image, simulator: Simulator, folder: Path, on_compile: Callable[[str], None]) -> Compiled:
    """Return the simulation of an image's hardware, compiled unless it is in the folder already.

    Args:
        image: Image of the board.
        simulator: The simulator.
        folder: Folder of compiled hardware, which is created; nobody else may be able to change it.
        on_compile: Called with a sentence before a compilation.

    Raises:
        HardwareToolError: A tool is missing or failed, the machine exists only in emulation, or the folder
            is unusable.
    """
    check_tools(simulator)
    if image.machine.parameters.rng is RngKind.IDEAL:
        raise HardwareToolError(
            "rng = ideal exists only emulated: build the deployment with an LFSR or a table"
        )
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
        if found.st_uid != os.geteuid() or found.st_mode & 0o022:
            raise HardwareToolError(
                f"{folder} can be changed by other users, whose programs would run as yours: name another folder"
            )
        kept = folder.absolute() / _key(image, simulator)
        if not kept.is_dir():
            on_compile(f"{simulator} compiles the hardware of image {image.image_hash[:12]} (once) ...")
            _compile(image, simulator, kept)
    except OSError as error:
        raise HardwareToolError(
            f"{folder} cannot hold the compiled hardware ({error.strerror}): free space, or name another folder"
        ) from None
    if simulator is Simulator.VERILATOR:
        return Compiled((str(kept / _EXECUTABLE),), kept)
    # memories are larger than GHDL's default limit of an object, and its warnings would be among the answers
    options = (f"-gBOARD={image.partition.index}", "--max-stack-alloc=0", "--ieee-asserts=disable")
    return Compiled(("ghdl", "-r", "--std=08", "bm1_simulated", *options), kept)


def _compile(image: Image, simulator: Simulator, kept: Path) -> None:
    """Compile a simulation in a temporary folder and move it, so that the folder never holds an incomplete one."""
    with tempfile.TemporaryDirectory(prefix=_BUILDING, dir=kept.parent, ignore_cleanup_errors=True) as where:
        finished = Path(where) / "finished"
        finished.mkdir()
        (_compile_ghdl if simulator is Simulator.GHDL else _compile_verilator)(image, finished)
        try:
            finished.rename(kept)
        except OSError:
            if not kept.is_dir():  # otherwise another board with this image was faster
                raise


def _compile_ghdl(image: Image, folder: Path) -> None:
    """Analyse copies of the VHDL, because GHDL reads them again at each start."""
    write_board_files(image, folder)
    names = [*SOURCES, _TABLE_VHDL, _BENCH_VHDL]
    for name in names:
        shutil.copyfile(HDL / name, folder / Path(name).name)
    run_tool(["ghdl", "-a", "--std=08", *in_order([Path(name).name for name in names])], folder)


def _compile_verilator(image: Image, folder: Path) -> None:
    """Compile an executable, and write the memories for it."""
    with tempfile.TemporaryDirectory(prefix=_BUILDING, dir=folder.parent) as where:
        work = Path(where)
        write_board_files(image, work)
        generics: dict[str, int | str] = {
            "BOARD": image.partition.index,
            "MEMORY_FOLDER": f"{MEMORY_FOLDER}/",
        }
        text = verilog(work, table=(HDL / _TABLE_VERILOG).read_text(), generics=generics)
        # GHDL writes long constants as strings, of which each digit would count as a character
        text = _QUOTED_BITS.sub(lambda match: f"= {len(match[1])}'b{match[1]};", text)
        (work / "bm1.v").write_text(text, "ascii")
        options = ["-O3", "--x-assign", "fast", "--x-initial", "fast", "-Wno-fatal", "-Wno-lint"]
        files = ["--Mdir", "objects", "bm1.v", str(HDL / _BENCH_CPP)]
        run_tool(["verilator", "--cc", "--exe", "--top-module", "bm1", *options, *files], work)
        # more optimisation takes minutes
        run_tool(["make", "-C", "objects", "-f", f"{_EXECUTABLE}.mk", "OPT_FAST=-O1"], work)
        (work / "objects" / _EXECUTABLE).rename(folder / _EXECUTABLE)
    (folder / MEMORY_FOLDER).mkdir()
    for memory in board_memories(image):
        lines = "".join(f"{word:x}\n" for word in memory.words())
        (folder / MEMORY_FOLDER / f"{memory.name}.hex").write_text(lines, "ascii")


def _key(image: Image, simulator: Simulator) -> str:
    """Return a folder name that differs if image, sources or tools differ."""
    parts = [f"{simulator} {image.image_hash} {image.partition}"]
    parts += [run_tool([tool, "--version"], Path("/")) for tool in simulator.tools]
    names = [*SOURCES, _TABLE_VHDL, _BENCH_VHDL, _TABLE_VERILOG, _BENCH_CPP]
    # the code that writes the generated files and calls the tools
    own = [Path(__file__), *sorted((Path(__file__).parents[1] / "outputs").glob("*.py"))]
    parts += [path.read_text("utf-8") for path in [*(HDL / name for name in names), *own]]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
