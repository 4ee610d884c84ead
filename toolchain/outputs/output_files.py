"""The files of a deployment, including the Quartus project: making, comparing and writing them (thesis 3.2)."""

import filecmp
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Final

from machines.parameters import RngKind
from pcie_shim.programming_file import Image, image_bytes
from toolchain.bounded_files import file_errors, whole_file
from toolchain.deployment import Deployment, FilterSection
from toolchain.deployment.filter import Transition
from toolchain.errors import BuildError
from toolchain.outputs.memories import MEMORIES_FOLDER, Memory, memories
from toolchain.outputs.mif import printable
from toolchain.outputs.vhdl_parameters import PARAMETERS_FILE, parameters_vhd

FAMILY: Final = "Stratix V"
DEVICE: Final = "5SGSMD8K2F40C2"
"""A Stratix V GS D8, as on the thesis's Proce V boards. Compare the package and speed grade with your board."""

PROJECT: Final = "bm1"

_UNVERIFIED: Final = """\
# NOT VERIFIED BY QUARTUS: this file was written from Quartus's documentation and has never been opened by it.
# The device is a Stratix V GS D8. Its package and speed grade, the pins and the PCIe controller depend on the board:
# compare them with the board's documentation.
"""


def _settings(deployment: Deployment, board: int, mifs: Sequence[str]) -> str:
    lines = deployment.boards[board]
    assignments = "".join(f'set_global_assignment -name MIF_FILE "{path}"\n' for path in mifs)
    return f"""
# Board {board}: lines {lines.line_offset} to {lines.line_offset + lines.lines - 1}.
set_global_assignment -name FAMILY "{FAMILY}"
set_global_assignment -name DEVICE {DEVICE}
set_global_assignment -name TOP_LEVEL_ENTITY {PROJECT}
set_global_assignment -name PROJECT_OUTPUT_DIRECTORY output_files/board{board}
set_global_assignment -name VHDL_INPUT_VERSION VHDL_2008
set_global_assignment -name NUM_PARALLEL_PROCESSORS ALL

# The index of this board in PARTITIONS of bm1_parameters.vhd.
set_parameter -name BOARD {board}

set_global_assignment -name VHDL_FILE "{PARAMETERS_FILE}"
{assignments}"""


def _script(revisions: Sequence[str]) -> str:
    return f"""#
# Compiles a programming file for every board, in the project's folder:
#     quartus_sh -t {PROJECT}.tcl FOLDER
# FOLDER has the machine's VHDL, as hdl/ of rosbayes: the entity {PROJECT} with the generic BOARD, the entities in it, and,
# in synthesis/, the memories that are filled from the MIFs.

package require ::quartus::project
package require ::quartus::flow

set folder [lindex $quartus(args) 0]
set sources [lsort [glob -nocomplain -directory $folder *.vhd synthesis/*.vhd]]
if {{[llength $sources] == 0}} {{
    puts stderr "error: no .vhd file in '$folder'; name the folder that holds the machine's VHDL"
    exit 2
}}
foreach revision {{{" ".join(revisions)}}} {{
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
    """The effect on a file when `OutputFiles` are written."""

    UNCHANGED = "unchanged"
    CHANGED = "changed"
    NEW = "new"
    REMOVED = "removed"


@dataclass(frozen=True, slots=True)
class OutputFiles:
    """The files of one part of a deployment, such as all MIFs, and a pattern that finds this part's outdated files."""

    contents: dict[str, Iterable[bytes]]
    """The pieces of each file's content, by the file's path in the deployment. Pieces may be iterated only once."""
    own: re.Pattern[str]
    """Pattern of all paths that this part's files can have. Writing removes matching files not in `contents`."""


_MEMORIES: Final = re.compile(
    rf"{re.escape(PARAMETERS_FILE)}|{re.escape(MEMORIES_FOLDER)}/(cde\d+|board\d+_(prior|column\d+|(rng|sequencer)_seeds)|rng_(seeds|table))\.mif"
)
_COMMENT: Final = re.compile(rb"(--|#).*", re.DOTALL)
_LONGEST_LINE: Final = 1 << 20
_IMAGES: Final = re.compile(r"boards/board\d+\.bm")
_PROJECT: Final = re.compile(rf"{PROJECT}\.(qpf|tcl)|{PROJECT}_board\d+\.qsf")


def memory_files(deployment: Deployment, images: Sequence[Image]) -> OutputFiles:
    """Return the memory initialisation files (MIF), and for a BM1 also `bm1_parameters.vhd` (thesis 3.2)."""
    contents: dict[str, Iterable[bytes]] = {}
    if deployment.machine.type == "BM1":
        contents[PARAMETERS_FILE] = [parameters_vhd(deployment, images).encode()]
    for memory in memories(deployment, images):
        contents[f"{MEMORIES_FOLDER}/{memory.name}"] = _encoded(memory)
    return OutputFiles(contents, _MEMORIES)


def _encoded(memory: Memory) -> Iterator[bytes]:
    for line in memory.lines():  # computed when it is written, because all memories together are large
        yield line.encode()


def only_emulated(deployment: Deployment) -> str:
    """Return a clause that says why the machine exists only in emulation.

    If the machine also exists as hardware, the result is an empty string.
    """
    if not deployment.machine.kind.has_hardware:
        return f"the VHDL of a {deployment.machine.type} does not exist yet"
    return "rng = ideal exists only in emulation" if deployment.machine.rng is RngKind.IDEAL else ""


def quartus_files(deployment: Deployment, images: Sequence[Image]) -> OutputFiles:
    """Return the files of the Quartus project: `bm1.qpf`, `bm1.tcl` and a `.qsf` per board.

    A machine that exists only in emulation has no files.
    """
    if only_emulated(deployment):
        return OutputFiles({}, _PROJECT)
    names = [memory.name for memory in memories(deployment, images)]
    revisions = [f"{PROJECT}_board{board}" for board in range(len(deployment.boards))]
    texts = {f"{PROJECT}.qpf": '\nQUARTUS_VERSION = "18.1"\n'}
    for board, revision in enumerate(revisions):
        texts[f"{PROJECT}.qpf"] += f'PROJECT_REVISION = "{revision}"\n'
        own = [
            f"{MEMORIES_FOLDER}/{name}"
            for name in names
            if not name.startswith("board") or name.startswith(f"board{board}_")
        ]
        texts[f"{revision}.qsf"] = _settings(deployment, board, own)
    texts[f"{PROJECT}.tcl"] = _script(revisions)
    head = (
        f"# The Bayesian machine of the model {printable(deployment.name)}, written by 'toolchain build'.\n"
    )
    return OutputFiles(
        {name: [(head + _UNVERIFIED + text).encode()] for name, text in texts.items()}, _PROJECT
    )


def image_files(deployment: Deployment, images: Sequence[Image]) -> OutputFiles:
    """Return the boards' programming files."""
    pairs = zip(deployment.boards, images, strict=True)
    return OutputFiles({board.image: map(image_bytes, [image]) for board, image in pairs}, _IMAGES)


def filter_file(transition: Transition | None) -> OutputFiles:
    """Return the file of a filter's transition, or no file if it is None."""
    name = str(FilterSection.model_fields["file"].default)
    return OutputFiles(
        {} if transition is None else {name: [transition.content()]}, re.compile(re.escape(name))
    )


def text_file(name: str, text: str) -> OutputFiles:
    """Return one text file as a part of a deployment."""
    return OutputFiles({name: [text.encode()]}, re.compile(re.escape(name)))


def write_files(directory: Path, *parts: OutputFiles) -> list[tuple[str, Change]]:
    """Write the parts' files one after the other, each atomically. Return the path and change of each file, sorted."""
    changes: dict[str, Change] = {}
    for part in parts:
        changes |= {name: _write(directory / name, pieces) for name, pieces in part.contents.items()}
        for name in _stale(directory, part):
            with file_errors(directory / name, "written", BuildError):
                (directory / name).unlink()
            changes[name] = Change.REMOVED
    return sorted(changes.items())


def compare_files(directory: Path, files: OutputFiles) -> list[tuple[str, Change]]:
    """Return the changes that `write_files` would make. A file that differs only in comments counts as unchanged."""
    changes = dict.fromkeys(_stale(directory, files), Change.REMOVED)
    for name, pieces in files.contents.items():
        if not (directory / name).is_file():
            changes[name] = Change.NEW
        else:
            same = _has_same_lines(directory / name, pieces)
            changes[name] = Change.UNCHANGED if same else Change.CHANGED
    return sorted(changes.items())


def present(directory: Path, files: OutputFiles) -> list[str]:
    """Return the paths of existing files that match `files.own`. A build would replace or remove the files."""
    folders = ("", "boards", PARAMETERS_FILE.partition("/")[0], MEMORIES_FOLDER)
    paths = [path for folder in folders for path in (directory / folder).glob("*")]
    return [name for path in paths if files.own.fullmatch(name := path.relative_to(directory).as_posix())]


def _stale(directory: Path, files: OutputFiles) -> list[str]:
    """Return the paths of files of this kind that an earlier build wrote, and that `files` no longer contains."""
    return [name for name in present(directory, files) if name not in files.contents]


def _write(path: Path, pieces: Iterable[bytes]) -> Change:
    with whole_file(path, BuildError) as part:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            file.writelines(pieces)
        existed = path.is_file()
        if existed and filecmp.cmp(path, part, shallow=False):
            part.unlink()
            return Change.UNCHANGED
    return Change.CHANGED if existed else Change.NEW


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
