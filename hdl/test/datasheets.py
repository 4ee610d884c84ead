"""Datasheets of the hardware's units: purpose, generics and ports are generated, the theory is written by hand.

`scripts/datasheets` writes the pages in docs/hardware and keeps their "Theory of operation".
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from hdl.test.project import HDL, SOURCES
from hdl.test.simulation import ROOT

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

PAGES: Final = ROOT / "docs" / "hardware"
THEORY: Final = "## Theory of operation"

_HEADER = re.compile(r"-- =+\n-- rosbayes: (\w+)\n-- (.+)\n(?:-- .+\n)*-- =+\n")
_ENTITY = re.compile(r"^entity (\w+) is\n(.*?)^end entity", re.DOTALL | re.MULTILINE)
_GENERICS = re.compile(r"^  generic \(\n(.*?)^  \);", re.DOTALL | re.MULTILINE)
_PORTS = re.compile(r"^  port \(\n(.*?)^  \);", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Unit:
    """The contents of a VHDL file's header and entity declaration.

    Attributes:
        name: Name of the entity.
        purpose: Sentence of the header that states the purpose of the unit.
        generics: Name, type, default and comment of each generic.
        ports: Name, direction, type and comment of each port.
    """

    name: str
    purpose: str
    generics: tuple[tuple[str, str, str, str], ...]
    ports: tuple[tuple[str, str, str, str], ...]


def units() -> tuple[Unit, ...]:
    """Return every entity of the hardware, in the order of analysis.

    Raises:
        ValueError: A file does not begin with the header of a unit.
    """
    found = (_unit(HDL / name) for name in SOURCES)
    return tuple(unit for unit in found if unit is not None)


def _unit(path: Path) -> Unit | None:
    text = path.read_text()
    header = _HEADER.match(text)
    if header is None or header[1] != path.stem:
        message = f"{path.name} does not begin with the header that every unit has"
        raise ValueError(message)
    entity = _ENTITY.search(text)
    if entity is None:
        return None
    generics, ports = _GENERICS.search(entity[2]), _PORTS.search(entity[2])
    return Unit(
        entity[1],
        header[2],
        tuple(_generics(generics[1] if generics else "")),
        tuple(_ports(ports[1] if ports else "")),
    )


def _declarations(text: str) -> list[tuple[str, str]]:
    """Return pairs of a declaration, on one line, and its comment."""
    found: list[tuple[str, str]] = []
    pending = ""
    for line in text.splitlines():
        code, _, comment = line.partition("--")
        pending = f"{pending} {code.strip()}".strip()
        # a declaration ends with a semicolon, except the last one
        if pending.endswith(";") or (pending and comment):
            found.append((pending.rstrip("; "), comment.strip()))
            pending = ""
    if pending:
        found.append((pending, ""))
    return found


def _generics(text: str) -> list[tuple[str, str, str, str]]:
    rows = []
    for declaration, comment in _declarations(text):
        name, _, rest = declaration.partition(":")
        kind, _, default = rest.partition(":=")
        rows.append((name.strip(), kind.strip(), default.strip(), comment))
    return rows


def _ports(text: str) -> list[tuple[str, str, str, str]]:
    rows = []
    for declaration, comment in _declarations(text):
        name, _, rest = declaration.partition(":")
        direction, _, kind = rest.strip().partition(" ")
        rows.append((name.strip(), direction, re.sub(r"\( ", "(", " ".join(kind.split())), comment))
    return rows


def generated_part(unit: Unit) -> str:
    """Return the part of a page before the theory of operation."""
    lines = [
        f"<!-- Generated from hdl/{unit.name}.vhd by scripts/datasheets, except the theory. -->",
        f"# {unit.name}",
        "",
        unit.purpose,
        "",
    ]
    if unit.generics:
        default = any(generic[2] for generic in unit.generics)
        lines += ["## Generics", ""]
        lines += (
            ["| generic | type | default | |", "|---|---|---|---|"]
            if default
            else ["| generic | type | |", "|---|---|---|"]
        )
        for name, kind, value, comment in unit.generics:
            shown = f" `{value}` |" if value else " |"
            lines.append(f"| `{name}` | `{kind}` |{shown if default else ''} {comment} |")
        lines.append("")
    lines += ["## Ports", "", "| port | | type | |", "|---|---|---|---|"]
    lines += [
        f"| `{name}` | {direction} | `{kind}` | {comment} |" for name, direction, kind, comment in unit.ports
    ]
    return "\n".join([*lines, "", ""])


def page(unit: Unit) -> str:
    """Return a unit's page: the generated part, then the theory of operation from the page's file.

    Raises:
        ValueError: The file has no theory of operation.
    """
    path = PAGES / f"{unit.name}.md"
    _, heading, theory = (path.read_text() if path.is_file() else "").partition(THEORY)
    if not theory.strip():
        message = f"{path.relative_to(ROOT)} has no text under '{THEORY}': write it"
        raise ValueError(message)
    return generated_part(unit) + heading + theory


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pages, or with `--check` report outdated ones."""
    parser = argparse.ArgumentParser(
        prog="scripts/datasheets",
        description="Write purpose, generics and ports of each unit into its datasheet.",
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a page is out of date")
    check = parser.parse_args(arguments).check
    stale = False
    for unit in units():
        path = PAGES / f"{unit.name}.md"
        try:
            text = page(unit)
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            stale = True
            continue
        if path.read_text() == text:
            continue
        if check:
            print(f"error: {path.relative_to(ROOT)} is out of date: run scripts/datasheets", file=sys.stderr)
            stale = True
        else:
            path.write_text(text)
            print(f"wrote {path.relative_to(ROOT)}")
    return int(stale)


if __name__ == "__main__":
    sys.exit(main())
