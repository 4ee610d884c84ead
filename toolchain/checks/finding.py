"""Findings of a check: severity, subject, mistake and advice."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from typing import Final


class Severity(StrEnum):
    """The severity of a finding."""

    ERROR = "error"
    """The model cannot be built, or computes wrong results."""
    WARNING = "warning"
    """Some readings get no posterior or a wrong one, or resources are wasted."""
    NOTE = "note"
    """This may be intended."""


class Check(StrEnum):
    """The checks, as `toolchain check --json` names them; docs/reference/toolchain.md describes each."""

    CANNOT_BE_BUILT = "cannot-be-built"
    DEAD_LINES = "dead-lines"
    DEAD_BOARD = "dead-board"
    IMPOSSIBLE_READINGS = "impossible-readings"
    COLUMN_WITHOUT_EFFECT = "column-without-effect"
    SAME_READING = "same-reading"
    ADDRESS_BITS = "address-bits"
    RANGE = "range"
    PAIRING = "pairing"
    STOPPING = "stopping"
    VANISHED_FLOOR = "vanished-floor"
    LOST_MASS = "lost-mass"
    FILES = "files"
    RNG = "rng"
    RNG_BANKS = "rng-banks"
    RNG_STEPS = "rng-steps"
    RNG_PERIOD = "rng-period"
    RNG_RELATION = "rng-relation"
    RNG_TABLE = "rng-table"


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding of a check; `advice` suggests a change, and is empty if none is needed."""

    severity: Severity
    check: Check
    about: str
    what: str
    advice: str = ""

    @property
    def sentence(self) -> str:
        """The finding as one line for a user."""
        return f"{self.severity}: {self.about}: {self.what}{f'; {self.advice}' if self.advice else ''}"

    def as_dict(self) -> dict[str, str]:
        """Return the fields by name, for JSON."""
        return {key: str(value) for key, value in asdict(self).items()}


error: Final = partial(Finding, Severity.ERROR)
warning: Final = partial(Finding, Severity.WARNING)
note: Final = partial(Finding, Severity.NOTE)
