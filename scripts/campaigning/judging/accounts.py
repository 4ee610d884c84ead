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
class Excuses:
    """Losses by a fault that no counter of the stack can include.

    Attributes:
        readings: Readings on their way to the master (a killed subscriber or master, a cut connection).
        results: Results on their way from the publisher.
        most: Maximum number of each; higher only if a process or connection was held before.
        since: Beginning of the fault (seconds); readings from shortly before it on are excused.
        until: Time at which the stack had recovered.
        overdue: Readings without a result when the step before was judged.
        uncounted: How many of them no counter included then. They are only late if the machine was busy: then they are
            counted now.
    """

    readings: bool = False
    results: bool = False
    most: int = MOST_IN_TRANSIT
    since: float = 0.0
    until: float = 0.0
    overdue: Sequence[Reading] = ()
    uncounted: int = 0


IN_FLIGHT = 1.0
"""Maximum number of seconds that a reading is in flight when a fault begins."""


def in_transit(added: Counters, readings: Iterable[Reading]) -> tuple[int, int]:
    """Return the readings and results that no counter includes, as they were cut off between two processes."""
    given = [each for each in readings if each.forwarded]
    arrived = sum(each.arrived is not None for each in given)
    return max(0, len(given) - added.completed - added.losses), max(0, added.completed - arrived)


def judge(added: Counters, readings: Iterable[Reading], excuses: Excuses, now: float) -> list[Finding]:
    """Compare the master's counters with the readings of the same time, when nothing is in flight."""
    findings = []
    given = [each for each in readings if each.forwarded]
    arrived = sum(each.arrived is not None for each in given)
    doubtful = added.lost.get(WITH_PUBLISHER, 0)
    excusable = [
        each
        for each in given
        if each.arrived is None and excuses.since - IN_FLIGHT <= each.published <= excuses.until
    ]
    most = min(len(excusable), excuses.most)
    figures = f"{len(given)} readings, {arrived} results; counted: {added}"
    uncounted = len(given) - added.completed - added.losses
    if uncounted > (most if excuses.readings else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{uncounted} readings: {figures}", now))
    if -uncounted > excuses.uncounted:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-uncounted} too many: {figures}", now))
    astray = added.completed - arrived
    late = min(excuses.uncounted, sum(each.arrived is not None for each in excuses.overdue))
    if astray > late + (most if excuses.results else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{astray} results are counted as published: {figures}", now))
    if -astray > doubtful:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-astray} results that were not counted: {figures}", now))
    return findings
