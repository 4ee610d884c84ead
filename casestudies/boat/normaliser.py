"""Normaliser of the boat's raw readings to whole numbers in the machine's ranges (thesis chapter 4)."""

import asyncio
import math
from typing import Annotated

import typer

from casestudies import DEFAULT_URI, Uri
from casestudies.boat.sensors import (
    ARRAY_TYPE,
    DISTANCE_NAMES,
    LONGEST_DISTANCE,
    RAW_MSG,
    RAW_TOPIC,
    RAW_TYPE,
    SENSOR_NAMES,
    SENSORS_MSG,
    SENSORS_TOPIC,
    SENSORS_TYPE,
    BadNumberError,
    read_raw,
    readings_message,
)
from terminal.command_line import CommandLine
from terminal.output import say, warn
from terminal.signals import run_async


def normalise_distance(raw: float) -> int:
    """Return a distance in whole map units, rounded half up and clamped to 0..100."""
    return min(max(math.floor(raw + 0.5), 0), LONGEST_DISTANCE)


def normalise_bearing(raw: float) -> int:
    """Convert a bearing from radians to whole degrees 0..359, rounded half up."""
    return math.floor(math.degrees(raw) + 0.5) % 360


def normalise(raw: tuple[float | None, ...]) -> tuple[int | None, ...]:
    """Normalise readings in the order of `SENSOR_NAMES`. A missing reading is None, and stays None."""
    return tuple(
        None
        if value is None
        else normalise_distance(value)
        if name in DISTANCE_NAMES
        else normalise_bearing(value)
        for name, value in zip(SENSOR_NAMES, raw, strict=True)
    )


async def serve(uri: str, *, raw_topic: str, sensors_topic: str, array: bool) -> None:
    """Normalise messages until cancelled. Raises a BridgeError if no server answers at the URI.

    If a field is not a finite number, the message is dropped. Each different error is reported once. A missing reading
    stays missing.
    """
    from casestudies.topics import LossyPublication, connected, report_refused

    reported: set[str] = set()
    async with connected("boat-normaliser", "a reading was normalised", uri) as (ros, readiness):
        type_ = ARRAY_TYPE if array else SENSORS_TYPE
        sensors = LossyPublication(await ros.advertise(sensors_topic, type_))
        refused = asyncio.ensure_future(report_refused(ros, sensors_topic, type_))
        raw = ros.subscribe(raw_topic, ARRAY_TYPE if array else RAW_TYPE)
        async for message in raw:
            try:
                values, head = read_raw(message.msg, array=array)
            except BadNumberError as error:
                if str(error) not in reported:
                    warn(f"a message on {raw_topic} is dropped: {error}")
                    reported.add(str(error))
                continue
            if await sensors.publish(readings_message(normalise(values), head, array=array)):
                readiness.record()
        refused.cancel()


app = CommandLine()


@app.command(epilog="`boat-normaliser --uri ws://127.0.0.1:9090`")
def boat_normaliser(
    uri: Uri = DEFAULT_URI,
    raw_topic: Annotated[str, typer.Option(help="Topic of the raw readings.", metavar="TOPIC")] = RAW_TOPIC,
    sensors_topic: Annotated[
        str, typer.Option(help="Topic of the normalised readings.", metavar="TOPIC")
    ] = SENSORS_TOPIC,
    array: Annotated[
        bool, typer.Option("--array", help="std_msgs/Float64MultiArray in and out instead of boat_msgs.")
    ] = False,
    print_msg: Annotated[
        bool, typer.Option("--print-msg", help="Print the two .msg files of boat_msgs and exit.")
    ] = False,
) -> int:
    """Turn the boat's raw readings into whole numbers in range: distances 0..100, bearings 0..359 degrees."""
    if print_msg:
        print(f"{RAW_MSG}\n{SENSORS_MSG}", end="")
        return 0
    say(f"boat-normaliser: {raw_topic} to {sensors_topic}, {uri}")
    return run_async(serve(uri, raw_topic=raw_topic, sensors_topic=sensors_topic, array=array))


if __name__ == "__main__":
    app()
