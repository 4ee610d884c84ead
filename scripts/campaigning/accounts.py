"""Accounts of readings: each that reached the stack has a result, or is counted under the reason of a fault."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from scripts.campaigning.observer import Finding, Flaw, Reading

PASSED_OVER = "passed over"
"""Loss reason that needs no fault, only a newer reading that arrived before the result."""
UNUSABLE = "with an unusable variable"
"""Loss reason that needs no fault, only a published reading with an unusable variable."""
WITH_PUBLISHER = "lost with the publisher"
"""Reason of results that may have arrived, because the publisher was killed before it confirmed them."""
WITH_APP, FAILED, ROSBRIDGE_AWAY = "lost with pcie-app", "failed on a board", "rosbridge away"
NOT_LOST = "on some topics only"
MOST_IN_TRANSIT = 5
"""Maximum number of readings, and of results, that may be lost between two processes in a step."""


@dataclass(frozen=True, slots=True)
class Counters:
    """The master's counters of results and of losses by reason."""

    completed: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)

    def since(self, former: "Counters") -> "Counters":
        """Return the increase since earlier counters of the same master."""
        lost = {reason: count - former.lost.get(reason, 0) for reason, count in self.lost.items()}
        return Counters(
            self.completed - former.completed, {why: count for why, count in lost.items() if count}
        )


@dataclass(frozen=True, slots=True)
class Excuses:
    """Losses that the faults of a step explain.

    Attributes:
        reasons: Reasons under which the stack may count losses.
        readings: Whether readings may be lost before the master counts them. A killed subscriber, a killed master
            or a cut connection can cause this loss.
        results: Whether results may be lost after the master has counted them as published.
        most: Maximum number of lost readings, and maximum number of lost results. It is unlimited after a fault
            that holds up a process or connection.
        until: Time of publication of the first reading that has a result again. The stack keeps the order of
            readings, so only readings published before this time may be lost.
    """

    reasons: frozenset[str] = frozenset()
    readings: bool = False
    results: bool = False
    most: int = MOST_IN_TRANSIT
    until: float = 0.0


def judge(added: Counters, readings: Iterable[Reading], excuses: Excuses) -> list[Finding]:
    """Compare the increase of the master's counters with the readings of the same period, when nothing is in flight."""
    findings = []
    given = [each for each in readings if each.forwarded]
    missing = [each for each in given if not each.arrived]
    losses = sum(count for reason, count in added.lost.items() if reason != NOT_LOST)
    uncounted = len(given) - added.completed - losses
    surplus = added.completed - (len(given) - len(missing))
    most = min(sum(each.published < excuses.until for each in missing), excuses.most)
    figures = f"{len(given)} readings, {len(missing)} without result; counted: {added}"
    if uncounted > (most if excuses.readings else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{uncounted} readings: {figures}"))
    if uncounted < 0:
        findings.append(Finding(Flaw.MISCOUNTED, f"{-uncounted} too many: {figures}"))
    if surplus > (most if excuses.results else 0):
        findings.append(Finding(Flaw.UNCOUNTED, f"{surplus} results are counted as published: {figures}"))
    if -surplus > added.lost.get(WITH_PUBLISHER, 0):
        findings.append(Finding(Flaw.MISCOUNTED, f"{-surplus} results that were not counted: {figures}"))
    explained = {
        PASSED_OVER: sum(each.crowded for each in given),
        UNUSABLE: sum(each.addresses is None for each in given),
    }
    for reason, number in added.lost.items():
        if reason not in excuses.reasons and number > explained.get(reason, 0):
            findings.append(Finding(Flaw.UNEXPLAINED, f"{reason}, which no fault explains: {figures}"))
    return findings
