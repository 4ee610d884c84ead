"""The publisher, which publishes results as posteriors on /BMresults (thesis 3.1, Publisher.jar).

master ──Publish──▶ publish_now ──────────────────────────────▶ Published ──▶ master
                    └─ servers are away or slow, or --once ─▶ [waiting] ──▶ publish ──▶ Published
"""

import asyncio
import time
from collections import Counter
from typing import NoReturn

import msgspec

from bridge.client import State
from services.pipeline.connections import (
    CHECK_INTERVAL,
    SETTLED_TIME,
    AdvertisedTopic,
    NotReceivableError,
    reconnect_now,
    refusals,
    reported_refusals,
)
from services.pipeline.result_topics import RESULTS_DEPTH, ROLE, ResultTopics
from services.settings import Settings
from services.sockets.records import AnyRecord, Begin, Outcome, Publish, Published, Ready, Rosbridge, Seen
from services.sockets.serving import MakeLink, RunService
from services.sockets.status import FrameCounts, ProcessStatus, connections, why_not_connected
from terminal.signals import until_one_ends
from toolchain.deployment import Deployment


class Publisher(RunService):
    """Service that publishes the results of a master."""

    role = ROLE

    def __init__(self, settings: Settings, deployment: Deployment, link: MakeLink) -> None:
        super().__init__(settings, link)
        self._topics = ResultTopics(settings, deployment)
        # Results that could not be published at once. While `_draining`, later ones join them, so that all stay in
        # order: until the topics are advertised, and then until the queue is empty.
        self._waiting: asyncio.Queue[Publish] = asyncio.Queue(RESULTS_DEPTH)
        self._draining = True
        # Set by the master's `Begin`: the only result must be seen on the wire, or be an error.
        self._once = False
        # In a run of many frames: `_looks` is True from `Begin` to the first published result, which sets `_first`.
        self._looks = False
        self._first = asyncio.Event()
        self._deployment = deployment
        # The sentence about topics and servers once they are advertised; empty before.
        self._where = ""
        # For the status: outcomes so far, and the last published frame's number and time (monotonic, ns).
        self._outcomes: Counter[Outcome] = Counter()
        self._last = (0, 0)
        # By topic, why the server does not pass the topic on, as of the last check.
        self._refused: dict[str, str] = {}

    def status(self) -> ProcessStatus:
        """Return the status of this process."""
        why = why_not_connected(self._topics.rosbridges)
        if not why and not self._where:
            why = "waiting for the topics to be advertised"
        outcomes = self._outcomes
        return ProcessStatus(
            ready=not why,
            why=why or self._where,
            deployment=self._deployment.hash,
            connections=connections(self._topics.rosbridges),
            frames=FrameCounts.of(
                outcomes.total() + self._waiting.qsize(),
                outcomes[Outcome.PUBLISHED],
                {reason: count for reason, count in outcomes.items() if reason is not Outcome.PUBLISHED},
                self._last,
            ),
        )

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, Begin):
            self._once = record.once
            self._looks = not record.once
            self._topics.watch()
        elif isinstance(record, Publish):
            if not (self._once or self._draining or self._topics.must_wait):
                # the usual case: nothing to wait for, and no other task to wake
                self._report(self._topics.publish_now(record))
                return
            self._draining = True  # results stay in order
            try:
                self._waiting.put_nowait(record)
            except asyncio.QueueFull:
                self._outcomes[Outcome.ROSBRIDGE_AWAY] += 1
                self._link.send(Published(record.result.number, Outcome.ROSBRIDGE_AWAY, None, -1, 0.0, 0, 0))
        elif isinstance(record, Rosbridge):
            reconnect_now(self._topics.rosbridges)

    def _report(self, published: Published) -> None:
        """Count and log the outcome of a result, and send it to the master."""
        if published.outcome is Outcome.PUBLISHED and self._refused:
            published = self._without_refused(published)
        self._link.send(published)
        self._outcomes[published.outcome] += 1
        if published.outcome is Outcome.PUBLISHED:
            self._last = (published.number, time.monotonic_ns())
            if self._looks:
                self._looks = False
                self._first.set()
        if self._logs_frames:
            self._log.debug(
                published.outcome,
                frame=published.number,
                probability=f"{published.best_probability:.3g}",
                ms=f"{published.total_ns / 1e6:.2f}",
            )

    def _without_refused(self, published: Published) -> Published:
        refused = sum(topic.name in self._refused for topic in self._topics.advertised)
        if refused == len(self._topics.advertised):
            return msgspec.structs.replace(published, outcome=Outcome.REFUSED, missed=0)
        return msgspec.structs.replace(published, missed=max(published.missed, refused))

    async def _check_delivery(self, *, settled: bool) -> None:
        """Report each refused topic once; with `--once`, raise a NotReceivableError if all outputs are refused."""
        topics = self._topics.advertised
        asked = [*topics, *([self._topics.reports] if self._topics.reports else [])]
        # a server needs time for each question, and the first result would have to wait for it
        standard = self._topics.standard
        if settled:
            asked += standard.advertised
        refused = await refusals(asked, settled=settled) | reported_refusals(standard.advertised)
        standard.refused |= refused.keys()
        if self._once and all(topic.name in refused for topic in topics):
            raise NotReceivableError(refused[topics[0].name])
        for name in refused.keys() - self._refused.keys():
            self._link.notice("warning", refused[name])
        self._refused = refused

    async def _keep_checking(self) -> NoReturn:
        await asyncio.sleep(SETTLED_TIME)
        while True:
            await self._check_delivery(settled=True)
            await asyncio.sleep(CHECK_INTERVAL)

    async def _keep_looking(self) -> NoReturn:
        """Check in every run of a loop (`--loop`) whether the server passes results on, since some servers do not."""
        while True:
            await self._first.wait()
            self._first.clear()
            seen = reported = False
            while not (seen or self._first.is_set()):
                seen = await self._topics.seen(self._settings.seen_timeout)
                # without a connection nothing can be seen
                if not (seen or reported or why_not_connected(self._topics.rosbridges)):
                    reported = True
                    await self._report_unseen(self._topics.advertised[0])
            if seen:
                self._link.send(Seen(True))

    async def _report_unseen(self, output: AdvertisedTopic) -> None:
        await self._check_delivery(settled=True)
        if output.name not in self._refused:
            sentence = (
                f"no result was seen on {output.name} at {output.uri} within {self._settings.seen_timeout:g} s after the "
                "first was published: does the server allow the topic to be published and subscribed?"
            )
            self._link.notice("warning", sentence)
        self._link.send(Seen(False))

    def _state_changed(self, uri: str, state: State, reason: str) -> None:
        topics, rosbridge = self._topics.served_by(uri)
        if state is State.RECONNECTING:
            sentence = f"{rosbridge} is gone ({reason}); results{topics} are lost until it is back"
            self._link.notice("warning", sentence)
        elif state is State.CONNECTED and self._where:
            self._link.notice("info", f"{rosbridge} is back for results{topics}")
        # before the topics are advertised, the master waits for `Ready` anyway
        if self._where:
            self._link.keep(Rosbridge(self._topics.is_connected))

    async def _publish_waiting(self) -> NoReturn:
        while True:
            publish = await self._waiting.get()
            # before the only result, because afterwards nothing would show why nobody has received it
            if self._once:
                await self._check_delivery(settled=False)
            published = await self._topics.publish(publish, look=self._once)
            if published.seen is False:
                await self._check_delivery(settled=True)
            self._report(published)
            self._draining = not self._waiting.empty()

    async def _serve(self) -> None:
        """Publish, or raise a BridgeError if a server is unreachable or not a rosbridge server."""
        async with self._topics.opened(self._state_changed) as where:
            await self._check_delivery(settled=False)
            self._where = where
            self._link.keep(Ready(where))
            self._draining = False
            standard = self._topics.standard
            await until_one_ends(
                self._publish_waiting(),
                self._keep_checking(),
                self._keep_looking(),
                standard.keep_reporting(),
                *([standard.follow_clock()] if self._settings.use_sim_time else []),
            )
