"""Accounts of readings: each that reached the stack has a result, or is counted with a reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from scripts.campaigning.judging.observer import Finding, Flaw, Reading

WITH_PUBLISHER = "lost with the publisher"
"""Reason of results that may have arrived, because the publisher was killed before it confirmed them."""
MOST_IN_TRANSIT = 5
"""Maximum number of readings, and of results, that a step may cut off between two processes."""
NOT_LOST = "on some topics only"


@dataclass(frozen=True, slots=True)
class Counters:
    """The master's counters."""

    received: int = 0
    completed: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)

    def since(self, former: Counters) -> Counters:
        """Return the increase since earlier counters of the same master."""
        lost = {reason: count - former.lost.get(reason, 0) for reason, count in self.lost.items()}
        return Counters(
            self.received - former.received,
            self.completed - former.completed,
            {reason: count for reason, count in lost.items() if count},
        )

    @property
    def losses(self) -> int:
        """The number of readings without a result."""
        return sum(count for reason, count in self.lost.items() if reason != NOT_LOST)


@dataclass(frozen=True, slots=True)
class Overdue:
    """Readings without a result when a step was judged.

    If the machine was busy, they are only late: then their results arrive and are counted in the next step.

    Attributes:
        readings: These readings.
        uncounted: How many of them no counter included.
        astray: How many were counted as published.
    """

    readings: Sequence[Reading] = ()
    uncounted: int = 0
    astray: int = 0

    @property
    def late(self) -> int:
        """Number of uncounted readings whose results have arrived meanwhile."""
        return min(self.uncounted, sum(each.arrived is not None for each in self.readings))


@dataclass(frozen=True, slots=True)
class Excuses:
    """Losses by a fault that no counter of the stack can include.

    Attributes:
        readings: Readings on their way to the master (a killed subscriber or master, a cut connection).
        results: Results on their way from the publisher.
        most: Maximum number of each; higher only if a process or connection was held before.
        until: Time at which the stack had recovered; only readings published before it are excused.
        overdue: What was missing when the step before was judged.
    """

    readings: bool = False
    results: bool = False
    most: int = MOST_IN_TRANSIT
    until: float = 0.0
    overdue: Overdue = Overdue()


def in_transit(added: Counters, readings: Iterable[Reading], overdue: Overdue) -> Overdue:
    """Return what no counter includes, as it was cut off between two processes, or is late."""
    uncounted, astray = _difference(added, readings, overdue)
    missing = [each for each in readings if each.forwarded and each.arrived is None]
    return Overdue(missing, max(0, uncounted), max(0, astray))


def _difference(added: Counters, readings: Iterable[Reading], overdue: Overdue) -> tuple[int, int]:
    """Return the numbers of uncounted readings, and of results that are counted and have not arrived."""
    given = [each for each in readings if each.forwarded]
    arrived = sum(each.arrived is not None for each in given) + overdue.late
    return len(given) + overdue.late - added.completed - added.losses, added.completed - arrived


def judge(added: Counters, readings: Iterable[Reading], excuses: Excuses, now: float) -> list[Finding]:
    """Compare the master's counters with the readings of the same time, when nothing is in flight."""
    findings = []
    given = [each for each in readings if each.forwarded]
    arrived = sum(each.arrived is not None for each in given)
    doubtful = added.lost.get(WITH_PUBLISHER, 0)
    excusable = [each for each in given if each.arrived is None and each.published <= excuses.until]
    most = min(len(excusable), excuses.most)
    figures = f"{len(given)} readings, {arrived} results; counted: {added}"
    uncounted, astray = _difference(added, readings, excuses.overdue)
    slack = min(excuses.overdue.late, excuses.overdue.astray)  # of these, the readings were counted before
    if uncounted > slack + (most if excuses.readings else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{uncounted} readings: {figures}", now))
    if -uncounted > slack + excuses.overdue.uncounted - excuses.overdue.late:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-uncounted} too many: {figures}", now))
    if astray > (most if excuses.results else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{astray} results are counted as published: {figures}", now))
    if -astray > doubtful + slack:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-astray} results that were not counted: {figures}", now))
    return findings
