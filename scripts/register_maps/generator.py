"""Generator of the constants module and the register documentation from the SystemRDL file (`scripts/registers`).

It is needed only for development: the constants module is committed, so SystemRDL tools are not needed at run
time. The hash of the map covers the definition (names, addresses, sizes, fields, access, resets, encodings),
but not the explanations.
"""

from __future__ import annotations

import hashlib
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from scripts.register_maps import hardware
from scripts.running.flags import ScriptParser

if TYPE_CHECKING:
    from collections.abc import Sequence

ROOT: Final = Path(__file__).resolve().parents[2]
SOURCE: Final = ROOT / "hdl" / "bm_registers.rdl"
MODULE: Final = ROOT / "pcie_shim" / "register_map.py"
DOCUMENT: Final = ROOT / "docs" / "reference" / "registers.md"
PACKAGE: Final = ROOT / "hdl" / "bm_register_map.vhd"
REGISTER_BLOCK: Final = ROOT / "hdl" / "bm_register_block.vhd"
HEADER: Final = ROOT / "hdl" / "bm_registers.h"


@dataclass(frozen=True)
class Member:
    """One value of an encoding."""

    name: str
    value: int
    text: str


@dataclass(frozen=True)
class Encoding:
    """An enumeration of the map, such as the stop reasons."""

    name: str
    members: tuple[Member, ...]

    @property
    def class_name(self) -> str:
        """The name of the class in the constants module."""
        return "".join(word.capitalize() for word in self.name.split("_"))


@dataclass(frozen=True)
class Field:
    """Bits `low` to `high` of a register."""

    name: str
    low: int
    high: int
    access: str
    reset: int | None
    encoding: Encoding | None
    text: str

    @property
    def mask(self) -> int:
        """The field's bits, in place."""
        return (1 << (self.high + 1)) - (1 << self.low)


@dataclass(frozen=True)
class Block:
    """A register, an array of registers, or a memory: consecutive 32-bit words."""

    name: str
    title: str
    text: str
    address: int
    words: int
    width: int
    access: str
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class RegisterMap:
    """The whole map, in the order of its addresses."""

    text: str
    blocks: tuple[Block, ...]

    @property
    def encodings(self) -> tuple[Encoding, ...]:
        """Every encoding that a field has, once, in the order of first use."""
        found = (field.encoding for block in self.blocks for field in block.fields)
        return tuple(dict.fromkeys(encoding for encoding in found if encoding is not None))

    @property
    def bar_size(self) -> int:
        """The smallest power of two, in bytes, that holds the map, as a BAR requires."""
        return 1 << (max(block.address + 4 * block.words for block in self.blocks) - 1).bit_length()

    @property
    def hash(self) -> str:
        """SHA-256 of the definition, hex."""
        lines: list[str] = []
        for block in self.blocks:
            lines.append(f"block {block.name} {block.address:#x} {block.words} {block.width} {block.access}")
            for field in block.fields:
                lines.append(f"field {field.name} {field.high}:{field.low} {field.access} {field.reset}")
                if field.encoding is not None:
                    lines += [f"value {member.name} {member.value}" for member in field.encoding.members]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def read_map(source: Path = SOURCE) -> RegisterMap:
    """Return the map that a SystemRDL file defines.

    Raises:
        systemrdl.RDLCompileError: The file is not valid SystemRDL; the compiler has printed where.
    """
    from systemrdl.compiler import RDLCompiler
    from systemrdl.node import MemNode, RegNode

    compiler = RDLCompiler()
    compiler.compile_file(str(source))
    top = compiler.elaborate().top
    blocks: list[Block] = []
    for node in top.children(unroll=False):
        text = _one_line(node.get_property("desc"))
        title = node.get_property("name")
        if isinstance(node, MemNode):
            access = node.get_property("sw").name
            entries = node.get_property("mementries")
            width = node.get_property("memwidth")
            blocks.append(
                Block(node.inst_name, title, text, node.raw_address_offset, entries, width, access, ())
            )
        elif isinstance(node, RegNode):
            fields = tuple(_field(field) for field in node.fields())
            access = "rw" if any("w" in field.access for field in fields) else "r"
            width = node.get_property("regwidth")
            words = node.total_size // 4
            blocks.append(
                Block(node.inst_name, title, text, node.raw_address_offset, words, width, access, fields)
            )
        else:
            sys.exit(f"error: {node.get_path()} is neither register nor memory: this map is flat")
    return RegisterMap(text=top.get_property("desc") or "", blocks=tuple(blocks))


def _field(node: object) -> Field:
    from systemrdl.node import FieldNode

    assert isinstance(node, FieldNode)
    encode = node.get_property("encode")
    encoding = None
    if encode is not None:
        members = tuple(
            Member(member.name, int(member.value), _one_line(member.rdl_desc)) for member in encode
        )
        encoding = Encoding(encode.type_name, members)
    reset = node.get_property("reset")
    return Field(
        name=node.inst_name,
        low=node.low,
        high=node.high,
        access=node.get_property("sw").name,
        reset=reset if isinstance(reset, int) else None,
        encoding=encoding,
        text=_one_line(node.get_property("desc")),
    )


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def module_text(register_map: RegisterMap) -> str:
    """Return the constants module."""
    lines = [
        '"""The boards\' register map as constants: offsets in bytes, masks, shifts, encodings.',
        "",
        "Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one. What",
        "each register means is in docs/reference/registers.md.",
        '"""',
        "",
        "from enum import IntEnum",
        "from typing import Final, NamedTuple",
        "",
        f'MAP_SHA256: Final = "{register_map.hash}"',
        f"BAR_SIZE: Final = {register_map.bar_size:#x}",
    ]
    for encoding in register_map.encodings:
        lines += ["", "", f"class {encoding.class_name}(IntEnum):"]
        lines += [f'    """Values of {_first_user(register_map, encoding)}."""', ""]
        lines += [f"    {member.name} = {member.value}  # {member.text}" for member in encoding.members]
    lines += [
        "",
        "",
        "class Block(NamedTuple):",
        '    """A register, an array of registers or a memory: 32-bit words from `address` on."""',
        "",
        "    name: str",
        "    address: int",
        "    words: int",
        "    writable: bool",
        "",
        "",
    ]
    for block in register_map.blocks:
        lines.append(f"{block.name}: Final = {block.address:#06x}")
        if block.words > 1:
            lines.append(f"{block.name}_WORDS: Final = {block.words}")
        default = sum((field.reset or 0) << field.low for field in block.fields)
        if default:
            lines.append(f"{block.name}_VALUE: Final = {default:#x}")
        if len(block.fields) > 1:
            for field in block.fields:
                lines.append(f"{block.name}_{field.name}_SHIFT: Final = {field.low}")
                lines.append(f"{block.name}_{field.name}_MASK: Final = {field.mask:#x}")
    lines += ["", "BLOCKS: Final = ("]
    for block in register_map.blocks:
        writable = "w" in block.access
        lines.append(f'    Block("{block.name}", {block.name}, {block.words}, writable={writable}),')
    lines += [")", ""]
    return "\n".join(lines)


def _first_user(register_map: RegisterMap, encoding: Encoding) -> str:
    users = (
        f"{block.name}.{field.name}"
        for block in register_map.blocks
        for field in block.fields
        if field.encoding == encoding
    )
    return next(users)


def document_text(register_map: RegisterMap) -> str:
    """Return the register documentation in Markdown: an overview, then every register with its fields."""
    lines = [
        "<!-- Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one. -->",
        "# Board registers",
        "",
        "\n\n".join(_wrapped(paragraph) for paragraph in register_map.text.split("\n\n")),
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
        lines += [
            "",
            f"## {block.name}",
            "",
            _wrapped(f"`{block.address:#06x}`, {_size(block)}. {block.title}: {block.text}"),
        ]
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
                    f"| {member.value} | {member.name} | {member.text} |" for member in field.encoding.members
                ]
    lines.append("")
    return "\n".join(lines)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


def _size(block: Block) -> str:
    words = f"{block.words} words" if block.words > 1 else "one word"
    return words if block.width == 32 else f"{words} of one {block.width}-bit value"


def generated_files(register_map: RegisterMap) -> dict[Path, str]:
    """Return the text of every file that is generated from the SystemRDL file."""
    registers = hardware.read_registers(SOURCE)
    return {
        MODULE: module_text(register_map),
        DOCUMENT: document_text(register_map),
        PACKAGE: hardware.package_text(register_map),
        REGISTER_BLOCK: hardware.block_text(registers),
        HEADER: hardware.header_text(SOURCE),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Write all files, or with `--check` compare them with the SystemRDL file's output."""
    parser = ScriptParser(
        prog="scripts/registers",
        description="Makes the constants module, the documentation, the VHDL and the C header from hdl/bm_registers.rdl.",
        epilog="example: scripts/registers --check",
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a file is out of date")
    check = parser.parse_args(arguments).check
    register_map = read_map()
    stale = False
    for path, text in generated_files(register_map).items():
        if path.is_file() and path.read_text() == text:
            continue
        if check:
            print(f"error: {path.relative_to(ROOT)} is out of date: run scripts/registers.", file=sys.stderr)
            stale = True
        else:
            path.write_text(text)
            print(f"wrote {path.relative_to(ROOT)}")
    sys.exit(int(stale))


if __name__ == "__main__":
    main()
