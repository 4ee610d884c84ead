"""Topics for robot tools, published after the results.

    publish_now ──▶ offer ──next turn of the loop, or a timer──▶ _send ──▶ /bm/counts, /bm/posterior, /bm/pose, /bm/decision
    status sockets ──once a second──▶ keep_reporting ──────────▶ /diagnostics

A result never waits for a message on these topics. If frames come too fast, only the newest frame is sent. An error
only causes a warning.
"""

import asyncio
import math
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, Final, Literal, NoReturn

from bridge.client import Publication, Ros, State
from bridge.errors import DisconnectedError, SlowPeerError, TypeConflictError
from machines.kind import Inference
from posteriors.frame_report import FRAME_TYPE
from posteriors.standard_messages import (
    Level,
    Plane,
    counts_message,
    decision_statuses,
    diagnostics,
    grid_message,
    has_coordinates,
    pose_message,
    status,
)
from services.pipeline.clock import Clock
from services.pipeline.connections import AdvertisedTopic
from services.settings import Settings
from services.sockets.records import Publish
from services.sockets.status import ProcessStatus, SilentProcess, StackStatus, ask_stack
from terminal.logs import get_logger
from toolchain.deployment import Deployment

INTERVAL: Final = 0.1
"""Minimum number of seconds between two messages of a topic. Each message is work for the hub and delays readings."""
_HEALTH_INTERVAL: Final = 1.0

_TYPES: Final = {
    "counts": ("/bm/counts", "std_msgs/UInt32MultiArray"),
    "posterior": ("/bm/posterior", "nav_msgs/OccupancyGrid"),
    "pose": ("/bm/pose", "geometry_msgs/PoseWithCovarianceStamped"),
    "decision": ("/bm/decision", FRAME_TYPE),
    "diagnostics": ("/diagnostics", FRAME_TYPE),
}
"""Names and types of the topics, by their keys in the section `[topics]` of a deployment."""

_Make = Callable[[], dict[str, Any] | None]
"""Function that makes a message, or nothing."""


class StandardTopics:
    """The topics for robot tools on one server.

    Attributes:
        advertised: The topics that are published. The list is empty until `open` has advertised the topics.
        refused: Names of the topics that the server refused at the last check. Nothing is published on these topics.
    """

    def __init__(self, settings: Settings, deployment: Deployment, role: str) -> None:
        self._settings = settings
        self._deployment = deployment
        self._log = get_logger(role, settings.log_level)
        # From `open` on: the server, the form of its stamps, and publications by key; a faulty one is removed.
        self._ros: Ros | None = None
        self._ros_version: Literal[1, 2] = 2
        self._publications: dict[str, Publication] = {}
        # Of a deployment whose grid or pose is published.
        self._plane: Plane | None = None
        self._clock = Clock(simulated=settings.use_sim_time)
        # The last frame with the tick (ns) of its publication, and whether it still has to be sent; `_timer`
        # then calls `_send`.
        self._last: tuple[Publish, Inference, int] | None = None
        self._waiting = False
        self._timer: asyncio.Handle | None = None
        # When frames were sent last (monotonic, s); the clock of a machine that has just booted is near 0.
        self._sent_at = -math.inf
        # The last status of the run's processes, if there is a run directory, and the levels published last.
        self._stack: StackStatus | None = None
        self._levels: list[int] = []
        self.advertised: list[AdvertisedTopic] = []
        self.refused: set[str] = set()

    async def open(self, ros: Ros, uri: str, ros_version: Literal[1, 2]) -> None:
        """Advertise the topics of the deployment."""
        self._ros, self._ros_version = ros, ros_version
        for key in self._chosen():
            topic, type_name = _TYPES[key]
            try:
                self._publications[key] = await ros.advertise(topic, type_name, queue_size=1)
            except TypeConflictError:
                self._log.info(f"{topic} is not published for robot tools: the results have this topic")
                continue
            self.advertised.append(AdvertisedTopic(ros, uri, topic, type_name, key))

    def _chosen(self) -> Iterator[str]:
        """Yield the keys of the topics to publish; log why a topic that is switched on cannot be published."""
        dimensions = self._deployment.result_dimensions
        is_map = has_coordinates(dimensions)
        for key, wanted in dict(self._deployment.topics).items():
            of_plane = key in {"posterior", "pose"}
            if wanted is False or (wanted is None and of_plane and not is_map):
                continue
            if of_plane:
                try:
                    self._plane = Plane.of(dimensions, square=key == "posterior")
                except ValueError as why:
                    self._log.info(f"{_TYPES[key][0]} is not published: {why}")
                    continue
            yield key

    def offer(self, publish: Publish, inference: Inference) -> None:
        """Schedule the messages of a frame. A newer frame replaces a frame whose messages have not been sent yet."""
        self._last, self._waiting = (publish, inference, self._clock.tick()), True
        if self._timer is None and self._publications:
            loop = asyncio.get_running_loop()
            wait = self._sent_at + INTERVAL - time.monotonic()
            self._timer = loop.call_soon(self._send) if wait <= 0 else loop.call_later(wait, self._send)

    def flush(self) -> None:
        """Send the messages of a waiting frame now, and then the health of boards and services.

        Called just before the run ends.
        """
        if self._timer is not None:
            self._timer.cancel()
        self._send()
        if self._timer is not None:  # the server is slow
            self._timer.cancel()
        self._publish("diagnostics", self._health)

    def _send(self) -> None:
        self._timer, last = None, self._last
        if not self._waiting or last is None or self._ros is None or self._ros.state is not State.CONNECTED:
            return
        if any(each.must_wait for each in self._publications.values()):
            self._timer = asyncio.get_running_loop().call_later(INTERVAL, self._send)
            return
        self._waiting, self._sent_at = False, time.monotonic()
        with self._ros.together():
            for key, make in self._messages(last[0], last[1]).items():
                self._publish(key, make)

    def _messages(self, publish: Publish, inference: Inference) -> Mapping[str, _Make]:
        """Return the functions that make the messages of a frame."""
        make: dict[str, _Make] = {
            "counts": partial(counts_message, inference.boards),
            "decision": partial(self._decision, publish, inference),
        }
        if inference.posterior is not None and self._plane is not None:
            of_plane = inference.posterior, self._plane, publish.stamp_ns, self._ros_version
            make |= {"posterior": partial(grid_message, *of_plane), "pose": partial(pose_message, *of_plane)}
        return make | {"diagnostics": self._changed_health}

    def _publish(self, key: str, make: _Make) -> None:
        """Publish the message that `make` returns, if any; after an unexpected error, stop publishing the topic."""
        publication = self._publications.get(key)
        if publication is None or publication.topic in self.refused:
            return
        try:
            if (message := make()) is not None:
                publication.publish_nowait(message)
        except (DisconnectedError, SlowPeerError):
            pass
        except Exception as error:
            del self._publications[key]
            self._log.warning(
                f"{publication.topic} is no longer published: {error!r}; results go on ({key} = false under [topics] "
                "switches it off)"
            )

    def _decision(self, publish: Publish, inference: Inference) -> dict[str, Any]:
        statuses = decision_statuses(
            inference.posterior,
            self._deployment,
            why="" if _is_sound(inference) else inference.outcome,
            number=publish.result.number,
            age_ms=self._age_ns(publish) / 1e6,
        )
        return diagnostics(statuses, publish.stamp_ns, "bm", self._ros_version)

    def _age_ns(self, publish: Publish) -> int:
        if self._clock.simulated:
            return max(self._clock.time_ns() - publish.stamp_ns, 0)
        return time.monotonic_ns() - publish.received_tick

    async def follow_clock(self) -> None:
        """Follow the simulated time until cancelled."""
        if self._ros is not None:
            await self._clock.follow(self._ros)

    # --- health --------------------------------------------------------------------------------

    async def keep_reporting(self) -> NoReturn:
        """Publish the health of boards and services once a second."""
        await self._ask_stack()
        while True:
            if self._ros is not None and self._ros.state is State.CONNECTED:
                self._publish("diagnostics", self._health)
            # asking a silent process takes a second, which must not delay the next message
            await asyncio.gather(asyncio.sleep(_HEALTH_INTERVAL), self._ask_stack())

    async def _ask_stack(self) -> None:
        directory = self._settings.run_directory
        if directory is not None and "diagnostics" in self._publications:
            self._stack = await ask_stack(directory)

    def _health(self) -> dict[str, Any]:
        boards = list(self._boards())
        self._levels = [each["level"] for each in boards]
        return diagnostics([*boards, *self._services()], self._clock.time_ns(), "", self._ros_version)

    def _changed_health(self) -> dict[str, Any] | None:
        """Return the message on `/diagnostics` if a board's level has changed since the last one; None otherwise."""
        return None if [each["level"] for each in self._boards()] == self._levels else self._health()

    def _boards(self) -> Iterator[dict[str, Any]]:
        """Yield the status of each board: its result in the last frame, and its state according to pcie-app."""
        deployment = self._deployment
        processes = self._stack.processes if self._stack else []
        known = {each.index: each for process in processes for each in process.boards}
        reasons = deployment.machine.kind.reasons
        silence_s = self._settings.ready_timeout
        for at, board in enumerate(deployment.boards):
            level, message = Level.STALE, "no frame yet"
            values: dict[str, object] = {"image": board.image_hash}
            if self._last is not None:
                publish, inference, tick = self._last
                result = inference.boards[at]
                level, message = Level.OK if _is_sound(inference) else Level.WARN, reasons[result.reason]
                values |= {"frame": publish.result.number, "cycles": result.cycles, "reason": message}
                if self._clock.tick() - tick > silence_s * 1e9:
                    level, message = Level.STALE, f"no frame for {silence_s:g} s"
            if there := known.get(at):
                values |= {"endpoint": there.endpoint, "state": there.state, "restarts": there.restarts}
                if there.why:
                    level, message = Level.ERROR, there.why
            yield status(f"board {at}", level, message, f"board{at}", values)

    def _services(self) -> Iterator[dict[str, Any]]:
        """Yield the status of each other process of the run."""
        stack = self._stack
        boards = {f"board{at}" for at in range(len(self._deployment.boards))}
        every: list[ProcessStatus | SilentProcess] = [*stack.processes, *stack.silent] if stack else []
        for process in every:
            if process.name in boards:
                continue
            level, values = Level.STALE, {}
            if isinstance(process, ProcessStatus):
                level = Level.ERROR if not process.alive else Level.OK if process.ready else Level.WARN
                values = _numbers(process)
            yield status(process.name, level, process.why, process.name, values)


def _is_sound(inference: Inference) -> bool:
    """Return whether there is a posterior, and no board ended early."""
    return inference.posterior is not None and "ended_early" not in inference.details


def _numbers(process: ProcessStatus) -> dict[str, object]:
    names = ("pid", "version", "uptime_s", "cpu_percent", "memory_bytes")
    values = {name: getattr(process, name) for name in names}
    if (frames := process.frames) is not None:
        values |= {"completed": frames.completed, "per_second": frames.rate}
        values |= {f"lost: {reason}": count for reason, count in frames.lost.items()}
    return values
