"""Generator of the register map's constants, page, VHDL and C header from the SystemRDL file (`scripts/registers`).

The generator is needed only for development. Its output is committed, so no SystemRDL tool is needed at run time. The
map's hash covers names, addresses, sizes, fields, access, resets and encodings, but not the explanations. PeakRDL
writes the C header. The other files come from templates in register_templates/, for two reasons:

- peakrdl-markdown repeats every element of an array, leaves out the values of encodings, and has no links.
- peakrdl-regblock-vhdl buffers the low word of a 64-bit register until the high word is written. A board, however,
  accepts single words. peakrdl-regblock-vhdl also needs a VHDL package from its wheel. Some accesses are refused
  depending on address, state and value; for these accesses, a second decoder would be necessary.
"""

import hashlib
import os
import re
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from peakrdl_cheader.exporter import CHeaderExporter
from systemrdl.compiler import RDLCompiler
from systemrdl.node import MemNode

from scripts.running.flags import ScriptParser

ROOT: Final = Path(__file__).resolve().parents[1]
SOURCE: Final = ROOT / "hdl" / "bm_registers.rdl"
GENERATED: Final = (
    *("pcie_shim/register_map.py", "docs/reference/registers.md"),
    *("hdl/bm_register_map.vhd", "hdl/bm_register_block.vhd"),
)
"""The files that are generated from templates."""
HEADER: Final = "hdl/bm_registers.h"


# The map, as the compiler of SystemRDL has read it


class Field:
    """Bits `low` to `high` of a register."""

    def __init__(self, node: Any) -> None:
        self.name: str = node.inst_name
        self.low: int = node.low
        self.high: int = node.high
        self.mask = (1 << (node.high + 1)) - (1 << node.low)
        self.access: str = node.get_property("sw").name
        self.reset: int | None = node.get_property("reset")
        self.encoding: Any = node.get_property("encode")
        self.text = one_line(node.get_property("desc"))
        self.pulses: bool = node.get_property("singlepulse")
        """True if a written 1 is output for one clock, and reads as 0."""
        self.driven: bool = node.is_hw_writable
        """True if the hardware provides the value that is read."""


class Block:
    """A register, an array of registers, or a memory without fields: consecutive 32-bit words."""

    def __init__(self, node: Any) -> None:
        is_memory = isinstance(node, MemNode)
        self.name: str = node.inst_name
        self.title: str = node.get_property("name")
        self.text = one_line(node.get_property("desc"))
        self.address: int = node.raw_address_offset
        self.words: int = node.get_property("mementries") if is_memory else node.total_size // 4
        self.width: int = node.get_property("memwidth" if is_memory else "regwidth")
        self.fields = [] if is_memory else [Field(each) for each in node.fields()]
        writable = [each for each in self.fields if "w" in each.access]
        self.access: str = node.get_property("sw").name if is_memory else "rw" if writable else "r"
        self.writable = "w" in self.access
        self.stored = _word_mask(each for each in writable if not each.pulses)
        """Mask of the bits that the register block stores, within one word; 0 if the hardware drives all."""
        self.pulsed = _word_mask(each for each in writable if each.pulses)
        self.stored_or_pulsed = self.stored | self.pulsed
        self.driven = any(field.driven for field in self.fields)
        self.latched = self.driven and not self.stored and self.width == 64
        """True if reading the low word holds the high word for the next read."""

    def value(self, writable: bool | None = None) -> int:
        """Return the reset value of all fields, or only of those that software can (True) or cannot (False) write."""
        chosen = (each for each in self.fields if writable is None or ("w" in each.access) is writable)
        return sum((each.reset or 0) << each.low for each in chosen if not (writable and each.pulses))

    @property
    def reset(self) -> str:
        """The block's value after a reset, as a VHDL expression."""
        value = self.value(writable=True)
        return " & ".join([literal(value)] * self.words) if value else "(others => '0')"


class RegisterMap:
    """The whole map, in the order of its addresses."""

    def __init__(self, source: Path = SOURCE) -> None:
        compiler = RDLCompiler()
        compiler.compile_file(str(source))
        self.top = compiler.elaborate().top
        self.text: str = self.top.get_property("desc") or ""
        self.blocks = [Block(each) for each in self.top.children(unroll=False)]
        self.registers = [each for each in self.blocks if each.fields]
        end = max(block.address + 4 * block.words for block in self.blocks)
        self.bar_size = 1 << (end - 1).bit_length()
        """The smallest power of two, in bytes, that holds the map, as a BAR requires."""

    @cached_property
    def encodings(self) -> dict[Any, str]:
        """Every encoding in the order of first use, and the name of the first field that uses it."""
        found: dict[Any, str] = {}
        for block in self.blocks:
            for field in block.fields:
                if field.encoding is not None:
                    found.setdefault(field.encoding, f"{block.name}.{field.name}")
        return found

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the definition, hex."""
        lines: list[str] = []
        for block in self.blocks:
            lines.append(f"block {block.name} {block.address:#x} {block.words} {block.width} {block.access}")
            for field in block.fields:
                lines.append(f"field {field.name} {field.high}:{field.low} {field.access} {field.reset}")
                lines += [f"value {member.name} {int(member.value)}" for member in field.encoding or ()]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _word_mask(fields: Iterable[Field]) -> int:
    return sum(each.mask & 0xFFFFFFFF for each in fields)  # a field of 64 bits is stored word by word


# The files, from the templates


def one_line(text: str | None) -> str:
    """Return a text without line breaks."""
    return " ".join((text or "").split())


def wrapped(text: str) -> str:
    """Return a paragraph in lines of at most 100 columns."""
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


def aligned(text: str) -> str:
    """Return declarations of VHDL with their types, values and comments aligned in columns."""
    rows = [re.split(r"( := | : | -- )", line) for line in text.strip("\n").split("\n")]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = ([cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows)
    return "".join("".join(row).rstrip() + "\n" for row in cells)


def literal(value: int) -> str:
    """Return a 32-bit word as a literal of VHDL."""
    return f'x"{value:08X}"'


def ones(mask: int) -> list[int]:
    """Return the positions of the bits that are 1."""
    return [bit for bit in range(32) if mask >> bit & 1]


def runs(mask: int) -> list[tuple[int, int]]:
    """Return the runs of ones of a mask: lowest and highest bit of each."""
    bits = ones(mask)
    lows = [bit for bit in bits if bit - 1 not in bits]
    return list(zip(lows, [bit for bit in bits if bit + 1 not in bits], strict=True))


def texts(register_map: RegisterMap) -> dict[str, str]:
    """Return the contents of all files generated from the register map, by path."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("register_templates")),
        undefined=StrictUndefined,
        autoescape=False,  # noqa: S701 - nothing of this is HTML
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {each.__name__: each for each in (one_line, wrapped, aligned, literal, ones, runs)}
    found = {
        f"{folder}/{name}": environment.get_template(f"{name}.j2").render(map=register_map)
        for folder, name in map(os.path.split, GENERATED)
    }
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "bm_registers.h"
        CHeaderExporter().export(register_map.top, str(path))
        return {**found, HEADER: path.read_text()}


def main(arguments: Sequence[str] | None = None, *, root: Path = ROOT) -> int:
    """Write all files, or with `--check` compare the existing ones with what would be written."""
    parser = ScriptParser(
        "scripts/registers",
        "Makes the constants module, the page, the VHDL and the C header from hdl/bm_registers.rdl.",
    )
    parser.switch("--check", "write nothing; exit 1 if a file is out of date")
    check = parser.parse_args(arguments).check
    stale = {name: text for name, text in texts(RegisterMap()).items() if not _is(root / name, text)}
    for name, text in stale.items():
        if check:
            print(f"error: {name} is out of date: run scripts/registers.", file=sys.stderr)
        else:
            (root / name).write_text(text)
            print(f"wrote {name}")
    return int(check and bool(stale))


def _is(path: Path, text: str) -> bool:
    return path.is_file() and path.read_text() == text


if __name__ == "__main__":
    sys.exit(main())
