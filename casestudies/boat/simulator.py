"""Simulator instead of Gazebo. A boat sails by itself, or a user drives or drags it. Its readings are published.

    /cmd_vel ────────────┐
    /boat/set_pose ──────┼─▶ Boat ─▶ /boat/true_pose, /boat/imu, /boat/raw
    services /boat/... ──┘

The boat publishes at each step, and also at once after a new pose or a call of a service.
"""

import asyncio
import contextlib
import math
import random
import time
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from casestudies import DEFAULT_URI, Seed, Uri
from casestudies.boat.sensors import (
    ARRAY_TYPE,
    BEACON_NAMES,
    BEACONS,
    BEACONS_TOPIC,
    BEACONS_TYPE,
    BEARING_NAMES,
    BEARING_SIGMA,
    COMPASS_TOPIC,
    COMPASS_TYPE,
    DISTANCE_NAMES,
    DRIVE_TOPIC,
    DRIVE_TYPE,
    LONGEST_DISTANCE,
    MAP_FRAME,
    MAP_HIGH,
    MAP_LOW,
    RAW_TOPIC,
    RAW_TYPE,
    SENSOR_NAMES,
    SET_POSE_TOPIC,
    TRUE_POSE_TOPIC,
    TRUE_POSE_TYPE,
    BadNumberError,
    beacon_markers,
    bearing,
    compass,
    distance,
    distance_sigma,
    read_drive,
    read_set_pose,
    readings_message,
    true_pose,
)
from terminal.command_line import CommandLine
from terminal.output import say, warn
from terminal.signals import run_async

if TYPE_CHECKING:
    from bridge.client import Ros

SWITCHES: Final = {
    "sail": ("the boat sails along its waypoints", "the boat lies still"),
    "noise": ("readings have the model's noise", "readings have no noise"),
    **{
        f"{name}/works": (f"{name} works", f"{name} is out of order: its distance and bearing are random")
        for name in BEACON_NAMES
    },
    **{f"{name}/plugged": (f"{name} is plugged in", f"{name} is unplugged") for name in SENSOR_NAMES},
}
"""The switches by name, each with a sentence for on and for off.

A switch is a service `/boat/NAME`. At the start, all switches are on.
"""
_SWITCH_TYPE = "std_srvs/SetBool"
_SHORE = 2.0  # waypoints are at least this far from the map's edge
# Minimum number of seconds before a change causes another reading: a mouse moves 1000 times a second.
_SHORTEST = 0.02
# A larger message on the topics that move the boat is neither a pose nor a velocity, and is discarded.
_POSE_BYTES = 65_536
DRIVE_TIMEOUT: Final = 1.0
"""Seconds until the boat stops after its last velocity command. Robots have a similar timeout."""


class Boat:
    """A simulated boat with its sensors, and the beacons (thesis 4.1). The boat starts in the middle of the map.

    Boats with equal seeds and equal switches sail the same route and measure the same readings.

    Attributes:
        heading: Direction of the bow, in radians counter-clockwise from the x axis.
        switches: The state of each of `SWITCHES`, True for on. The methods `put` and `drive` turn `sail` off.
        changed: Event that is set when somebody moves the boat or sets a switch. Publishing the next reading clears
            the event.
    """

    def __init__(self, seed: int, speed: float) -> None:
        """Put the boat in the middle of the map. The boat's top speed is `speed`, in map units per second."""
        self._random = random.Random(seed)
        self._speed = speed
        self.x = (MAP_LOW + MAP_HIGH) / 2
        self.y = (MAP_LOW + MAP_HIGH) / 2
        self.heading = 0.0
        # The velocity of the last `drive` (map units and radians per second), and for how many seconds it still holds.
        self._forward = self._turn = self._driven = 0.0
        self._waypoint = self._next_waypoint()
        self.switches = dict.fromkeys(SWITCHES, True)
        self.changed = asyncio.Event()

    def put(self, x: float, y: float) -> None:
        """Put the boat at (x, y) and stop it. If (x, y) is outside the map, use the nearest point of the map."""
        self._place(x, y)
        self._driven = 0.0
        self.switch("sail", on=False)

    def drive(self, forward: float, turn: float) -> None:
        """Move at a velocity for `DRIVE_TIMEOUT` seconds. `forward` is limited to the top speed; `turn` is in rad/s."""
        self._forward, self._turn = min(max(forward, -self._speed), self._speed), turn
        self._driven = DRIVE_TIMEOUT
        self.switches["sail"] = False

    def switch(self, name: str, *, on: bool) -> str:
        """Set one of `SWITCHES`, and return a sentence about the new state."""
        self.switches[name] = on
        self.changed.set()
        return SWITCHES[name][0 if on else 1]

    def sail(self, seconds: float) -> None:
        """Move the boat for `seconds`.

        If the switch `sail` is on, the boat follows its waypoints. If the switch is off, the boat moves at the velocity
        of the last `drive`, for at most `DRIVE_TIMEOUT` seconds after that `drive`.
        """
        if not self.switches["sail"]:
            driven = min(seconds, self._driven)
            self._driven -= driven
            middle = self.heading + self._turn * driven / 2
            self._place(
                self.x + self._forward * driven * math.cos(middle),
                self.y + self._forward * driven * math.sin(middle),
            )
            self.heading = math.remainder(self.heading + self._turn * driven, math.tau)
        left = self._speed * seconds if self.switches["sail"] else 0.0
        while left > 0:
            to_go = math.dist((self.x, self.y), self._waypoint)
            self.heading = math.atan2(self._waypoint[1] - self.y, self._waypoint[0] - self.x)
            if to_go > left:
                self.x += (self._waypoint[0] - self.x) * left / to_go
                self.y += (self._waypoint[1] - self.y) * left / to_go
                return
            left -= to_go
            self.x, self.y = self._waypoint
            self._waypoint = self._next_waypoint()

    def measure(self) -> tuple[float | None, ...]:
        """Return readings D1, D2, D3 in map units and B1, B2, B3 in radians, with the model's noise.

        An unplugged sensor has the reading None. A distance may be negative or too long, and a bearing may exceed
        one turn. The normaliser corrects these readings.
        """
        noise = 1.0 if self.switches["noise"] else 0.0
        measured: dict[str, float] = {}
        for name, at, beacon in zip(DISTANCE_NAMES, BEACONS, BEACON_NAMES, strict=True):
            true = distance(self.x, self.y, at)
            measured[name] = self._random.gauss(true, noise * distance_sigma(true))
            if not self.switches[f"{beacon}/works"]:
                measured[name] = self._random.uniform(0, LONGEST_DISTANCE)
        for name, at, beacon in zip(BEARING_NAMES, BEACONS, BEACON_NAMES, strict=True):
            degrees = self._random.gauss(bearing(self.x, self.y, at), noise * BEARING_SIGMA)
            if not self.switches[f"{beacon}/works"]:
                degrees = self._random.uniform(0, 360)
            measured[name] = math.radians(degrees)
        return tuple(measured[name] if self.switches[f"{name}/plugged"] else None for name in SENSOR_NAMES)

    def _place(self, x: float, y: float) -> None:
        self.x, self.y = min(max(x, MAP_LOW), MAP_HIGH), min(max(y, MAP_LOW), MAP_HIGH)

    def _next_waypoint(self) -> tuple[float, float]:
        low, high = MAP_LOW + _SHORE, MAP_HIGH - _SHORE
        return self._random.uniform(low, high), self._random.uniform(low, high)


async def simulate(
    uri: str,
    *,
    boat: Boat,
    rate: float,
    topic: str = RAW_TOPIC,
    array: bool = False,
    count: int | None = None,
) -> None:
    """Sail the boat and publish `count` readings. If `count` is None, sail until cancelled.

    Each step publishes first the true pose, then the compass, then the readings, all with the same stamp. The readings
    on `topic` are a `boat_msgs/Raw`, or with `array` a std_msgs/Float64MultiArray. If somebody moves the boat or sets a
    switch, readings are also published at once, between steps. During a lost connection, the boat sails on. Raises a
    BridgeError if no server answers at the URI.
    """
    from bridge.stamps import header
    from casestudies.topics import LossyPublication, connected, report_refused

    async with (
        connected("boat-simulator", "a reading was published", uri) as (ros, readiness),
        contextlib.AsyncExitStack() as at_the_end,
    ):
        ros_version = await ros.detect_ros_version()
        poses = LossyPublication(await ros.advertise(TRUE_POSE_TOPIC, TRUE_POSE_TYPE))
        headings = LossyPublication(await ros.advertise(COMPASS_TOPIC, COMPASS_TYPE))
        type_ = ARRAY_TYPE if array else RAW_TYPE
        readings = LossyPublication(await ros.advertise(topic, type_))
        for work in (
            report_refused(ros, topic, type_),
            _show_beacons(ros),
            _follow(ros, SET_POSE_TOPIC, TRUE_POSE_TYPE, lambda message: boat.put(*read_set_pose(message))),
            _follow(ros, DRIVE_TOPIC, DRIVE_TYPE, lambda message: boat.drive(*read_drive(message))),
            _serve_switches(ros, boat),
        ):
            at_the_end.callback(asyncio.create_task(work).cancel)
        due = time.monotonic()  # time of the next step, which a change of the boat does not delay
        changed = False
        published = 0
        while count is None or published < count:
            boat.changed.clear()
            head = header(time.time_ns(), MAP_FRAME, ros_version)
            await poses.publish(true_pose(boat.x, boat.y, head, boat.heading))
            await headings.publish(compass(boat.heading, head))
            if await readings.publish(readings_message(boat.measure(), head, array=array)):
                readiness.record()
            published += 1
            if not changed:
                boat.sail(1 / rate)
                due += 1 / rate
            changed = await _is_changed_before(due, boat)


async def _is_changed_before(due: float, boat: Boat) -> bool:
    """Wait until somebody changes the boat, at most until `due` (monotonic seconds); return whether somebody did."""
    try:
        async with asyncio.timeout(due - time.monotonic()):
            await asyncio.sleep(_SHORTEST)
            await boat.changed.wait()
    except TimeoutError:
        return False
    return True


async def _show_beacons(ros: "Ros") -> None:
    """Publish the beacons as latched markers, so that later subscribers also receive the markers."""
    from bridge.stamps import header
    from casestudies.topics import LossyPublication

    markers = LossyPublication(await ros.advertise(BEACONS_TOPIC, BEACONS_TYPE, latch=True))
    await markers.publish(beacon_markers(header(time.time_ns(), MAP_FRAME, ros.ros_version)))


async def _follow(ros: "Ros", topic: str, type_: str, take: Callable[[dict[str, Any]], None]) -> None:
    """Move the boat as the messages of a topic say; report the first unusable value of each field."""
    from bridge.errors import TopicLeftOutError

    reported: set[str] = set()
    messages = ros.subscribe(topic, type_, queue_size=1, max_bytes=_POSE_BYTES)
    # a message that is too large for the connection ends the topic; the client has warned, and the boat sails on
    with contextlib.suppress(TopicLeftOutError):
        async for message in messages:
            try:
                take(message.msg)
            except BadNumberError as error:
                if error.field not in reported:
                    warn(f"a message on {topic} is refused: {error}")
                    reported.add(error.field)


async def _serve_switches(ros: "Ros", boat: Boat) -> None:
    """Serve the switches, and warn if the server does not know their type."""
    from casestudies.topics import SETTLED_S

    def handler(name: str) -> Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]:
        async def handle(request: dict[str, Any]) -> dict[str, Any]:
            on = request.get("data")
            if not isinstance(on, bool):
                return {"success": False, "message": "`data` must be true or false, so nothing is changed"}
            return {"success": True, "message": boat.switch(name, on=on)}

        return handle

    statuses = len(ros.statuses)
    for name in SWITCHES:
        await ros.advertise_service(f"/boat/{name}", _SWITCH_TYPE, handler(name))
    await asyncio.sleep(SETTLED_S)
    known = await ros.service_type("/boat/sail")
    # a server without rosapi may have sent its refusals as statuses
    if known == "" or (known is None and len(ros.statuses) > statuses):
        warn(
            f"the server does not offer the boat's switches, services of type {_SWITCH_TYPE}: does it have std_srvs? "
            "the boat sails on without them"
        )


app = CommandLine()


@app.command(epilog="`boat-simulator --uri ws://127.0.0.1:9090 --seed 7 --rate 10`")
def boat_simulator(
    seed: Seed,
    uri: Uri = DEFAULT_URI,
    rate: Annotated[float, typer.Option(min=0.01, max=10_000, help="Readings per second.")] = 10.0,
    topic: Annotated[str, typer.Option(help="Topic of the raw readings.", metavar="TOPIC")] = RAW_TOPIC,
    speed: Annotated[
        float, typer.Option(min=0.0, help="The boat's highest speed, in map units per second.")
    ] = 60.0,
    count: Annotated[int | None, typer.Option(min=1, help="Exit after this many readings.")] = None,
    array: Annotated[
        bool, typer.Option("--array", help="Publish std_msgs/Float64MultiArray instead of boat_msgs/Raw.")
    ] = False,
) -> int:
    """Sail a boat on its map, and publish noisy ranges and bearings.

    The true pose is published on /boat/true_pose. A velocity on /cmd_vel drives the boat, and a pose on /boat/set_pose
    moves the boat to that pose. Services below /boat/ switch noise, beacons and sensors.
    """
    say(f"boat-simulator: seed {seed}, {rate:g} readings a second on {topic}, {uri}")
    return run_async(simulate(uri, boat=Boat(seed, speed), rate=rate, topic=topic, array=array, count=count))


if __name__ == "__main__":
    app()
