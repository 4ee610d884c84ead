"""Deliberate faults of an emulated board, for tests of hosts."""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

from pcie_shim.errors import PcieShimError


class UnknownMisbehaviourError(PcieShimError):
    """A text that is not a misbehaviour."""

    exit_code = 2


class MisbehaviourKind(StrEnum):
    """The kind of fault."""

    DROP = "drop"
    """The board does not send an answer or interrupt."""
    STALL = "stall"
    """The board stops serving its host, but keeps the link open."""
    SHORT_READ = "short-read"
    """An answer to a read, or an interrupt, lacks one word."""
    ENDLESS = "endless"
    """A frame begins and does not end."""
    WRONG_SEQUENCE = "wrong-sequence"
    """An answer or interrupt has another sequence number."""
    WRONG_CRC = "wrong-crc"
    """An answer or interrupt has a wrong CRC."""
    ALL_ONES = "all-ones"
    """Every register reads all ones, as if the device were gone."""
    WRONG_MAP = "wrong-map"
    """The greeting contains another register map."""
    NEVER_DONE = "never-done"
    """The machine starts and never stops."""
    DONE_TWICE = "done-twice"
    """An interrupt is sent twice, as two interrupts with the same doorbell number."""
    DONE_EARLY = "done-early"
    """An interrupt is sent before the machine has run."""
    STALE_RESULT = "stale-result"
    """An interrupt has the doorbell number and the results of the previous one."""


@dataclass(frozen=True, slots=True)
class Misbehaviour:
    """A kind of fault, the time of its first occurrence, and the number of occurrences.

    Attributes:
        kind: The fault.
        after: Number of starts and resumes before the first fault; 0: from the opening of the link on.
        times: Number of faults; 0: no limit.
    """

    kind: MisbehaviourKind
    after: int = 0
    times: int = 0

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse `KIND[:AFTER[:TIMES]]`, or raise an UnknownMisbehaviourError."""
        match = re.fullmatch(r"([a-z-]+)(?::(\d+))?(?::(\d+))?", text)
        if match is None or match[1] not in list(MisbehaviourKind):
            raise UnknownMisbehaviourError(
                f"'{text}' is not a misbehaviour: use KIND[:AFTER[:TIMES]] with one of {', '.join(MisbehaviourKind)}"
            )
        return cls(MisbehaviourKind(match[1]), int(match[2] or 0), int(match[3] or 0))
