"""Generator of the register map for hardware and C: a VHDL package, the VHDL register block, and a C header.

`scripts/registers` writes all three from the SystemRDL file, as well as the constants module (`generator`).

The register block is generated here and not by peakrdl-regblock-vhdl, which was tried, because:

- A board accepts single words, like the emulated board. The exporter requires write buffers for 64-bit registers, in
  which the low word has no effect until the high one is written.
- A board refuses accesses depending on their address, its state and the value written. This would need a separate
  decoder in front of the exporter's block.
- The exported text needs a VHDL package from the exporter's wheel, which everyone who builds the hardware would also
  need.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from scripts.register_maps.generator import Encoding, RegisterMap

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


@dataclass(frozen=True)
class Register:
    """A register of the block, from the hardware's point of view.

    Attributes:
        name: Name in lower case.
        address: Address of the first word, in bytes.
        words: Number of 32-bit words.
        title: Description.
        stored: Mask of the bits that the block stores, within one word; 0 if the hardware drives all bits.
        pulsed: Mask of the bits that are output for one clock and read as 0.
        driven: Whether the hardware provides the value that is read.
        constant: Value that is read if it is neither driven nor stored.
        reset: Reset value of the stored bits.
        latched: Whether reading the low word holds the high word for the next read.
    """

    name: str
    address: int
    words: int
    title: str
    stored: int
    pulsed: int
    driven: bool
    constant: int
    reset: int
    latched: bool

    def choice(self, word: int) -> str:
        """Return the number in the map by which one of the words is selected."""
        more = f" + {word}" if word else ""
        return f"{self.name.upper()}_ADDRESS / 4{more}"

    @property
    def bits(self) -> int:
        """The number of bits of all words."""
        return 32 * self.words

    @property
    def written(self) -> bool:
        """True if software writes the field."""
        return bool(self.stored | self.pulsed)


def read_registers(source: Path) -> tuple[Register, ...]:
    """Return the registers of a SystemRDL file, without memories, in the order of their addresses."""
    from systemrdl.compiler import RDLCompiler
    from systemrdl.node import RegNode

    compiler = RDLCompiler()
    compiler.compile_file(str(source))
    top = compiler.elaborate().top
    return tuple(_register(node) for node in top.children(unroll=False) if isinstance(node, RegNode))


def _register(node: Any) -> Register:
    stored = pulsed = constant = reset = 0
    driven = False
    for field in node.fields():
        # a field of 64 bits is stored word by word
        mask = ((1 << (field.high + 1)) - (1 << field.low)) & 0xFFFFFFFF
        value = (field.get_property("reset") or 0) << field.low
        if field.get_property("singlepulse"):
            pulsed |= mask
        elif field.is_sw_writable:
            stored |= mask
            reset |= value
        else:
            constant |= value
        driven |= field.is_hw_writable
    words = node.total_size // 4
    return Register(
        name=node.inst_name.lower(),
        address=node.raw_address_offset,
        words=words,
        title=node.get_property("name"),
        stored=stored,
        pulsed=pulsed,
        driven=driven,
        constant=constant,
        reset=reset,
        latched=driven and not stored and node.get_property("regwidth") == 64,
    )


def package_text(register_map: RegisterMap) -> str:
    """Return the VHDL package `bm_register_map`: addresses, sizes, fields and encodings."""
    lines = [_HEAD.format(name="bm_register_map", title="The boards' register map as constants.")]
    digest = register_map.hash.upper()
    lines += ["package bm_register_map is", ""]
    lines += _constants([("BAR_ADDRESS_BITS", "positive", str((register_map.bar_size - 1).bit_length()))])
    lines += ["", "  -- SHA-256 of the map's definition, first byte in the highest bits"]
    lines += _constants([("MAP_SHA256", "std_logic_vector(255 downto 0)", f'x"{digest}"')])
    lines += [
        "",
        "  -- registers and memories: address in bytes, number of 32-bit words, what software may do",
    ]
    rows = []
    for block in register_map.blocks:
        rows += [
            (f"{block.name}_ADDRESS", "natural", f"16#{block.address:05X}#"),
            (f"{block.name}_WORDS", "positive", str(block.words)),
            (f"{block.name}_WRITABLE", "boolean", str("w" in block.access).lower()),
        ]
    lines += _constants(rows)
    lines += [
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
        f"  constant BLOCKS : blocks_t(0 to {len(register_map.blocks) - 1}) := (",
    ]
    for at, block in enumerate(register_map.blocks):
        comma = "," if at < len(register_map.blocks) - 1 else ""
        memory = str(not block.fields).lower()
        lines.append(
            f"    {at} => ({block.name}_ADDRESS, {block.name}_WORDS, {block.name}_WRITABLE, {memory}){comma}"
        )
    lines += ["  );", "", "  -- fields of registers that have several: lowest and highest bit"]
    rows = []
    for block in register_map.blocks:
        if len(block.fields) > 1:
            for field in block.fields:
                rows += [
                    (f"{block.name}_{field.name}_LOW", "natural", str(field.low)),
                    (f"{block.name}_{field.name}_HIGH", "natural", str(field.high)),
                ]
    lines += _constants(rows)
    for encoding in register_map.encodings:
        lines += ["", f"  -- {_title(encoding)}"]
        prefix = encoding.name.upper()
        lines += _constants(
            [(f"{prefix}_{member.name}", "natural", str(member.value)) for member in encoding.members]
        )
    lines += ["", "end package bm_register_map;", ""]
    return "\n".join(lines)


def _constants(rows: list[tuple[str, str, str]]) -> list[str]:
    """Return the declarations of constants, aligned: name, type and value."""
    names, types = max(len(row[0]) for row in rows), max(len(row[1]) for row in rows)
    return [f"  constant {name:{names}} : {kind:{types}} := {value};" for name, kind, value in rows]


def _title(encoding: Encoding) -> str:
    return encoding.name.replace("_", " ")


def block_text(registers: tuple[Register, ...]) -> str:
    """Return the VHDL entity `bm_register_block`, which stores written words and selects those that are read."""
    word = "std_logic_vector(31 downto 0)"
    ports = [
        ("clk_i", "in ", "std_logic", "clock"),
        ("rst_i", "in ", "std_logic", "reset of the board"),
        ("write_i", "in ", "std_logic", "write the word; it must be allowed"),
        ("read_i", "in ", "std_logic", "read the word"),
        ("word_i", "in ", "std_logic_vector(7 downto 0)", "number of the word: address / 4"),
        ("data_i", "in ", word, "data to write"),
        ("data_o", "out", word, "data read, a clock after read_i"),
    ]
    for register in registers:
        size = f"std_logic_vector({register.bits - 1} downto 0)"
        if register.driven:
            ports.append((f"{register.name}_i", "in ", size, f"{register.title}, as read"))
        if register.written:
            ports.append((f"{register.name}_o", "out", size, f"{register.title}, as written"))
    return "\n".join(
        [
            _HEAD.format(
                name="bm_register_block",
                title="Registers of a board: stores written values and selects read data.",
            ).rstrip(),
            "  use ieee.numeric_std.all;",
            "",
            "library work;",
            "  use work.bm_register_map.all;",
            "",
            "entity bm_register_block is",
            "  port (",
            *_aligned_ports(ports),
            "  );",
            "end entity bm_register_block;",
            "",
            "architecture rtl of bm_register_block is",
            "",
            *_signals(registers),
            "",
            "begin",
            "",
            *_writes(registers),
            *_reads(registers),
            "end architecture rtl;",
            "",
        ]
    )


def _literal(value: int) -> str:
    return f'x"{value:08X}"'


def _aligned_ports(ports: list[tuple[str, str, str, str]]) -> list[str]:
    """Return the lines of a list of ports: name, direction, type and comment."""
    names, types = max(len(port[0]) for port in ports), max(len(port[2]) for port in ports)
    return [
        f"    {name:{names}} : {direction}   {kind}{' ' if at == len(ports) - 1 else ';'}{'':{types - len(kind)}} -- {comment}"
        for at, (name, direction, kind, comment) in enumerate(ports)
    ]


def _signals(registers: tuple[Register, ...]) -> list[str]:
    signals = []
    for register in registers:
        if register.written:
            size = f"std_logic_vector({register.bits - 1} downto 0)"
            signals.append((register.name, size, _reset(register)))
        if register.latched:
            signals.append((f"{register.name}_high", "std_logic_vector(31 downto 0)", "(others => '0')"))
            signals.append((f"{register.name}_held", "std_logic", "'0'"))
    names, types = max(len(each[0]) for each in signals), max(len(each[1]) for each in signals)
    return [f"  signal {name:{names}} : {kind:{types}} := {value};" for name, kind, value in signals]


def _reset(register: Register) -> str:
    if not register.reset:
        return "(others => '0')"
    return " & ".join([_literal(register.reset)] * register.words)


def _writes(registers: tuple[Register, ...]) -> list[str]:
    """Return the process that stores written values.

    Every word has its own condition, because GHDL 2.0 translates a case to Verilog without the default
    values, which infers latches.
    """
    written = [register for register in registers if register.written]
    width = max(len(register.name) for register in written)
    lines = ["  store : process (clk_i) is", "  begin", "", "    if rising_edge(clk_i) then"]
    for register in written:
        lines += [f"      {register.name}({bit}) <= '0';" for bit in _bits(register.pulsed)]
        for word in range(register.words):
            lines.append(f"      if (write_i = '1' and unsigned(word_i) = {register.choice(word)}) then")
            mask = register.stored | register.pulsed
            lines += [
                f"        {register.name}({32 * word + high} downto {32 * word + low}) <= data_i({high} downto {low});"
                for low, high in _runs(mask)
            ]
            lines.append("      end if;")
    lines += ["      if (rst_i = '1') then"]
    lines += [f"        {register.name:{width}} <= {_reset(register)};" for register in written]
    lines += ["      end if;", "    end if;", "", "  end process store;", ""]
    lines += [f"  {f'{register.name}_o':{width + 2}} <= {register.name};" for register in written]
    return [*lines, ""]


def _reads(registers: tuple[Register, ...]) -> list[str]:
    """Return the processes that hold high words and select what software reads."""
    latched = [register for register in registers if register.latched]
    lines = [
        "  -- Reading a low word holds the high one until that is read, so that the pair is never torn.",
        "  hold_high_words : process (clk_i) is",
        "  begin",
        "",
        "    if rising_edge(clk_i) then",
    ]
    for register in latched:
        lines += [
            f"      if (read_i = '1' and unsigned(word_i) = {register.choice(0)}) then",
            f"        {register.name}_high <= {register.name}_i(63 downto 32);",
            f"        {register.name}_held <= '1';",
            "      end if;",
            f"      if (rst_i = '1' or (read_i = '1' and unsigned(word_i) = {register.choice(1)})) then",
            f"        {register.name}_held <= '0';",
            "      end if;",
        ]
    lines += ["    end if;", "", "  end process hold_high_words;", ""]
    lines += [
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
    for register in registers:
        for word in range(register.words):
            lines.append(f"        if (unsigned(word_i) = {register.choice(word)}) then")
            lines += [f"          {line}" for line in _read(register, word)]
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


def _read(register: Register, word: int) -> list[str]:
    """Return the statements that answer the read of a word."""
    part = f"({32 * word + 31} downto {32 * word})"
    if register.latched and word == 1:
        return [
            f"if ({register.name}_held = '1') then",
            f"  found := found or {register.name}_high;",
            "else",
            f"  found := found or {register.name}_i{part};",
            "end if;",
        ]
    if register.driven:
        return [f"found := found or {register.name}_i{part};"]
    if register.stored:
        mask = "" if register.stored == 0xFFFFFFFF else f" and {_literal(register.stored)}"
        stored = f"{register.name}{part}{mask}"
        return [f"found := found or ({stored});" if mask else f"found := found or {stored};"]
    return [f"found := found or {_literal(register.constant)};"]


def _bits(mask: int) -> list[int]:
    return [bit for bit in range(mask.bit_length()) if mask >> bit & 1]


def _runs(mask: int) -> list[tuple[int, int]]:
    """Return the runs of ones of a mask: lowest and highest bit of each."""
    runs: list[tuple[int, int]] = []
    for bit in _bits(mask):
        if runs and runs[-1][1] == bit - 1:
            runs[-1] = (runs[-1][0], bit)
        else:
            runs.append((bit, bit))
    return runs


def header_text(source: Path) -> str:
    """Return the C header that PeakRDL generates from a SystemRDL file."""
    from peakrdl_cheader.exporter import CHeaderExporter
    from systemrdl.compiler import RDLCompiler

    compiler = RDLCompiler()
    compiler.compile_file(str(source))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bm_registers.h"
        CHeaderExporter().export(compiler.elaborate().top, str(path))
        return path.read_text()
