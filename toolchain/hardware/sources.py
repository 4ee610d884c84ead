"""The VHDL of a board, and its translation to Verilog."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from toolchain.hardware.tools import run_tool

HDL: Final = Path(__file__).resolve().parents[2] / "hdl"

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
"""The hardware's files in the order of analysis; the generated package of parameters comes after the first."""

PARAMETERS: Final = "bm1_parameters.vhd"


def in_order(sources: Sequence[Path | str], parameters: Path | str = PARAMETERS) -> list[str]:
    """Return the files in the order of analysis, with the package of parameters in its place."""
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
    """Return a board's hardware as Verilog, from the package of parameters in a folder.

    Args:
        folder: Working folder of GHDL.
        top: Top-level entity.
        table: Verilog of `bm1_table`.
        hdl: Folder of the VHDL.
        more_sources: Further VHDL files, relative to `hdl`.
        generics: Generics of the top-level entity.

    Raises:
        HardwareToolError: GHDL is not installed or failed.
    """
    # without its entity, the table's component remains unbound: a black box
    names = [name for name in SOURCES if name != "bm1_table.vhd"]
    sources = in_order([hdl / name for name in [*names, *more_sources]], folder / PARAMETERS)
    run_tool(["ghdl", "-a", "--std=08", "-Wno-binding", *sources], folder)
    options = [f"-g{name}={value}" for name, value in (generics or {}).items()]
    text = run_tool(["ghdl", "--synth", "--std=08", "--out=verilog", *options, top], folder, separate=True)
    return re.sub(r"^module bm1_table\n.*?^endmodule\n", "", text, flags=re.DOTALL | re.MULTILINE) + table
