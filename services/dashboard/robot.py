"""The dashboard's connections to the robot (topics and services) and to the stack (status sockets).

Lost connections are retried for ever, because the dashboard may start before the robot and outlive it.
"""

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from bridge.client import Publication, Ros, connect
from bridge.errors import BridgeError, NotRosbridgeError, TopicLeftOutError, UnreachableError
from bridge.stamps import header
from posteriors.axes import Axis, deployment_axes, state_in_words
from posteriors.errors import BadResultError
from posteriors.listening import posteriors
from posteriors.posterior import MAX_RESULT, SAMPLES_TOPIC, SAMPLES_TYPE, Posterior, read_samples
from posteriors.standard_messages import pose_at
from services.dashboard.feed import Feed, KeptFrame
from services.settings import Settings
from services.sockets.records import Outcome
from services.sockets.status import ask_stack
from terminal.connection import report_connection
from terminal.output import say, warn
from toolchain.deployment import Deployment, load_deployment
from toolchain.errors import ToolchainError

POSE_TYPE: Final = "geometry_msgs/PoseStamped"
SET_POSE_TOPIC: Final = "/boat/set_pose"
LANDMARKS_TOPIC: Final = "/boat/beacons"
LANDMARKS_TYPE: Final = "visualization_msgs/MarkerArray"
_WORLD: Final = "/boat/"
_SAIL: Final = "/boat/sail"
_SWITCHES: Final = frozenset({"sail", "noise", "works", "plugged"})
"""Last parts of the names of the ROS services that are switches of the simulated world."""
_RETRY: Final = 1.0
_ASK_EVERY: Final = 2.0
_STATUS_EVERY: Final = 1.0
_SAMPLES_EVERY_MS: Final = 500
_SAMPLES: Final = 8
"""Number of sampled states that are shown."""
_MAX_LINE: Final = 1000
_MAX_LANDMARKS: Final = 100
_MAX_SWITCHES: Final = 100
_MAX_NAME: Final = 100
_MAX_WARNINGS: Final = 20
"""Maximum number of warnings about unreadable messages. Each reason is reported once; reasons may be numerous."""
_QUEUE_SIZE: Final = 64


class WatchedRobot:
    """The data that the page receives over rosbridge and status sockets, and the calls that the page makes.

    Attributes:
        state: State of the connection in words.
        connected: Whether there is a connection.
        landmarks: x, y and name of each landmark.
        switches: Switches of the simulated world by service name, with the value last set here, at first True.
        can_set_pose: Whether the topic that moves the simulated boat has a subscriber.
        lost: Number of lost frames by reason, as counted by the processes of the stack.
        boards: Endpoint, state and image of each board.
        why: Sentences about processes that are not ready.
        samples: The last sampled states that a BM2 streamed, one line each, or empty without a stream.
    """

    def __init__(
        self,
        feed: Feed,
        settings: Settings,
        deployment: Deployment | None,
        *,
        uri: str,
        topic: str,
        truth: str,
    ) -> None:
        self._feed = feed
        self._settings = settings
        self._uri = uri
        self._topic = topic
        self._truth = truth
        # The name of the flag's deployment: frames of others are ignored.
        self._only = deployment.name if deployment else None
        # The deployment of the flag, or of the master on this machine, whose status names its folder.
        self._deployment = deployment
        self._folder = ""
        self._axes: tuple[Axis, ...] = tuple(deployment_axes(deployment)) if deployment else ()
        self.state = f"connecting to {uri}"
        self.connected = False
        self.landmarks: list[tuple[float, float, str]] = []
        self.switches: dict[str, bool] = {}
        self.can_set_pose = False
        self.lost: dict[str, int] = {}
        self.boards: list[tuple[str, str, str]] = []
        self.why: list[str] = []
        self.samples = ""
        # The open connection, and its publication of poses; None while there is none.
        self._ros: Ros | None = None
        self._poses: Publication | None = None
        # The reasons of unreadable messages that were already reported.
        self._warned: set[str] = set()

    # Following

    async def follow(self) -> None:
        """Follow the topics until cancelled. If the server is not reachable, retry every second.

        Raises:
            UsageError: The URI or a topic cannot be used.
        """
        report = report_connection(self._uri)

        def on_state(state: str, reason: str) -> None:
            self._set_state(state, reason)
            report(state, reason)

        said = ""
        while True:
            try:
                async with connect(
                    self._uri,
                    connect_timeout=self._settings.connect_timeout,
                    ca_file=self._settings.ca,
                    ros_version=self._settings.ros_version,
                    on_state=on_state,
                    max_size=MAX_RESULT,
                ) as ros:
                    self._ros, said = ros, ""
                    await self._follow(ros)
            except (UnreachableError, NotRosbridgeError) as error:
                self._set_state("waiting", str(error))
                if not said:
                    say(f"dashboard: waiting for rosbridge at {self._uri} ({error})")
                said = "said"
                await asyncio.sleep(_RETRY)
            finally:
                self._ros = self._poses = None

    async def _follow(self, ros: Ros) -> None:
        def take_truth(message: dict[str, Any]) -> None:
            self._feed.truth = _point(message.get("pose")) or self._feed.truth

        def take_landmarks(message: dict[str, Any]) -> None:
            self.landmarks = read_landmarks(message)

        async def follow(
            topic: str, kind: str, take: Callable[[dict[str, Any]], None], *, every_ms: int = 0
        ) -> None:
            # the client has warned of a message that is too large; the page does without the topic
            with suppress(TopicLeftOutError):
                newest = ros.subscribe(
                    topic, kind, queue_size=1, throttle_rate=every_ms, queue_length=1 if every_ms else 0
                )
                async for message in newest:
                    take(message.msg)

        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._follow_frames(ros))
                tasks.create_task(self._ask_about_world(ros))
                tasks.create_task(follow(self._truth, POSE_TYPE, take_truth))
                tasks.create_task(follow(LANDMARKS_TOPIC, LANDMARKS_TYPE, take_landmarks))
                # more samples than that nobody can read
                samples = follow(SAMPLES_TOPIC, SAMPLES_TYPE, self._take_samples, every_ms=_SAMPLES_EVERY_MS)
                tasks.create_task(samples)
        except ExceptionGroup as failed:  # such as a topic that has two types
            raise failed.exceptions[0] from None

    def _set_state(self, state: str, reason: str) -> None:
        self.connected = state == "connected"
        self.state = f"{state}: {self._uri}" + (f" ({reason})" if reason and not self.connected else "")
        self._feed.changed()

    async def _follow_frames(self, ros: Ros) -> None:
        # reports of other deployments are read too: only the report tells from which deployment a posterior is
        async with posteriors(ros, topic=self._topic, queue_size=_QUEUE_SIZE) as frames:
            counted = 0
            while True:
                try:
                    frame = await frames.next_frame(None)
                    report = frame.report if isinstance(frame, Posterior) else frame
                    if report is not None and self._only not in {None, report.deployment}:
                        self._feed.add_loss("of another deployment")
                    else:
                        self._feed.add(frame, time.monotonic())
                except BadResultError as error:
                    self._feed.add_loss("unreadable message")
                    if len(self._warned) < _MAX_WARNINGS and (why := str(error)) not in self._warned:
                        self._warned.add(why)
                        warn(why)
                # posteriors that were announced and never arrived, and those that came too fast for this process
                gone = frames.announced_only + frames.lost
                for _ in range(gone - counted):
                    self._feed.add_loss("not received by the page")
                counted = gone

    async def _ask_about_world(self, ros: Ros) -> None:
        """Ask repeatedly which services and topics of the simulated world exist: a simulator may start later."""
        while True:
            if (names := await ros.services()) is not None:
                found = sorted(each for each in names if _is_switch(each))[:_MAX_SWITCHES]
                self.switches = {name: self.switches.get(name, True) for name in found}
            if (topics := await ros.topics()) is not None:
                self.can_set_pose = SET_POSE_TOPIC in topics
            if self.can_set_pose and self._poses is None:
                self._poses = await ros.advertise(SET_POSE_TOPIC, POSE_TYPE, queue_size=1)
            await asyncio.sleep(_ASK_EVERY)

    # The stack

    async def watch_stack(self, directory: Path) -> None:
        """Read the status of all processes of the stack on this computer every second, until cancelled."""
        while True:
            status = await ask_stack(directory, shared=self._settings.run_directory is None)
            self.why = status.why
            lost: Counter[str] = Counter()
            folder = ""
            for process in status.processes:
                if process.name == "pcie-app":
                    self.boards = [(each.endpoint, each.state, each.image) for each in process.boards]
                if process.name == "master":
                    folder = process.folder
                # the master also counts what the publisher loses
                lost |= Counter(process.frames.lost if process.frames else {})
            # these come as frames with their reason, which the feed counts
            del lost[Outcome.NO_POSTERIOR]
            self.lost = lost
            if folder and folder != self._folder and self._settings.deployment is None:
                self._folder = folder
                await self._learn_axes(Path(folder))
            await asyncio.sleep(_STATUS_EVERY)

    async def _learn_axes(self, folder: Path) -> None:
        """Read the units from the master's deployment folder on this host. Without units, cells are only indices."""
        try:
            deployment = await asyncio.to_thread(load_deployment, folder, images=False)
        except (ToolchainError, OSError) as error:
            warn(f"dashboard: no units, because the master's deployment cannot be read: {error}")
            return
        self._deployment, self._axes = deployment, tuple(deployment_axes(deployment))
        self._feed.changed()

    def axes_for(self, frame: KeptFrame) -> tuple[Axis, ...]:
        """Return the axes of a frame's posterior, or no axes if the frame is from another deployment.

        The units of another deployment may differ.
        """
        if self._deployment_of(frame) is None or frame.values is None:
            return ()
        ours = [(axis.label, axis.size) for axis in self._axes]
        return self._axes if ours == list(zip(frame.labels, frame.values.shape, strict=True)) else ()

    def words_for(self, frame: KeptFrame) -> dict[str, tuple[str, tuple[str, ...]]]:
        """Return the unit and the states of each variable by name, or {} if the deployment of the frame is unknown."""
        deployment = self._deployment_of(frame)
        known = deployment.variables if deployment is not None else ()
        return {each.name: (each.unit, each.states) for each in known}

    def _take_samples(self, message: dict[str, Any]) -> None:
        """Keep the last states of a message as text; in hexadecimal if the machine is unknown."""
        deployment = self._deployment_of(self._feed.newest)
        dimensions = deployment.state_dimensions if deployment is not None else ()
        states: list[list[int]] = []
        with suppress(BadResultError):  # another program publishes there
            found = read_samples(message, [each.size for each in dimensions], _SAMPLES)
            # the words of an unknown state may be millions, and more than these are never shown
            states = (found if dimensions else found[:, -_MAX_LINE:]).tolist()
        self.samples = "\n".join(state_in_words(dimensions, state)[:_MAX_LINE] for state in states)

    def _deployment_of(self, frame: KeptFrame | None) -> Deployment | None:
        deployment, report = self._deployment, frame.report if frame is not None else None
        same = deployment is None or report is None or report.deployment == deployment.name
        return deployment if same else None

    # Asking

    def set_pose(self, x: float, y: float) -> None:
        """Move the simulated boat to (x, y). Without a connection or a subscriber, do nothing."""
        ros, poses = self._ros, self._poses
        if ros is None or poses is None or not self.can_set_pose or not math.isfinite(x + y):
            return
        if _SAIL in self.switches:  # a boat that is put somewhere lies still
            self.switches[_SAIL] = False
        head = header(time.time_ns(), "map", ros.ros_version or 1)
        # while the server is away or slow, poses are dropped: the next one replaces them
        with suppress(BridgeError):
            poses.publish_nowait({"header": head, "pose": pose_at(x, y)})

    async def switch(self, name: str, on: bool) -> str:
        """Set a switch of the simulated world to `on`. Return why this failed, or an empty string on success."""
        if self._ros is None or name not in self.switches:
            return "this switch is not there now"
        try:
            await self._ros.call(name, {"data": on})
        except BridgeError as error:
            return str(error)
        self.switches[name] = on
        self._feed.changed()
        return ""


def _is_switch(name: str) -> bool:
    return name.startswith(_WORLD) and name.rpartition("/")[2] in _SWITCHES


def _point(pose: Any) -> tuple[float, float] | None:
    position = pose.get("position") if isinstance(pose, Mapping) else None
    if not isinstance(position, Mapping):
        return None
    try:
        x, y = float(position["x"]), float(position["y"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return (x, y) if math.isfinite(x) and math.isfinite(y) else None


def read_landmarks(message: Mapping[str, Any]) -> list[tuple[float, float, str]]:
    """Return x, y and the name of each marker with finite coordinates."""
    markers = message.get("markers")
    found = [
        (*point, str(marker.get("text") or marker.get("id") or "")[:_MAX_NAME])
        for marker in (markers if isinstance(markers, list) else ())
        if isinstance(marker, Mapping) and (point := _point(marker.get("pose"))) is not None
    ]
    return found[:_MAX_LANDMARKS]
