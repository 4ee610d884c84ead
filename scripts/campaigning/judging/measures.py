"""Measures of a round: findings, recovery times, resources, and the machine's slowness."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass, field

from scripts.campaigning.judging.observer import Finding


@dataclass(slots=True)
class Recovery:
    """Time until results arrived again after a step's end, and the machine's slowness then."""

    step: str
    seconds: float
    slowness: float


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


def slowness() -> float:
    """Return the ratio of a small process's duration to its CPU time, which is 1 on an idle machine."""
    begun = time.monotonic()
    process = subprocess.Popen([sys.executable, "-S", "-c", "pass"])
    _, _, usage = os.wait4(process.pid, 0)
    process.returncode = 0
    return max(1.0, (time.monotonic() - begun) / max(usage.ru_utime + usage.ru_stime, 0.005))
