"""Generator of the register map's constants, page, VHDL and C header from the SystemRDL file (`scripts/registers`).

It is needed only for development: its output is committed, so SystemRDL tools are not needed at run time. The hash
of the map covers the definition (names, addresses, sizes, fields, access, resets, encodings), but not the
explanations. PeakRDL writes the C header. The other files are written here, because:

- peakrdl-markdown repeats every element of an array, leaves out the values of encodings, and has no links.
- peakrdl-regblock-vhdl buffers the low word of a 64-bit register until the high one is written, but a board accepts
  single words. It also needs a second decoder for accesses that are refused depending on address, state and value, and
  a VHDL package from its wheel.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from peakrdl_cheader.exporter import CHeaderExporter
from systemrdl.compiler import RDLCompiler
from systemrdl.node import MemNode

from scripts.running.flags import ScriptParser

ROOT: Final = Path(__file__).resolve().parents[1]
SOURCE: Final = ROOT / "hdl" / "bm_registers.rdl"
MODULE: Final = "pcie_shim/register_map.py"
DOCUMENT: Final = "docs/reference/registers.md"
PACKAGE: Final = "hdl/bm_register_map.vhd"
REGISTER_BLOCK: Final = "hdl/bm_register_block.vhd"
HEADER: Final = "hdl/bm_registers.h"
_HEAD: Final = """\
-- ================================================================================================
-- rosbayes: {name}
-- {title}
-- Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one.
-- MIT licence; datasheet: docs/hardware/bm_register_block.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
"""
_WORD: Final = "std_logic_vector(31 downto 0)"
_FULL: Final = 0xFFFFFFFF
_BLOCK_CLASS: Final = '''\
class Block(int):
    """The address of a register, an array of registers or a memory: of 32-bit words from there on."""

    words: int
    writable: bool

    def __new__(cls, address: int, words: int, *, writable: bool) -> "Block":
        block = super().__new__(cls, address)
        block.words, block.writable = words, writable
        return block
'''
_BLOCKS: Final = (
    "BLOCKS: Final = {name: each for name, each in tuple(globals().items()) if isinstance(each, Block)}",
    '"""All of them by name, in the order of their addresses."""',
)
_ENUMERATIONS: Final = {"board_state", "error_code"}
"""Encodings in the constants module; the others belong to machine kinds, and are in `machines`."""


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
        self.text = _one_line(node.get_property("desc"))
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
        self.text = _one_line(node.get_property("desc"))
        self.address: int = node.raw_address_offset
        self.words: int = node.get_property("mementries") if is_memory else node.total_size // 4
        self.width: int = node.get_property("memwidth" if is_memory else "regwidth")
        self.fields = [] if is_memory else [Field(each) for each in node.fields()]
        writable = [each for each in self.fields if "w" in each.access]
        self.access: str = node.get_property("sw").name if is_memory else "rw" if writable else "r"
        self.stored = _word_mask(each for each in writable if not each.pulses)
        """Mask of the bits that the register block stores, within one word; 0 if the hardware drives all."""
        self.pulsed = _word_mask(each for each in writable if each.pulses)
        self.driven = any(field.driven for field in self.fields)
        self.latched = self.driven and not self.stored and self.width == 64
        """True if reading the low word holds the high word for the next read."""

    def value(self, writable: bool | None = None) -> int:
        """Return the reset value of all fields, or only of those that software can (True) or cannot (False) write."""
        chosen = (each for each in self.fields if writable is None or ("w" in each.access) is writable)
        return sum((each.reset or 0) << each.low for each in chosen if not (writable and each.pulses))


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
        """Every encoding of a field in the order of first use, and the name of its first field."""
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
    return sum(each.mask & _FULL for each in fields)  # a field of 64 bits is stored word by word


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


# Constants for Python, and the page


def module_text(register_map: RegisterMap) -> str:
    """Return the constants module."""
    lines = [
        '"""The boards\' register map as constants: addresses in bytes, masks of fields, encodings.',
        "",
        "Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one. What",
        "each register means is in docs/reference/registers.md.",
        '"""',
        "",
        "from enum import IntEnum",
        "from typing import Final",
        "",
        f'MAP_SHA256: Final = "{register_map.hash}"',
        f"BAR_SIZE: Final = {register_map.bar_size:#x}",
    ]
    for encoding, user in register_map.encodings.items():
        if encoding.type_name not in _ENUMERATIONS:
            continue
        name = "".join(word.capitalize() for word in encoding.type_name.split("_"))
        lines += ["", "", f"class {name}(IntEnum):", f'    """Values of {user}."""', ""]
        lines += [f"    {each.name} = {int(each.value)}  # {_one_line(each.rdl_desc)}" for each in encoding]
    lines += ["", "", _BLOCK_CLASS, ""]
    for block in register_map.blocks:
        arguments = f"{block.address:#06x}, {block.words}, writable={'w' in block.access}"
        lines.append(f"{block.name}: Final = Block({arguments})")
        if default := block.value():
            lines.append(f"{block.name}_VALUE: Final = {default:#x}")
        for field in block.fields:
            if field.mask != (1 << block.width) - 1:
                lines.append(f"{block.name}_{field.name}_MASK: Final = {field.mask:#x}")
    return "\n".join([*lines, "", *_BLOCKS, ""])


def document_text(register_map: RegisterMap) -> str:
    """Return the register documentation in Markdown: an overview, then every register with its fields."""
    lines = [
        "<!-- Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one. -->",
        "# Board registers",
        "",
        "\n\n".join(map(_wrapped, register_map.text.split("\n\n"))),
        "",
        f"The map occupies {register_map.bar_size // 1024} KiB (the size of the BAR). Hash of its definition:",
        f"`{register_map.hash}`.",
        "",
        "An access to any other address, or to words that the image does not implement, is refused with an",
        "error: see [Boards](boards.md).",
        "",
        "| offset | register | words | access | name |",
        "|---|---|---|---|---|",
    ]
    for block in register_map.blocks:
        link = f"[{block.name}](#{block.name.lower()})"
        lines.append(f"| `{block.address:#06x}` | {link} | {block.words} | {block.access} | {block.title} |")
    for block in register_map.blocks:
        size = f"{block.words} words" if block.words > 1 else "one word"
        size += "" if block.width == 32 else f" of one {block.width}-bit value"
        summary = _wrapped(f"`{block.address:#06x}`, {size}. {block.title}: {block.text}")
        lines += ["", f"## {block.name}", "", summary]
        if block.fields:
            lines += ["", "| bits | field | access | reset | meaning |", "|---|---|---|---|---|"]
        for field in block.fields:
            bits = f"{field.high}:{field.low}" if field.high > field.low else str(field.low)
            reset = "" if field.reset is None else f"`{field.reset:#x}`"
            lines.append(f"| {bits} | {field.name} | {field.access} | {reset} | {field.text} |")
        for field in block.fields:
            if field.encoding is not None:
                lines += ["", f"{field.name}:", "", "| value | name | meaning |", "|---|---|---|"]
                lines += [
                    f"| {int(each.value)} | {each.name} | {_one_line(each.rdl_desc)} |"
                    for each in field.encoding
                ]
    return "\n".join([*lines, ""])


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


# VHDL


def package_text(register_map: RegisterMap) -> str:
    """Return the VHDL package `bm_register_map`: addresses, sizes, fields and encodings."""
    blocks = register_map.blocks
    sizes, table, bits = [], [], []
    for at, block in enumerate(blocks):
        name, writable = block.name, str("w" in block.access).lower()
        sizes += [
            (f"{name}_ADDRESS", "natural", f"16#{block.address:05X}#"),
            (f"{name}_WORDS", "positive", str(block.words)),
            (f"{name}_WRITABLE", "boolean", writable),
        ]
        comma = "," if at < len(blocks) - 1 else ""
        memory = str(not block.fields).lower()
        table.append(f"    {at} => ({name}_ADDRESS, {name}_WORDS, {name}_WRITABLE, {memory}){comma}")
        for field in block.fields if len(block.fields) > 1 else ():
            bits.append((f"{name}_{field.name}_LOW", "natural", str(field.low)))
            bits.append((f"{name}_{field.name}_HIGH", "natural", str(field.high)))
    lines = [
        _HEAD.format(name="bm_register_map", title="The boards' register map as constants."),
        "package bm_register_map is",
        "",
        *_constants([("BAR_ADDRESS_BITS", "positive", str((register_map.bar_size - 1).bit_length()))]),
        "",
        "  -- SHA-256 of the map's definition, first byte in the highest bits",
        *_constants([("MAP_SHA256", "std_logic_vector(255 downto 0)", f'x"{register_map.hash.upper()}"')]),
        "",
        "  -- registers and memories: address in bytes, number of 32-bit words, what software may do",
        *_constants(sizes),
        "",
        "  -- all of these; a memory's words exist as far as the board implements them",
        "",
        "  type block_t is record",
        "    address  : natural;",
        "    words    : positive;",
        "    writable : boolean;",
        "    memory   : boolean;",
        "  end record block_t;",
        "",
        "  type blocks_t is array (natural range <>) of block_t;",
        "",
        f"  constant BLOCKS : blocks_t(0 to {len(blocks) - 1}) := (",
        *table,
        "  );",
        "",
        "  -- fields of registers that have several: lowest and highest bit",
        *_constants(bits),
    ]
    for encoding in register_map.encodings:
        name = encoding.type_name
        lines += ["", f"  -- {name.replace('_', ' ')}"]
        lines += _constants(
            [(f"{name.upper()}_{each.name}", "natural", str(int(each.value))) for each in encoding]
        )
    return "\n".join([*lines, "", "end package bm_register_map;", ""])


def _constants(rows: list[tuple[str, str, str]], keyword: str = "constant") -> list[str]:
    """Return the declarations of constants or signals, aligned: name, type and value."""
    names, types = max(len(row[0]) for row in rows), max(len(row[1]) for row in rows)
    return [f"  {keyword} {name:{names}} : {kind:{types}} := {value};" for name, kind, value in rows]


def block_text(register_map: RegisterMap) -> str:
    """Return the VHDL entity `bm_register_block`, which stores written words and selects those that are read."""
    ports = [
        ("clk_i", "in ", "std_logic", "clock"),
        ("rst_i", "in ", "std_logic", "reset of the board"),
        ("write_i", "in ", "std_logic", "write the word; it must be allowed"),
        ("read_i", "in ", "std_logic", "read the word"),
        ("word_i", "in ", "std_logic_vector(7 downto 0)", "number of the word: address / 4"),
        ("data_i", "in ", _WORD, "data to write"),
        ("data_o", "out", _WORD, "data read, a clock after read_i"),
    ]
    signals = []
    written = [each for each in register_map.registers if each.stored | each.pulsed]
    for block in register_map.registers:
        name, size = block.name.lower(), f"std_logic_vector({32 * block.words - 1} downto 0)"
        if block.driven:
            ports.append((f"{name}_i", "in ", size, f"{block.title}, as read"))
        if block in written:
            ports.append((f"{name}_o", "out", size, f"{block.title}, as written"))
            signals.append((name, size, _reset(block)))
        if block.latched:
            signals += [(f"{name}_high", _WORD, "(others => '0')"), (f"{name}_held", "std_logic", "'0'")]
    names, types = max(len(port[0]) for port in ports), max(len(port[2]) for port in ports)
    title = "Registers of a board: stores written values and selects read data."
    lines = [
        _HEAD.format(name="bm_register_block", title=title).rstrip(),
        "  use ieee.numeric_std.all;",
        "",
        "library work;",
        "  use work.bm_register_map.all;",
        "",
        "entity bm_register_block is",
        "  port (",
    ]
    for at, (name, direction, kind, comment) in enumerate(ports):
        end = " " if at == len(ports) - 1 else ";"
        lines.append(f"    {name:{names}} : {direction}   {kind}{end}{'':{types - len(kind)}} -- {comment}")
    return "\n".join(
        [
            *lines,
            "  );",
            "end entity bm_register_block;",
            "",
            "architecture rtl of bm_register_block is",
            "",
            *_constants(signals, "signal"),
            "",
            "begin",
            "",
            *_writes(written),
            *_reads(register_map.registers),
            "end architecture rtl;",
            "",
        ]
    )


def _literal(value: int) -> str:
    return f'x"{value:08X}"'


def _reset(block: Block) -> str:
    value = block.value(writable=True)
    return " & ".join([_literal(value)] * block.words) if value else "(others => '0')"


def _is_word(block: Block, word: int) -> str:
    """Return the condition that selects one word of a register."""
    return f"unsigned(word_i) = {block.name}_ADDRESS / 4{f' + {word}' if word else ''}"


def _writes(written: list[Block]) -> list[str]:
    """Return the process that stores written values.

    Every word has its own condition, because GHDL 2.0 translates a case to Verilog without the default
    values, which infers latches.
    """
    width = max(len(block.name) for block in written)
    lines = ["  store : process (clk_i) is", "  begin", "", "    if rising_edge(clk_i) then"]
    for block in written:
        name = block.name.lower()
        lines += [f"      {name}({bit}) <= '0';" for bit in range(32) if block.pulsed >> bit & 1]
        for word in range(block.words):
            lines.append(f"      if (write_i = '1' and {_is_word(block, word)}) then")
            for low, high in _runs(block.stored | block.pulsed):
                target = f"{name}({32 * word + high} downto {32 * word + low})"
                lines.append(f"        {target} <= data_i({high} downto {low});")
            lines.append("      end if;")
    lines += ["      if (rst_i = '1') then"]
    lines += [f"        {block.name.lower():{width}} <= {_reset(block)};" for block in written]
    lines += ["      end if;", "    end if;", "", "  end process store;", ""]
    lines += [f"  {f'{block.name.lower()}_o':{width + 2}} <= {block.name.lower()};" for block in written]
    return [*lines, ""]


def _reads(registers: list[Block]) -> list[str]:
    """Return the processes that hold high words, and select the word that software reads."""
    lines = [
        "  -- Reading a low word holds the high one until that is read, so that the pair is never torn.",
        "  hold_high_words : process (clk_i) is",
        "  begin",
        "",
        "    if rising_edge(clk_i) then",
    ]
    for block in registers:
        if block.latched:
            name = block.name.lower()
            lines += [
                f"      if (read_i = '1' and {_is_word(block, 0)}) then",
                f"        {name}_high <= {name}_i(63 downto 32);",
                f"        {name}_held <= '1';",
                "      end if;",
                f"      if (rst_i = '1' or (read_i = '1' and {_is_word(block, 1)})) then",
                f"        {name}_held <= '0';",
                "      end if;",
            ]
    lines += [
        "    end if;",
        "",
        "  end process hold_high_words;",
        "",
        "  select_word : process (clk_i) is",
        "",
        "    variable found : std_logic_vector(31 downto 0);",
        "",
        "  begin",
        "",
        "    if rising_edge(clk_i) then",
        "      if (read_i = '1') then",
        "        -- one at most is not 0",
        "        found := (others => '0');",
    ]
    for block in registers:
        for word in range(block.words):
            lines.append(f"        if ({_is_word(block, word)}) then")
            lines += [f"          {line}" for line in _read(block, word)]
            lines.append("        end if;")
    return [
        *lines,
        "        data_o <= found;",
        "      end if;",
        "    end if;",
        "",
        "  end process select_word;",
        "",
    ]


def _read(block: Block, word: int) -> list[str]:
    """Return the statements that answer the read of a word."""
    name, part = block.name.lower(), f"({32 * word + 31} downto {32 * word})"
    if block.latched and word == 1:
        held, read = f"found := found or {name}_high;", f"found := found or {name}_i{part};"
        return [f"if ({name}_held = '1') then", f"  {held}", "else", f"  {read}", "end if;"]
    if block.driven:
        return [f"found := found or {name}_i{part};"]
    if block.stored == _FULL:
        return [f"found := found or {name}{part};"]
    if block.stored:
        return [f"found := found or ({name}{part} and {_literal(block.stored)});"]
    return [f"found := found or {_literal(block.value(writable=False))};"]


def _runs(mask: int) -> list[tuple[int, int]]:
    """Return the runs of ones of a mask: lowest and highest bit of each."""
    ones = [bit for bit in range(32) if mask >> bit & 1]
    lows = [bit for bit in ones if bit - 1 not in ones]
    return list(zip(lows, [bit for bit in ones if bit + 1 not in ones], strict=True))


def header_text(register_map: RegisterMap) -> str:
    """Return the C header that PeakRDL generates."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bm_registers.h"
        CHeaderExporter().export(register_map.top, str(path))
        return path.read_text()


FILES: Final = {
    MODULE: module_text,
    DOCUMENT: document_text,
    PACKAGE: package_text,
    REGISTER_BLOCK: block_text,
    HEADER: header_text,
}


def main(arguments: Sequence[str] | None = None, *, root: Path = ROOT) -> int:
    """Write all files, or with `--check` compare the existing ones with what would be written."""
    description = "Makes the constants module, the page, the VHDL and the C header from hdl/bm_registers.rdl."
    parser = ScriptParser(prog="scripts/registers", description=description)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a file is out of date")
    check = parser.parse_args(arguments).check
    register_map = RegisterMap()
    stale = [name for name, text_of in FILES.items() if not _is(root / name, text_of(register_map))]
    for name in stale:
        if check:
            print(f"error: {name} is out of date: run scripts/registers.", file=sys.stderr)
        else:
            (root / name).write_text(FILES[name](register_map))
            print(f"wrote {name}")
    return int(check and bool(stale))


def _is(path: Path, text: str) -> bool:
    return path.is_file() and path.read_text() == text


if __name__ == "__main__":
    sys.exit(main())
