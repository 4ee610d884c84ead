"""Simulator in place of Gazebo: a boat that sails between waypoints and publishes its sensors' readings."""

import asyncio
import math
import random
import time
from typing import Annotated

import typer

from casestudies import DEFAULT_URI, Uri
from casestudies.boat.sensors import (
    ARRAY_TYPE,
    BEACONS,
    BEARING_SIGMA,
    MAP_FRAME,
    MAP_HIGH,
    MAP_LOW,
    RAW_TOPIC,
    RAW_TYPE,
    TRUE_POSE_TOPIC,
    TRUE_POSE_TYPE,
    bearing,
    distance,
    distance_sigma,
    readings_message,
    true_pose,
)
from terminal.command_line import CommandLine
from terminal.connection import report_connection
from terminal.output import say
from terminal.signals import run_async

_SHORE = 2.0  # waypoints are at least this far from the map's edge
_SEEDS = 1_000_000


class Boat:
    """A boat that starts in the middle of the map and is driven along random waypoints (thesis 4.1).

    Two boats with the same seed sail the same route and measure the same readings.
    """

    def __init__(self, seed: int, speed: float) -> None:
        """Put the boat in the middle of the map; `speed` is in map units per second."""
        self._random = random.Random(seed)
        self._speed = speed
        self.x = (MAP_LOW + MAP_HIGH) / 2
        self.y = (MAP_LOW + MAP_HIGH) / 2
        self._waypoint = self._next_waypoint()

    def sail(self, seconds: float) -> None:
        """Sail along the waypoints for that many seconds."""
        left = self._speed * seconds
        while left > 0:
            to_go = math.dist((self.x, self.y), self._waypoint)
            if to_go > left:
                self.x += (self._waypoint[0] - self.x) * left / to_go
                self.y += (self._waypoint[1] - self.y) * left / to_go
                return
            left -= to_go
            self.x, self.y = self._waypoint
            self._waypoint = self._next_waypoint()

    def measure(self) -> tuple[float, ...]:
        """Return noisy readings D1, D2, D3 (map units) and B1, B2, B3 (radians), with the model's noise.

        A distance may be negative or too long, and a bearing outside one turn; the normaliser corrects both.
        """
        ranges = [distance(self.x, self.y, beacon) for beacon in BEACONS]
        distances = [self._random.gauss(true, distance_sigma(true)) for true in ranges]
        bearings = [
            math.radians(self._random.gauss(bearing(self.x, self.y, beacon), BEARING_SIGMA))
            for beacon in BEACONS
        ]
        return (*distances, *bearings)

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
    """Sail and publish `count` readings, or publish until cancelled.

    Each step publishes the true pose and then the readings, with the same stamp, on `topic`: `boat_msgs/Raw`, or with
    `array` std_msgs/Float64MultiArray. While the server is away the boat sails on.

    Raises:
        BridgeError: No rosbridge server answers at the URI.
    """
    from bridge.client import connect
    from bridge.stamps import header
    from casestudies.topics import LossyPublication, Readiness, report_refused, serve_readiness

    readiness = Readiness("a reading was published")
    async with (
        serve_readiness("boat-simulator", readiness),
        connect(uri, retry=True, on_state=report_connection(uri)) as ros,
    ):
        ros_version = await ros.detect_ros_version()
        poses = LossyPublication(await ros.advertise(TRUE_POSE_TOPIC, TRUE_POSE_TYPE))
        type_ = ARRAY_TYPE if array else RAW_TYPE
        readings = LossyPublication(await ros.advertise(topic, type_))
        refused = asyncio.ensure_future(report_refused(ros, topic, type_))
        begin = time.monotonic()
        step = 0
        while count is None or step < count:
            head = header(time.time_ns(), MAP_FRAME, ros_version)
            await poses.publish(true_pose(boat.x, boat.y, head))
            if await readings.publish(readings_message(boat.measure(), head, array=array)):
                readiness.record()
            step += 1
            boat.sail(1 / rate)
            await asyncio.sleep(begin + step / rate - time.monotonic())
        refused.cancel()


app = CommandLine()


@app.command(epilog="`boat-simulator --uri ws://127.0.0.1:9090 --seed 7 --rate 10`")
def boat_simulator(
    uri: Uri = DEFAULT_URI,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of route and noise.", show_default="one is chosen and printed"),
    ] = None,
    rate: Annotated[float, typer.Option(min=0.01, max=10_000, help="Readings per second.")] = 10.0,
    topic: Annotated[str, typer.Option(help="Topic of the raw readings.", metavar="TOPIC")] = RAW_TOPIC,
    speed: Annotated[float, typer.Option(min=0.0, help="The boat's speed, in map units per second.")] = 60.0,
    count: Annotated[int | None, typer.Option(min=1, help="Exit after this many readings.")] = None,
    array: Annotated[
        bool, typer.Option("--array", help="Publish std_msgs/Float64MultiArray instead of boat_msgs/Raw.")
    ] = False,
) -> int:
    """Sail a boat about its map: publish noisy ranges and bearings, and the true pose on /boat/true_pose."""
    chosen = random.SystemRandom().randrange(_SEEDS) if seed is None else seed
    say(f"boat-simulator: seed {chosen}, {rate:g} readings a second on {topic}, {uri}")
    return run_async(
        simulate(uri, boat=Boat(chosen, speed), rate=rate, topic=topic, array=array, count=count)
    )


if __name__ == "__main__":
    app()
