"""Growth of processes: memory and descriptors by number of frames."""

from __future__ import annotations

import statistics
from collections.abc import Iterable

from scripts.campaigning.judging.measures import RoundResult
from scripts.campaigning.judging.observer import Finding, Flaw

FEWEST = 3
"""Minimum number of samples of a process."""
MOST_DESCRIPTORS = 8
"""Number of descriptors by which a process may grow, at rest."""
MOST_KIB = 32 * 1024
"""KiB by which a process may grow in its second half."""


def growth(results: Iterable[RoundResult]) -> tuple[dict[str, tuple[float, float]], list[Finding]]:
    """Return each role's median slopes per 1000 frames (KiB, descriptors), and processes that grew too much."""
    slopes: dict[str, list[tuple[float, float]]] = {}
    findings = []
    for result in results:
        for (role, pid), samples in result.resources.items():
            steady = samples[len(samples) // 2 :]  # buffers and caches are filled by then
            if len(steady) < FEWEST:
                continue
            frames, memory, descriptors = zip(*steady, strict=True)
            if frames[-1] == frames[0]:
                continue
            lines = [
                statistics.linear_regression(frames, values).slope * 1000 for values in (memory, descriptors)
            ]
            slopes.setdefault(role, []).append((lines[0], lines[1]))
            if descriptors[-1] - min(descriptors) > MOST_DESCRIPTORS or memory[-1] - memory[0] > MOST_KIB:
                sentence = f"{role} ({pid}): KiB {list(memory)}, descriptors {list(descriptors)}"
                findings.append(Finding(Flaw.GROWTH, sentence, 0.0))
    medians = {
        role: (statistics.median(each[0] for each in of_role), statistics.median(each[1] for each in of_role))
        for role, of_role in slopes.items()
    }
    return medians, findings
