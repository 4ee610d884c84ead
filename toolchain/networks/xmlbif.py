"""XMLBIF (version 0.3), a network in XML, without external or internal entities."""

from __future__ import annotations

from typing import Final

import numpy as np

from toolchain.networks.builder import MAX_PARENTS, MAX_STATES, NetworkBuilder
from toolchain.networks.xml_file import Line, XmlFile, decimals

_TEXTS: Final = {"NAME", "OUTCOME", "FOR", "GIVEN", "TABLE"}


def read_xmlbif(data: bytes, builder: NetworkBuilder) -> None:
    """Read an XMLBIF file without entities; in a TABLE, the GIVENs are in order and the FOR is fastest."""
    _Reader(builder).read(data)


class _Reader:
    """A reader of elements; definitions are processed after the last variable, which may follow them."""

    def __init__(self, builder: NetworkBuilder) -> None:
        self._builder = builder
        self._file = XmlFile(builder.path, "BIF", started=self._started, ended=self._ended)
        self._fields: dict[str, list[str]] = {}
        self._definitions: list[tuple[dict[str, list[str]], Line]] = []

    def read(self, data: bytes) -> None:
        self._file.parse(data)
        for fields, line in self._definitions:
            self._definition(fields, line)

    def _started(self, name: str, attributes: dict[str, str]) -> None:
        if name in {"VARIABLE", "DEFINITION"}:
            self._fields = {}
            kind = attributes.get("TYPE", "nature")
            if name == "VARIABLE" and kind != "nature":
                raise self._file.here.error(
                    f"a variable of the type {kind[:40]!r}: only 'nature' can be read"
                )

    def _ended(self, name: str, text: str) -> None:
        inside, here = self._file.open, self._file.here
        if name in _TEXTS and inside:
            if inside[-1] in {"VARIABLE", "DEFINITION"}:
                self._fields.setdefault(name, []).append(text)
            elif name == "NAME" and inside[-1] == "NETWORK":
                self._builder.name(text)
        elif name == "VARIABLE":
            (variable,) = self._one("NAME", self._fields, here)
            states = self._fields.get("OUTCOME", [])
            if len(states) > MAX_STATES:
                raise here.error(f"{variable[:40]} has more than {MAX_STATES} states")
            self._builder.variable(variable, states, here)
        elif name == "DEFINITION":
            self._definitions.append((self._fields, here))

    def _one(self, key: str, fields: dict[str, list[str]], line: Line) -> list[str]:
        found = fields.get(key, [])
        if len(found) != 1:
            raise line.error(f"there are {len(found)} elements {key}, expected one")
        return found

    def _definition(self, fields: dict[str, list[str]], line: Line) -> None:
        (child,) = self._one("FOR", fields, line)
        (text,) = self._one("TABLE", fields, line)
        parents = fields.get("GIVEN", [])
        if len(parents) > MAX_PARENTS:
            raise line.error(f"{child[:40]} has more than {MAX_PARENTS} parents")
        shape = self._builder.shape((*parents, child), line)
        entries = int(np.prod(shape))
        words = text.split(maxsplit=entries)
        if len(words) != entries:
            count = f"more than {entries}" if len(words) > entries else str(len(words))
            raise line.error(f"the table of {child} has {count} numbers, expected {entries}")
        values = decimals(words, child, line).reshape(shape)
        self._builder.distribution(child, parents, np.moveaxis(values, -1, 0), line)
