"""Measures of a round: findings, recovery times and resources."""

from __future__ import annotations

from dataclasses import dataclass, field

from scripts.campaigning.judging.observer import Finding


@dataclass(slots=True)
class Recovery:
    """Time until results arrived again after a step's end, which is only reported."""

    step: str
    seconds: float


@dataclass(slots=True)
class RoundResult:
    """The findings and measurements of a round."""

    findings: list[Finding] = field(default_factory=list)
    frames: int = 0
    readings: int = 0
    losses: dict[str, int] = field(default_factory=dict)
    recoveries: list[Recovery] = field(default_factory=list)
    transit: tuple[int, int] = (0, 0)
    """Readings and results that were between two processes when they were cut."""
    resources: dict[tuple[str, int], list[tuple[int, int, int]]] = field(default_factory=dict)
    """By role and process: frames so far, resident KiB and descriptors."""
    failed_step: int = -1
    words: str = ""
