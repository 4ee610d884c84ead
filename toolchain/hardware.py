"""The VHDL of a board: the tools that read it, its generated files for one image, and its compiled simulations."""

import hashlib
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from machines.parameters import RngKind
from pcie_shim.programming_file import Image
from toolchain.building.machine import MACHINE_KEYS
from toolchain.deployment import BM1Section, BoardSection, Deployment, Dimension, Source, Variable
from toolchain.errors import ToolchainError
from toolchain.outputs.memories import Memory, memories
from toolchain.outputs.vhdl_parameters import parameters_vhd

_LIMIT_S: Final = 1200.0
_LAST_OUTPUT: Final = 1500  # characters


class HardwareToolError(ToolchainError):
    """Raised when a tool is missing or fails. The sentence names the tool and ends with the tool's last output."""


def missing(tools: Iterable[str]) -> list[str]:
    """Return the tools that are not installed."""
    return [tool for tool in tools if shutil.which(tool) is None]


def run_tool(
    command: Sequence[str],
    folder: Path,
    environment: Mapping[str, str] | None = None,
    *,
    separate: bool = False,
) -> str:
    """Run a tool in a folder, or raise a HardwareToolError. Return its output; with `separate`, omit standard error."""
    if missing(command[:1]):
        raise HardwareToolError(f"{command[0]} is not installed (Debian: apt-get install {command[0]})")
    try:
        done = subprocess.run(
            command, check=True, cwd=folder, env=environment, capture_output=True, text=True, timeout=_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        raise HardwareToolError(f"{command[0]} did not end within {_LIMIT_S:.0f} s") from None
    except subprocess.CalledProcessError as error:
        output = (error.stdout + error.stderr).strip()[-_LAST_OUTPUT:]
        raise HardwareToolError(f"{command[0]} failed: {output}") from None
    return done.stdout if separate else done.stdout + done.stderr


HDL: Final = Path(__file__).resolve().parents[1] / "hdl"

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
"""The VHDL files in the order of analysis. The generated package of parameters is analysed after the first file."""

PARAMETERS: Final = "bm1_parameters.vhd"


def in_order(sources: Sequence[Path | str], parameters: Path | str = PARAMETERS) -> list[str]:
    """Return VHDL files in the order of analysis: the first source, the package of parameters, the other sources."""
    return [str(sources[0]), str(parameters), *map(str, sources[1:])]


def verilog(
    folder: Path,
    top: str = "bm1",
    *,
    table: str,
    hdl: Path = HDL,
    more_sources: Sequence[str] = (),
    generics: Mapping[str, int | str] | None = None,
) -> str:
    """Return a board's hardware as Verilog, or raise a HardwareToolError.

    `folder` contains the package of parameters. `table` is Verilog text with the module `bm1_table`, the only module
    that GHDL does not translate. `hdl` is the folder of the VHDL, and `more_sources` are further VHDL files, relative
    to `hdl`.
    """
    # without its entity, the table's component remains unbound: a black box
    names = [name for name in SOURCES if name != "bm1_table.vhd"]
    sources = in_order([hdl / name for name in [*names, *more_sources]], folder / PARAMETERS)
    run_tool(["ghdl", "-a", "--std=08", "-Wno-binding", *sources], folder)
    options = [f"-g{name}={value}" for name, value in (generics or {}).items()]
    text = run_tool(["ghdl", "--synth", "--std=08", "--out=verilog", *options, top], folder, separate=True)
    return re.sub(r"^module bm1_table\n.*?^endmodule\n", "", text, flags=re.DOTALL | re.MULTILINE) + table


MEMORY_FOLDER: Final = "Memory_MIFs"


def write_board_files(image: Image, folder: Path) -> None:
    """Write an image's VHDL parameters and memory files. The VHDL generic BOARD must be the image's partition index."""
    images = [image] * image.partition.count  # a board uses its own entry only
    (folder / PARAMETERS).write_text(parameters_vhd(_deployment(image), images), "ascii")
    (folder / MEMORY_FOLDER).mkdir(exist_ok=True)
    for memory in board_memories(image):
        (folder / MEMORY_FOLDER / memory.name).write_text("".join(memory.lines()), "ascii")


def board_memories(image: Image) -> list[Memory]:
    """Return the memories of one board."""
    part = image.partition
    return [
        memory
        for memory in memories(_deployment(image), [image] * part.count)
        if not memory.name.startswith("board") or memory.name.startswith(f"board{part.index}_")
    ]


def _deployment(image: Image) -> Deployment:
    """Return a deployment for an image. An image has no names, so the names of the variables are numbers."""
    parameters = image.machine.parameters
    widths = [*parameters.sensor_bits, *([parameters.prior_bits] if parameters.prior_bits else [])]
    total = image.partition.total_lines
    return Deployment(
        name=f"of image {image.image_hash[:12]}",
        sources=(Source(uri="ws://localhost:9090", topic="/readings", type="std_msgs/Float64MultiArray"),),
        variables=tuple(
            Variable(
                name=f"variable {at}",
                path=f"data[{at}]",
                kind="sensor" if at < parameters.sensors else "prior_select",
                bits=bits,
                values=2**bits - 1,
            )
            for at, bits in enumerate(widths)
        ),
        searched=(Dimension(label="line", size=total),),
        machine=BM1Section(
            lines=total,
            interface=f"{image.interface_sensors}x{image.interface_results}",
            target_count=min(255, parameters.target_count_max),
            **{key: getattr(parameters, key) for key in MACHINE_KEYS},
        ),
        boards=(
            BoardSection(image="boards/board0.bm", image_hash=image.image_hash, line_offset=0, lines=total),
        ),
    )


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
    """GHDL interprets the VHDL. It compiles a simulation within seconds."""
    VERILATOR = "verilator"
    """Verilator compiles a Verilog translation within minutes. Its simulation is a hundred times as fast as GHDL's."""

    @property
    def tools(self) -> tuple[str, ...]:
        """The programs that the simulator needs. Each program has the name of its Debian package."""
        return ("ghdl",) if self is Simulator.GHDL else ("ghdl", "verilator", "make", "g++")


@dataclass(frozen=True, slots=True)
class Compiled:
    """A compiled simulation, which executes requests from its standard input (docs/hardware/simulation.md)."""

    command: tuple[str, ...]
    """The command that runs the simulation."""
    folder: Path
    """The folder in which to run the command."""


def check_tools(simulator: Simulator) -> None:
    """Raise a HardwareToolError if the VHDL or a program of the simulator is not installed."""
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
    """Return the simulation of an image's hardware. If the folder does not contain the simulation, compile it first.

    The function creates the folder if necessary. Other users must not be able to change the folder. Before a
    compilation, `on_compile` is called with a sentence for the user.

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
    """Compile an image's hardware to an executable, and write the files of its memories."""
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
    """Return the name of a simulation's folder: a hash that changes with the image, the sources and the tools."""
    parts = [f"{simulator} {image.image_hash} {image.partition}"]
    parts += [run_tool([tool, "--version"], Path("/")) for tool in simulator.tools]
    names = [*SOURCES, _TABLE_VHDL, _BENCH_VHDL, _TABLE_VERILOG, _BENCH_CPP]
    # the code that writes the generated files and calls the tools
    own = [Path(__file__), *sorted((Path(__file__).parent / "outputs").glob("*.py"))]
    parts += [path.read_text("utf-8") for path in [*(HDL / name for name in names), *own]]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
