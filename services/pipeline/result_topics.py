"""The topics on which results are published."""

import asyncio
import contextlib
import math
import time
from collections import deque
from collections.abc import AsyncIterator
from typing import Any, Literal

import msgspec

from bridge.client import Publication, Ros, State, Subscription
from bridge.errors import BridgeError, DisconnectedError, NoMessageError, SlowPeerError
from machines.kind import Inference
from posteriors.frame_report import FRAME_TOPIC, FRAME_TYPE, write_frame_report
from posteriors.posterior import MAX_RESULT, SAMPLES_TOPIC, SAMPLES_TYPE, posterior_layout, samples_layout
from services.pipeline.connections import AdvertisedTopic, OnState, connect_all
from services.pipeline.inference import infer, report_of
from services.pipeline.standard_topics import StandardTopics
from services.settings import Settings
from services.sockets.records import Outcome, Publish, Published
from terminal.logs import get_logger
from toolchain.deployment import Deployment

ROLE = "publisher"
RESULTS_DEPTH = 64
"""Maximum number of results that wait in the publisher for the rosbridge server.

A master does not reach this maximum, because it computes no frame while `MOST_AT_PUBLISHER` results are unanswered.
"""


def same_numbers(received: Any, sent: list[float], *, rel_tol: float = 1e-12, abs_tol: float = 0.0) -> bool:
    """Return whether two arrays are equal within tolerances. Some servers lose the last bit of a number."""
    return (
        isinstance(received, list)
        and len(received) == len(sent)
        and all(
            isinstance(one, int | float) and math.isclose(one, other, rel_tol=rel_tol, abs_tol=abs_tol)
            for one, other in zip(received, sent, strict=True)
        )
    )


class ResultTopics:
    """The advertised output topics of a deployment on their servers.

    Attributes:
        rosbridges: The connections by URI.
        advertised: The output topics, once they are advertised.
        reports: The topic of the frame reports, or None before it is advertised.
        standard: The topics for robot tools. They are published after the results.
    """

    def __init__(self, settings: Settings, deployment: Deployment) -> None:
        self._settings = settings
        # Spelling of the stamps in reports: that of the first server, unless a setting chooses it.
        self._ros_version: Literal[1, 2] = 2
        self._deployment = deployment
        self._layout = posterior_layout(deployment)
        # From `opened` on: each output with its server, and the topics of reports and, if the machine streams them,
        # samples on the first server.
        self._outputs: list[tuple[Ros, Publication]] = []
        self._frames: Publication | None = None
        self._samples: Publication | None = None
        # The subscription to the first output until a result is seen there, and the last results published since.
        self._watched: Subscription | None = None
        self._unseen: deque[Any] = deque(maxlen=RESULTS_DEPTH)
        # A report precedes its result, so it contains how long the previous result took to send.
        self._previous_out_ns = 0
        self.rosbridges: dict[str, Ros] = {}
        self.advertised: list[AdvertisedTopic] = []
        self.reports: AdvertisedTopic | None = None
        self.standard = StandardTopics(settings, deployment, ROLE)

    @contextlib.asynccontextmanager
    async def opened(self, on_state: OnState | None = None) -> AsyncIterator[str]:
        """Connect and advertise, or raise a BridgeError. Yield a sentence that names the topics and the servers."""
        settings, deployment = self._settings, self._deployment
        by_uri = self.rosbridges
        async with contextlib.AsyncExitStack() as stack:
            uris = [settings.uri or deployment.output_uri(output) for output in deployment.outputs]
            await connect_all(stack, settings, uris, by_uri, on_state=on_state, max_size=MAX_RESULT)
            for uri, output in zip(uris, deployment.outputs, strict=True):
                self._outputs.append((by_uri[uri], await by_uri[uri].advertise(output.topic, output.type)))
                self.advertised.append(AdvertisedTopic(by_uri[uri], uri, output.topic, output.type))
            # reports go to one server only, because a listener of several would get each twice
            first = by_uri[uris[0]]
            self._frames = await first.advertise(FRAME_TOPIC, FRAME_TYPE)
            if deployment.machine.stream:
                self._samples = await first.advertise(SAMPLES_TOPIC, SAMPLES_TYPE)
            self._ros_version = await first.detect_ros_version() or 2
            self.reports = AdvertisedTopic(first, uris[0], FRAME_TOPIC, FRAME_TYPE)
            await self.standard.open(first, uris[0], self._ros_version)
            stack.callback(self.standard.flush)
            topics = ", ".join(output.topic for output in deployment.outputs)
            yield f"publishing on {topics} at {', '.join(by_uri)}"

    def served_by(self, uri: str) -> tuple[str, str]:
        """Return the output topics of a server and the name of the server, as parts of a sentence for the user.

        An example is ` for /BMresults` and `rosbridge at ws://robot:9090`. If the stack uses a single server, the
        parts are an empty text and `rosbridge`.
        """
        if len(self.rosbridges) == 1:
            return "", "rosbridge"
        topics = [publication.topic for ros, publication in self._outputs if ros is self.rosbridges.get(uri)]
        which = f" for {' and '.join(topics)}" if topics else ""
        return which, f"rosbridge at {uri}"

    def watch(self) -> None:
        """Subscribe to the first output topic, so that `seen` can tell whether a published result comes back."""
        if self._watched is None:
            output = self._deployment.outputs[0]
            self._watched = self._outputs[0][0].subscribe(output.topic, output.type, queue_size=RESULTS_DEPTH)

    async def seen(self, timeout: float) -> bool:
        """Return whether the server sends back a result published since `watch`, within `timeout` seconds.

        If it does, end the subscription that `watch` made.
        """
        if self._watched is None:
            return False
        # results of other publishers of the topic may arrive before
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            try:
                message = await self._watched.next(timeout=left)
            except NoMessageError:
                return False
            if any(same_numbers(message.msg.get("data"), sent.tolist()) for sent in self._unseen):
                await self._watched.close()
                self._watched = None
                self._unseen.clear()
                return True
        return False

    @property
    def is_connected(self) -> bool:
        """True while at least one server is connected."""
        return bool(self._connected())

    @property
    def must_wait(self) -> bool:
        """True while no server is connected, or a connected server has not accepted earlier messages yet."""
        connected = self._connected()
        return not connected or any(publication.must_wait for publication in connected)

    def _connected(self) -> list[Publication]:
        return [publication for ros, publication in self._outputs if ros.state is State.CONNECTED]

    async def publish(self, publish: Publish, *, look: bool) -> Published:
        """Wait until the servers accept messages, then publish a frame's report and, if there is one, its posterior.

        With `look`, also wait until the server sends the posterior back. The setting `seen_timeout` limits this wait.
        """
        inference = infer(publish.result, self._deployment)
        # a server that does not accept the result in time does not get it, and the user is warned
        ready = [publication.ready() for publication in self._connected()]
        for error in await asyncio.gather(*ready, return_exceptions=True):
            if isinstance(error, BridgeError):
                get_logger(ROLE).warning(str(error), frame=publish.result.number)
            elif error is not None:
                raise error
        published = self.publish_now(publish, inference)
        if look and published.outcome is Outcome.PUBLISHED and inference.posterior is not None:
            seen = await self.seen(self._settings.seen_timeout)
            published = msgspec.structs.replace(published, seen=seen)
            # the run is about to end
            self.standard.flush()
        return published

    def publish_now(self, publish: Publish, inference: Inference | None = None) -> Published:
        """Publish a frame's report and posterior without waiting, and return the outcome.

        The report goes to the server of the first output. The posterior goes to every output whose server accepts it
        now. It counts as published if at least one server accepted it.
        """
        started = time.monotonic_ns()
        inference = inference or infer(publish.result, self._deployment)
        report = report_of(
            publish,
            inference,
            self._deployment,
            now=(time.time_ns(), started),
            previous_out_ns=self._previous_out_ns,
        )
        posterior, best = inference.posterior, inference.best
        missed = 0
        # one write of the socket for both, so that they arrive together
        with self._outputs[0][0].together():
            reported = self._frames is not None and _sent(
                self._frames, write_frame_report(report, self._ros_version)
            )
            if self._samples is not None and inference.samples:
                width = inference.sample_bytes
                layout = samples_layout(len(inference.samples) // width, width)
                _sent(self._samples, {"layout": layout, "data": inference.samples})
            if posterior is not None:
                for _, publication in self._outputs:
                    missed += not _sent(publication, {"layout": self._layout, "data": posterior})
                if self._watched is not None:
                    self._unseen.append(posterior)
        now = time.monotonic_ns()
        self._previous_out_ns = now - started
        self.standard.offer(publish, inference)
        outcome = Outcome.PUBLISHED if posterior is not None else Outcome.NO_POSTERIOR
        # a frame without a posterior has only its report
        if missed == len(self._outputs) or (posterior is None and not reported):
            outcome, missed = Outcome.ROSBRIDGE_AWAY, 0
        return Published(
            number=publish.result.number,
            outcome=outcome,
            seen=None,
            best_line=best,
            best_probability=0.0 if posterior is None else float(posterior[best]),
            cycles=report.cycles or 0,
            total_ns=now - publish.received_tick,
            missed=missed,
            out_ns=self._previous_out_ns,
            why="" if report.published and not report.is_biased else report.outcome,
            cause=", ".join(sorted({board.stopped for board in report.boards})),
        )

    async def publish_array(self, values: Any) -> None:
        """Publish probabilities (float64, one per cell) on every output topic."""
        for _, publication in self._outputs:
            await publication.publish({"layout": self._layout, "data": values})


def _sent(publication: Publication, message: dict[str, Any]) -> bool:
    """Send a message if the server accepts the message at once. Return whether it was sent."""
    try:
        publication.publish_nowait(message)
    except (DisconnectedError, SlowPeerError):
        return False
    return True
