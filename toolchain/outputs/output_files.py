"""The files of a deployment, including the Quartus project: their contents, and how writing changes each (thesis 3.2)."""

import filecmp
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Final, TypeAlias

from machines.parameters import RngKind
from pcie_shim.programming_file import Image, image_bytes
from toolchain.bounded_files import whole_file
from toolchain.deployment import Deployment
from toolchain.errors import BuildError
from toolchain.outputs.memories import FOLDER as MEMORIES_FOLDER
from toolchain.outputs.memories import Memory, memories
from toolchain.outputs.mif import printable
from toolchain.outputs.vhdl_parameters import FILE as PARAMETERS_FILE
from toolchain.outputs.vhdl_parameters import parameters_vhd

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


class Change(StrEnum):
    """How writing changes a file."""

    UNCHANGED = "unchanged"
    CHANGED = "changed"
    NEW = "new"
    REMOVED = "removed"


Pieces: TypeAlias = Callable[[], Iterable[bytes]]


@dataclass(frozen=True, slots=True)
class OutputFiles:
    """A part of a deployment: its files, and a pattern for files of earlier builds."""

    contents: dict[str, Pieces]
    """Functions that return the content in pieces, by the path in the deployment's folder."""
    own: re.Pattern[str]
    """Paths of this part; files that are not in `contents` are removed."""


_MEMORIES: Final = re.compile(
    rf"{re.escape(PARAMETERS_FILE)}|{re.escape(MEMORIES_FOLDER)}/(board\d+_(prior|column\d+|rng_seeds)|rng_(seeds|table))\.mif"
)
_COMMENT: Final = re.compile(rb"(--|#).*", re.DOTALL)
_LONGEST_LINE: Final = 1 << 20
_IMAGES: Final = re.compile(r"boards/board\d+\.bm")
_PROJECT: Final = re.compile(rf"{PROJECT}\.(qpf|tcl)|{PROJECT}_board\d+\.qsf")


def memory_files(deployment: Deployment, images: Sequence[Image]) -> OutputFiles:
    """Return `bm1_parameters.vhd` and the MIFs (thesis 3.2)."""
    contents: dict[str, Pieces] = {PARAMETERS_FILE: lambda: [parameters_vhd(deployment, images).encode()]}
    for memory in memories(deployment, images):
        contents[f"{MEMORIES_FOLDER}/{memory.name}"] = partial(_encoded, memory)
    return OutputFiles(contents, _MEMORIES)


def quartus_files(deployment: Deployment, images: Sequence[Image]) -> OutputFiles:
    """Return the Quartus project; none for generators that exist only in emulation."""
    if deployment.machine.rng is RngKind.IDEAL:
        return OutputFiles({}, _PROJECT)
    mifs = [f"{MEMORIES_FOLDER}/{memory.name}" for memory in memories(deployment, images)]
    texts = project_files(deployment, mifs)
    return OutputFiles({name: partial(iter, [text.encode()]) for name, text in texts.items()}, _PROJECT)


def image_files(deployment: Deployment, images: Sequence[Image]) -> OutputFiles:
    """Return the programming files."""
    pairs = zip(deployment.boards, images, strict=True)
    return OutputFiles({board.image: partial(_image, image) for board, image in pairs}, _IMAGES)


def text_file(name: str, text: str) -> OutputFiles:
    """Return one text file."""
    return OutputFiles({name: partial(iter, [text.encode()])}, re.compile(re.escape(name)))


def write_files(directory: Path, files: OutputFiles) -> list[tuple[str, Change]]:
    """Write the files of a part atomically; return every path, sorted, and its change."""
    return _changes(directory, files, _write, _remove)


def compare_files(directory: Path, files: OutputFiles) -> list[tuple[str, Change]]:
    """Return the changes that `write_files` would make; files that differ only in comments are unchanged."""
    return _changes(directory, files, _compare, lambda _: None)


def _changes(
    directory: Path,
    files: OutputFiles,
    of_file: Callable[[Path, Pieces], Change],
    remove: Callable[[Path], None],
) -> list[tuple[str, Change]]:
    changes = {name: of_file(directory / name, pieces) for name, pieces in files.contents.items()}
    for folder in ("", "boards", PARAMETERS_FILE.partition("/")[0], MEMORIES_FOLDER):
        for path in sorted((directory / folder).glob("*")):
            name = path.relative_to(directory).as_posix()
            if files.own.fullmatch(name) and name not in files.contents:
                remove(path)
                changes[name] = Change.REMOVED
    return sorted(changes.items())


def _compare(path: Path, pieces: Pieces) -> Change:
    if not path.is_file():
        return Change.NEW
    return Change.UNCHANGED if _has_same_lines(path, pieces()) else Change.CHANGED


def _write(path: Path, pieces: Pieces) -> Change:
    with whole_file(path, BuildError) as partial:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            file.writelines(pieces())
        existed = path.is_file()
        if existed and filecmp.cmp(path, partial, shallow=False):
            partial.unlink()
            return Change.UNCHANGED
    return Change.CHANGED if existed else Change.NEW


def _remove(path: Path) -> None:
    try:
        path.unlink()
    except OSError as reason:
        raise BuildError(f"{path} cannot be written: {reason.strerror or reason}") from None


def _has_same_lines(path: Path, pieces: Iterable[bytes]) -> bool:
    """Compare a file with its expected content line by line, ignoring comments and empty lines."""
    expected = (line for piece in pieces for line in piece.splitlines())
    try:
        with path.open("rb") as file:
            # a much too long line is read in parts, which then differ from the expected line
            found = iter(partial(file.readline, _LONGEST_LINE), b"")
            pairs = zip_longest(filter(None, map(_plain, found)), filter(None, map(_plain, expected)))
            return all(one == other for one, other in pairs)
    except OSError:
        return False


def _plain(line: bytes) -> bytes:
    return _COMMENT.sub(b"", line).strip()


def _encoded(memory: Memory) -> Iterator[bytes]:
    return (line.encode() for line in memory.lines())


def _image(image: Image) -> Iterator[bytes]:
    yield image_bytes(image)
