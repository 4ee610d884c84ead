"""Formal proofs of small properties by yosys, for every input, table and seed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from hdl.test.guard_generics import GENERICS
from hdl.test.netlist import run_yosys
from hdl.test.project import HDL, HardwareToolError, verilog, write_hardware_files
from hdl.test.random_machines import random_case

if TYPE_CHECKING:
    from pathlib import Path

_ANY_TABLE: Final = """
module bm1_table #(parameter FILE_NAME = 0, WORD_BITS = 1, DEPTH = 1, ADDRESS_BITS = 1, FIRST_BIT = 0, DATA_BITS = 1)
  (input clk_i, input enable_i, input [ADDRESS_BITS-1:0] address_i, output [DATA_BITS-1:0] data_o);
  (* anyseq *) wire [DATA_BITS-1:0] anything;
  assign data_o = anything;
endmodule
"""
"""Verilog that replaces each table by one whose output may be anything at any time."""

_INDUCTION: Final = (
    "sat -verify -prove-asserts -set-assumes -tempinduct -seq 1 -maxsteps 4 "
    # the machine and the properties keep the same values of a start; without this, induction fails
    "-prove frame_target core.core.control.target -prove frame_max core.core.control.max_cycles"
)
_BOUNDED: Final = (
    "sat -verify -prove-asserts -set-assumes -tempinduct -tempinduct-baseonly -seq 1 -maxsteps 15"
)
_COMBINATIONAL: Final = "sat -verify -prove-asserts"
_FORMAL: Final = "test/formal"


def proofs() -> tuple[str, ...]:
    """Return the names of all proofs."""
    return ("core of one machine", "core of two replicas", "every start ends", "guard")


def failed_proof(name: str, folder: Path, hdl: Path = HDL) -> str | None:
    """Try a proof, and return the reason why the proof fails, or None if it succeeds.

    Args:
        name: Name of the proof, from `proofs`.
        folder: Working folder of the tools.
        hdl: Folder of the VHDL: `HDL`, or a changed copy (a mutant).

    Raises:
        HardwareToolError: GHDL is not installed, or refuses the VHDL.
    """
    write_hardware_files(random_case(0).image, folder)
    if name == "guard":
        top, generics, command, define = "guard_properties", GENERICS, _COMBINATIONAL, ""
        text = verilog(folder, "bm1_guard", table="", hdl=hdl, generics=generics)
    else:
        replicas = 2 if "two" in name else 1
        bounded = name == "every start ends"
        top, generics = "core_properties", {"REPLICAS": replicas}
        command, define = (_BOUNDED, "-DBOUNDED") if bounded else (_INDUCTION, "")
        sources = [f"{_FORMAL}/core_under_proof.vhd"]
        text = verilog(
            folder, "core_under_proof", table=_ANY_TABLE, hdl=hdl, more_sources=sources, generics=generics
        )
    (folder / "design.v").write_text(text)
    properties = (HDL / _FORMAL / f"{top}.sv").read_text()
    (folder / "properties.sv").write_text(properties)
    parameter = f"chparam -set REPLICAS {generics['REPLICAS']} {top}; " if top == "core_properties" else ""
    try:
        run_yosys(
            f"read_verilog -formal design.v; read_verilog -sv -formal {define} properties.sv; {parameter}"
            f"prep -flatten -top {top}; select -assert-none t:$dlatch; async2sync; {command}",
            folder,
        )
    except HardwareToolError as error:
        if "proof did fail" not in str(error):
            raise
        return "a property does not hold"
    return None
