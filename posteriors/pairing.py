"""Pairing of the posteriors on `/BMresults` with the reports on `/bm/frame`.

A posterior on `/BMresults` has no stamp. The publisher sends the report of a frame just before the frame's posterior,
and the report contains the stamp of the reading.
"""

from collections import deque
from dataclasses import replace
from typing import Final

from posteriors.frame_report import FrameReport
from posteriors.posterior import Posterior

FrameOutcome = Posterior | FrameReport
"""The posterior of a frame, or the report of a frame without a posterior."""

WAITING: Final = 256
"""Maximum number of waiting reports. It is also the maximum number of waiting posteriors."""


class Pairing:
    """Pairing of posteriors with reports, whichever of the two arrives first.

    Servers preserve the order of messages within a topic, but not always between topics. If nothing is lost, the
    first waiting posterior belongs to the first waiting report of a published frame. The times of arrival (`heard_ns`)
    show losses. Let P be the first waiting posterior, and let R1 and R2 be the first two waiting reports:

    - If R1 arrived more than `disorder_ns` after P, the report of P was lost.
    - If R1 arrived more than `disorder_ns` before P, and R2 arrived no later than `disorder_ns` after P, the posterior
      of R1 was lost.

    Attributes:
        announced_only: Number of reports whose posterior never arrived.
    """

    def __init__(self, *, disorder_ns: int = 0) -> None:
        self.announced_only = 0
        self._disorder_ns = disorder_ns
        self._reports: deque[FrameReport] = deque()
        self._posteriors: deque[Posterior] = deque()

    @property
    def waits(self) -> bool:
        """True while a posterior is waiting for its report."""
        return bool(self._posteriors)

    def add_report(self, report: FrameReport) -> list[FrameOutcome]:
        """Add a report (`/bm/frame`), and return the frames that are now complete."""
        self._reports.append(report)
        if len(self._reports) > WAITING:  # no posteriors arrive on the subscribed topic
            self._reports.popleft()
            self.announced_only += 1
        return self._match()

    def add_posterior(self, posterior: Posterior) -> list[FrameOutcome]:
        """Add a posterior (`/BMresults`), and return the frames that are now complete."""
        self._posteriors.append(posterior)
        ready = self._match()
        if len(self._posteriors) > WAITING:
            ready.append(self._posteriors.popleft())
        return ready

    def flush(self) -> list[FrameOutcome]:
        """Remove and return the posteriors whose reports have not arrived."""
        ended: list[FrameOutcome] = list(self._posteriors)
        self._posteriors.clear()
        return ended

    def _match(self) -> list[FrameOutcome]:
        ready: list[FrameOutcome] = []
        while self._reports or self._posteriors:
            if self._reports and not self._reports[0].published:
                ready.append(self._reports.popleft())
                continue
            if not self._posteriors or not self._reports:
                break
            posterior = self._posteriors[0]
            if self._reports[0].heard_ns > posterior.heard_ns + self._disorder_ns:  # its own report was lost
                ready.append(self._posteriors.popleft())
            elif len(self._reports) > 1 and self._belongs_to_a_later(posterior):
                self._reports.popleft()  # its posterior was lost
                self.announced_only += 1
            else:
                report = self._reports.popleft()
                ready.append(replace(self._posteriors.popleft(), report=report, details=report.details))
        return ready

    def _belongs_to_a_later(self, posterior: Posterior) -> bool:
        """Return whether a posterior came too late for the first waiting report, and not too early for the second."""
        first, second = self._reports[0], self._reports[1]
        return (
            first.heard_ns + self._disorder_ns < posterior.heard_ns
            and second.heard_ns <= posterior.heard_ns + self._disorder_ns
        )
