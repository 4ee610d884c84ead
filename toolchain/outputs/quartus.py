"""The Quartus project of a deployment: one revision per board, and a script that compiles them (thesis 3.2)."""

from collections.abc import Sequence
from typing import Final

from toolchain.deployment import Deployment
from toolchain.outputs.mif import printable
from toolchain.outputs.vhdl_parameters import FILE as PARAMETERS_FILE

FAMILY: Final = "Stratix V"
DEVICE: Final = "5SGSMD8K2F40C2"
"""A Stratix V GS D8, as on the thesis's Proce V boards; compare package and speed grade with the board."""

PROJECT: Final = "bm1"

_UNVERIFIED: Final = """\
# NOT VERIFIED BY QUARTUS: this file was written from Quartus's documentation and has never been opened by it.
# The device is a Stratix V GS D8; its package and speed grade, the pins and the PCIe controller are the board's:
# compare them with what came with it.
"""


def project_files(deployment: Deployment, mifs: Sequence[str]) -> dict[str, str]:
    """Return the project's files by name: `bm1.qpf`, a `.qsf` per board, `bm1.tcl`; `mifs` are its memories."""
    boards = range(len(deployment.boards))
    head = (
        f"# The Bayesian machine of the model {printable(deployment.name)}, written by 'toolchain build'.\n"
    )
    files = {f"{PROJECT}.qpf": head + _UNVERIFIED + _revisions(boards)}
    for board in boards:
        own = [path for path in mifs if _belongs_to(path, board)]
        files[f"{PROJECT}_board{board}.qsf"] = head + _UNVERIFIED + _settings(deployment, board, own)
    files[f"{PROJECT}.tcl"] = head + _UNVERIFIED + _script(boards)
    return files


def _belongs_to(path: str, board: int) -> bool:
    name = path.rpartition("/")[2]
    return not name.startswith("board") or name.startswith(f"board{board}_")


def _revisions(boards: range) -> str:
    lines = "".join(f'PROJECT_REVISION = "{PROJECT}_board{board}"\n' for board in boards)
    return f'\nQUARTUS_VERSION = "18.1"\n{lines}'


def _settings(deployment: Deployment, board: int, mifs: Sequence[str]) -> str:
    lines = deployment.boards[board]
    memories = "".join(f'set_global_assignment -name MIF_FILE "{path}"\n' for path in mifs)
    return f"""
# Board {board}: lines {lines.line_offset} to {lines.line_offset + lines.lines - 1}.
set_global_assignment -name FAMILY "{FAMILY}"
set_global_assignment -name DEVICE {DEVICE}
set_global_assignment -name TOP_LEVEL_ENTITY {PROJECT}
set_global_assignment -name PROJECT_OUTPUT_DIRECTORY output_files/board{board}
set_global_assignment -name VHDL_INPUT_VERSION VHDL_2008
set_global_assignment -name NUM_PARALLEL_PROCESSORS ALL

# Which of PARTITIONS in bm1_parameters.vhd this revision is.
set_parameter -name BOARD {board}

set_global_assignment -name VHDL_FILE "{PARAMETERS_FILE}"
{memories}"""


def _script(boards: range) -> str:
    names = " ".join(f"{PROJECT}_board{board}" for board in boards)
    return f"""#
# Compiles a programming file for every board, in the project's folder:
#     quartus_sh -t {PROJECT}.tcl FOLDER
# FOLDER holds the machine's VHDL, as the project's hdl/: the entity {PROJECT} with the generic BOARD, what it is made of,
# and in synthesis/ the memories that are filled from the MIFs.

package require ::quartus::project
package require ::quartus::flow

set folder [lindex $quartus(args) 0]
set sources [lsort [glob -nocomplain -directory $folder *.vhd synthesis/*.vhd]]
if {{[llength $sources] == 0}} {{
    puts stderr "error: no .vhd file in '$folder'; name the folder that holds the machine's VHDL"
    exit 2
}}
foreach revision {{{names}}} {{
    project_open {PROJECT} -revision $revision
    foreach source $sources {{
        set_global_assignment -name VHDL_FILE $source
    }}
    export_assignments
    set failed [catch {{execute_flow -compile}} reason]
    project_close
    if {{$failed}} {{
        puts stderr "error: $revision was not compiled: $reason"
        exit 1
    }}
}}
"""
