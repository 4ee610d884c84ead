"""Accounts of readings: each that reached the stack has a result, or is counted with a reason that a fault explains."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from scripts.campaigning.observer import Finding, Flaw, Reading

PASSED_OVER = "passed over"
"""Reason that needs no fault, but a newer reading that came before the result."""
UNUSABLE = "with an unusable variable"
"""Reason that needs no fault, but a reading with such a variable."""
WITH_PUBLISHER = "lost with the publisher"
"""Reason of results that may have arrived, because the publisher was killed before it confirmed them."""
WITH_APP, FAILED, ROSBRIDGE_AWAY = "lost with pcie-app", "failed on a board", "rosbridge away"
NOT_LOST = "on some topics only"
MOST_IN_TRANSIT = 5
"""Maximum number of readings, and of results, that a step may cut off between two processes."""


@dataclass(frozen=True, slots=True)
class Counters:
    """The master's counters of results and of losses by reason."""

    completed: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)

    def since(self, former: Counters) -> Counters:
        """Return the increase since earlier counters of the same master."""
        lost = {reason: count - former.lost.get(reason, 0) for reason, count in self.lost.items()}
        return Counters(
            self.completed - former.completed, {why: count for why, count in lost.items() if count}
        )


@dataclass(frozen=True, slots=True)
class Overdue:
    """Readings without a result when a step was judged.

    If the machine was busy, they are only late: then their results arrive and are counted in the next step.

    Attributes:
        readings: These readings.
        uncounted: How many of them no counter included.
        astray: How many were counted as published.
        reasons: Reasons for losses that the faults of that step explain.
    """

    readings: Sequence[Reading] = ()
    uncounted: int = 0
    astray: int = 0
    reasons: frozenset[str] = frozenset()

    @property
    def late(self) -> int:
        """Number of uncounted readings whose results have arrived meanwhile."""
        return min(self.uncounted, sum(each.arrived for each in self.readings))


@dataclass(frozen=True, slots=True)
class Excuses:
    """What the faults of a step explain.

    Attributes:
        reasons: Reasons under which the stack may count losses.
        readings: Whether readings may be lost on their way to the master, where no counter can include them (a
            killed subscriber or master, a cut connection).
        results: Whether results may be lost so on their way from the publisher.
        most: Maximum number of each; higher only if a process or connection was held before.
        until: Time at which the stack had recovered; only readings published before it are excused.
        overdue: What was missing when the step before was judged.
    """

    reasons: frozenset[str] = frozenset()
    readings: bool = False
    results: bool = False
    most: int = MOST_IN_TRANSIT
    until: float = 0.0
    overdue: Overdue = Overdue()


def judge(added: Counters, readings: Iterable[Reading], excuses: Excuses) -> tuple[list[Finding], Overdue]:
    """Compare the master's counters with the readings of the same time, when nothing is in flight.

    Returns:
        The findings, and what no counter includes, as it was cut off between two processes, or is late.
    """
    findings = []
    overdue, late = excuses.overdue, excuses.overdue.late
    given = [each for each in readings if each.forwarded]
    missing = [each for each in given if not each.arrived]
    arrived = len(given) - len(missing) + late
    losses = sum(count for reason, count in added.lost.items() if reason != NOT_LOST)
    uncounted, astray = len(given) + late - added.completed - losses, added.completed - arrived
    most = min(sum(each.published <= excuses.until for each in missing), excuses.most)
    slack = min(late, overdue.astray)  # of these, the readings were counted before
    figures = f"{len(given)} readings, {len(missing)} without result; counted: {added}"
    if uncounted > slack + (most if excuses.readings else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{uncounted} readings: {figures}"))
    if -uncounted > slack + overdue.uncounted - late:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-uncounted} too many: {figures}"))
    if astray > (most if excuses.results else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{astray} results are counted as published: {figures}"))
    if -astray > slack + added.lost.get(WITH_PUBLISHER, 0):
        findings.append(Finding(Flaw.MISCOUNTED, f"{-astray} results that were not counted: {figures}"))
    explained = {
        PASSED_OVER: sum(each.crowded for each in given),
        UNUSABLE: sum(each.addresses is None for each in given),
    }
    left = overdue.uncounted  # these may be counted only now, under a reason of the step before
    for reason, number in added.lost.items():
        more = 0 if reason in excuses.reasons else max(0, number - explained.get(reason, 0))
        if reason in overdue.reasons:
            more, left = max(0, more - left), max(0, left - more)
        if more:
            findings.append(Finding(Flaw.UNEXPLAINED, f"{more} {reason}, which no fault explains; {figures}"))
    reasons = excuses.reasons | {PASSED_OVER}
    return findings, Overdue(missing, max(0, uncounted), max(0, astray), reasons)
