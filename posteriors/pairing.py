"""Which posterior belongs to which frame.

`/BMresults` carries no stamp; the `/bm/frame` that is sent just before it does, and it is the stamp of the reading.
"""

from collections import deque
from dataclasses import replace
from typing import Final

from posteriors.frame_report import FrameReport
from posteriors.posterior import Posterior

FrameOutcome = Posterior | FrameReport
"""A frame's posterior, or the report of a frame that has none."""

WAITING: Final = 256
"""Reports, and posteriors, that wait for their counterparts at most."""


class Pairing:
    """Matches posteriors with the reports of their frames, in whatever order the two topics arrive.

    Each topic's own messages arrive in order, so the next posterior goes to the next report of a published frame.
    `heard_ns` shows when one of the two was lost: a posterior goes to no report that arrived more than `disorder_ns`
    after it, nor to one that arrived as long before it if the next one did not. Servers keep the order of a topic, but
    not all keep the order between topics.

    Attributes:
        announced_only: Reports whose posterior never came.
    """

    def __init__(self, *, disorder_ns: int = 0) -> None:
        self.announced_only = 0
        self._disorder_ns = disorder_ns
        self._reports: deque[FrameReport] = deque()
        self._posteriors: deque[Posterior] = deque()

    @property
    def waits(self) -> bool:
        """Whether a posterior waits for its report."""
        return bool(self._posteriors)

    def add_report(self, report: FrameReport) -> list[FrameOutcome]:
        """Take a `/bm/frame` and return the frames that are complete now."""
        self._reports.append(report)
        if len(self._reports) > WAITING:  # nobody publishes posteriors on the subscribed topic
            self._reports.popleft()
            self.announced_only += 1
        return self._match()

    def add_posterior(self, posterior: Posterior) -> list[FrameOutcome]:
        """Take a `/BMresults` and return the frames that are complete now."""
        self._posteriors.append(posterior)
        ready = self._match()
        if len(self._posteriors) > WAITING:
            ready.append(self._posteriors.popleft())
        return ready

    def flush(self) -> list[FrameOutcome]:
        """Return the posteriors that still wait: their reports are lost."""
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
                ready.append(replace(self._posteriors.popleft(), report=self._reports.popleft()))
        return ready

    def _belongs_to_a_later(self, posterior: Posterior) -> bool:
        """Whether a posterior came too late to be the first report's, and not too early to be the next one's."""
        first, second = self._reports[0], self._reports[1]
        return (
            first.heard_ns + self._disorder_ns < posterior.heard_ns
            and second.heard_ns <= posterior.heard_ns + self._disorder_ns
        )
