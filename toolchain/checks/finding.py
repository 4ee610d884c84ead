"""What a check has found: how bad it is, about what, what is wrong and what to change."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How bad a finding is."""

    ERROR = "error"
    """It can't be built, or what it computes is wrong."""
    WARNING = "warning"
    """Some readings get no posterior or a wrong one, or nothing is gained by what is spent."""
    NOTE = "note"
    """Good to know; it may be meant so."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that a check has to say.

    Attributes:
        severity: How bad it is.
        check: Which check found it, a word or two with hyphens.
        about: A variable's name, or what else it concerns.
        what: What is wrong, in the model's own names.
        advice: What to change; empty where nothing need be.
    """

    severity: Severity
    check: str
    about: str
    what: str
    advice: str = ""

    @property
    def sentence(self) -> str:
        """The finding as one line for a user."""
        return f"{self.severity}: {self.about}: {self.what}{f'; {self.advice}' if self.advice else ''}"

    def as_dict(self) -> dict[str, str]:
        """The finding as its fields, for JSON."""
        return {key: str(value) for key, value in asdict(self).items()}
