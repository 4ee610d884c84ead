"""How an emulated board misbehaves on request, so that the host's answer to each can be tested."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

from pcie_shim.errors import PcieShimError


class UnknownMisbehaviourError(PcieShimError):
    """The text asks for a misbehaviour that there is not."""

    exit_code = 2


class MisbehaviourKind(StrEnum):
    """What the board does wrong."""

    DROP = "drop"
    """An answer or interrupt is not sent."""
    STALL = "stall"
    """The board stops serving its host, but keeps the link open."""
    SHORT_READ = "short-read"
    """An answer to a read, or an interrupt, has one word less."""
    ENDLESS = "endless"
    """A frame begins and does not end."""
    WRONG_SEQUENCE = "wrong-sequence"
    """An answer or interrupt has another sequence number."""
    WRONG_CRC = "wrong-crc"
    """An answer or interrupt has a wrong CRC."""
    ALL_ONES = "all-ones"
    """Every register reads all ones, as if the device were gone."""
    WRONG_MAP = "wrong-map"
    """The board says that it has another register map."""
    NEVER_DONE = "never-done"
    """The machine starts and never stops."""


@dataclass(frozen=True, slots=True)
class Misbehaviour:
    """What goes wrong, from when on, and how often.

    Attributes:
        kind: What goes wrong.
        after: Starts and resumes that go well first; 0: wrong from the opening of the link on.
        times: Answers that go wrong, then all is well; 0: for ever.
    """

    kind: MisbehaviourKind
    after: int = 0
    times: int = 0

    @classmethod
    def parse(cls, text: str) -> Self:
        """The misbehaviour that ``KIND[:AFTER[:TIMES]]`` asks for.

        Raises:
            UnknownMisbehaviourError: There is no such kind, or the numbers are none.
        """
        match = re.fullmatch(r"([a-z-]+)(?::(\d+))?(?::(\d+))?", text)
        if match is None or match[1] not in list(MisbehaviourKind):
            raise UnknownMisbehaviourError(
                f"'{text}' is no misbehaviour: use KIND[:AFTER[:TIMES]] with one of "
                f"{', '.join(MisbehaviourKind)}"
            )
        return cls(MisbehaviourKind(match[1]), int(match[2] or 0), int(match[3] or 0))
