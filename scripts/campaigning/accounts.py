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
WITH_APP = "lost with pcie-app"
FAILED = "failed on a board"
ROSBRIDGE_AWAY = "rosbridge away"
NOT_LOST = "on some topics only"
MOST_IN_TRANSIT = 5
"""Maximum number of readings, and of results, that a step may cut off between two processes."""


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


def in_transit(added: Counters, readings: Iterable[Reading], excuses: Excuses) -> Overdue:
    """Return what no counter includes, as it was cut off between two processes, or is late."""
    uncounted, astray = _difference(added, readings, excuses.overdue)
    missing = [each for each in readings if each.forwarded and not each.arrived]
    return Overdue(missing, max(0, uncounted), max(0, astray), excuses.reasons | {PASSED_OVER})


def _difference(added: Counters, readings: Iterable[Reading], overdue: Overdue) -> tuple[int, int]:
    """Return the numbers of uncounted readings, and of results that are counted and have not arrived."""
    given = [each for each in readings if each.forwarded]
    arrived = sum(each.arrived for each in given) + overdue.late
    return len(given) + overdue.late - added.completed - added.losses, added.completed - arrived


def judge(added: Counters, readings: Iterable[Reading], excuses: Excuses) -> list[Finding]:
    """Compare the master's counters with the readings of the same time, when nothing is in flight."""
    findings = []
    given = [each for each in readings if each.forwarded]
    arrived = sum(each.arrived for each in given)
    doubtful = added.lost.get(WITH_PUBLISHER, 0)
    excusable = [each for each in given if not each.arrived and each.published <= excuses.until]
    most = min(len(excusable), excuses.most)
    figures = f"{len(given)} readings, {arrived} results; counted: {added}"
    uncounted, astray = _difference(added, readings, excuses.overdue)
    slack = min(excuses.overdue.late, excuses.overdue.astray)  # of these, the readings were counted before
    if uncounted > slack + (most if excuses.readings else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{uncounted} readings: {figures}"))
    if -uncounted > slack + excuses.overdue.uncounted - excuses.overdue.late:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-uncounted} too many: {figures}"))
    if astray > (most if excuses.results else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{astray} results are counted as published: {figures}"))
    if -astray > doubtful + slack:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-astray} results that were not counted: {figures}"))
    return findings + _unexplained(added, given, excuses)


def _unexplained(added: Counters, given: list[Reading], excuses: Excuses) -> list[Finding]:
    """Return losses whose reasons neither the readings nor a fault explain."""
    findings = []
    known = {
        PASSED_OVER: sum(each.crowded for each in given),
        UNUSABLE: sum(each.addresses is None for each in given),
    }
    late = excuses.overdue.uncounted  # these may be counted only now, under a reason of the step before
    for reason, number in added.lost.items():
        more = 0 if reason in excuses.reasons else number - known.get(reason, 0)
        if more > 0 and reason in excuses.overdue.reasons:
            more, late = max(0, more - late), max(0, late - more)
        if more > 0:
            sentence = f"{more} readings {reason}, without a fault that explains it; counted: {added}"
            findings.append(Finding(Flaw.UNEXPLAINED, sentence))
    return findings
