"""Verification of the topics for robot tools, with Foxglove's readers and with rviz (see scripts/verify).

boat-simulator --> boat-normaliser --> hub <--> master with 4 boards
                                        |--JSON, cbor-raw--> Foxglove's client and readers, on Node (foxglove.mjs)
                                        `--cbor-raw--> this script --> ROS 1 node (ros_node.py) --> rviz on Xvfb
"""

import argparse
import asyncio
import base64
import json
import math
import os
import shutil
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

from bridge.client import connect
from bridge.errors import BridgeError
from bridge.names import ros2_type
from bridge.stamps import header, header_stamp_ns
from casestudies.boat.sensors import SET_POSE_TOPIC, TRUE_POSE_TYPE, true_pose
from posteriors.standard_messages import Level
from scripts.running.browser import Place
from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR, PRODUCT_LIMITS
from scripts.running.script import ROOT
from scripts.running.stand import PATIENCE, Stand, free_port, temporary_stand
from scripts.verifications.checks import CheckError, Tally
from scripts.verifications.installation import install_node_packages, install_programs
from services.errors import StackError
from terminal.errors import ProcessError

if TYPE_CHECKING:
    from PIL import Image

HERE: Final = Path(__file__).parent
PICTURES: Final = ROOT / "docs" / "pictures"
LIMIT: Final = 900.0 * FACTOR
"""Time limit of the verification, in seconds."""
MODULES: Final = "/usr/lib/python3/dist-packages"
PROGRAMS: Final = {
    "rviz": "rviz",
    "Xvfb": "xvfb",
    "rosmaster": "python3-rosmaster",
    f"{MODULES}/rospy": "python3-rospy",
    f"{MODULES}/geometry_msgs": "python3-geometry-msgs",
    f"{MODULES}/nav_msgs": "python3-nav-msgs",
}
PLACE: Final[Place] = (15.0, -12.0)
"""Place of the boat in the picture, in metres, chosen so that the whole posterior is on the map."""
NEAR: Final = 12.0
"""Maximum distance in metres from `PLACE` to the mean of a posterior that belongs to this place."""
SCALE: Final = 4.0
"""Pixels a metre in boat.rviz."""
BACKGROUND: Final = (48, 48, 48)
FEW: Final = 50
"""A row or column with at most this many pixels of the background's colour, such as in text, is outside the scene."""


class Scene(NamedTuple):
    """The running stack, its ROS version, and whether to draw pictures."""

    stand: Stand
    ros_version: str
    pictures: bool


async def grid_and_pose(stand: Stand) -> dict[str, tuple[str, bytes, dict[str, Any]]]:
    """Put the boat at `PLACE`, and return type, bytes and content of the grid and the pose of one frame there."""
    types = {"/bm/posterior": "nav_msgs/OccupancyGrid", "/bm/pose": "geometry_msgs/PoseWithCovarianceStamped"}
    store = get_typestore(Stores.ROS1_NOETIC)
    async with asyncio.timeout(2 * PATIENCE), connect(stand.uri, check_types=False) as ros:
        topics = {name: ros.subscribe(name, type_, compression="cbor-raw") for name, type_ in types.items()}
        await topics["/bm/pose"].next(timeout=PATIENCE)  # the boat advertises its services first
        await ros.call("/boat/noise", {"data": False})
        await (await ros.advertise(SET_POSE_TOPIC, TRUE_POSE_TYPE)).publish(
            true_pose(*PLACE, header(time.time_ns(), "map"))
        )
        found: dict[str, tuple[str, bytes, dict[str, Any]]] = {}
        stamps = dict.fromkeys(types, 0)
        while True:
            behind = min(stamps, key=lambda name: stamps[name])
            raw = (await topics[behind].next(timeout=PATIENCE)).raw
            read: Any = store.deserialize_ros1(raw, ros2_type(types[behind]))
            found[behind] = types[behind], raw, (message := asdict(read))
            stamps[behind] = header_stamp_ns(message) or 0
            if len(set(stamps.values())) == 1:
                mean = found["/bm/pose"][2]["pose"]["pose"]["position"]
                if math.dist((mean["x"], mean["y"]), PLACE) < NEAR:
                    return found


async def rviz(scene: Scene) -> None:
    """Check that rviz shows grid and pose."""
    from PIL import ImageGrab

    install_programs(PROGRAMS)
    stand, folder = scene.stand, scene.stand.folder
    found = await grid_and_pose(stand)
    messages = folder / "messages"
    lines = (f"{name} {type_} {base64.b64encode(raw).decode()}\n" for name, (type_, raw, _) in found.items())
    messages.write_text("".join(lines))
    port = free_port()
    screen = ("/usr/bin/Xvfb", "-displayfd", "1", "-screen", "0", "800x560x24", "-nolisten", "tcp")
    display = ":" + await stand.start("Xvfb", r"^\d+$", *screen)
    variables = {"DISPLAY": display, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    variables |= {"HOME": str(folder), "LIBGL_ALWAYS_SOFTWARE": "1"}
    ros = ("/usr/bin/env", *(f"{name}={value}" for name, value in variables.items()))
    # it says nothing, and a node waits for it
    await stand.start("rosmaster", "", *ros, "sh", "-c", f"echo; exec rosmaster --core -p {port}")
    await stand.start("node", "published", *ros, "/usr/bin/python3", str(HERE / "ros_node.py"), str(messages))
    await stand.start("rviz", "OGRE", *ros, "rviz", "-d", str(HERE / "boat.rviz"))
    flaw: str | None = ""
    try:
        async with asyncio.timeout(PATIENCE):
            while flaw is not None:
                await asyncio.sleep(0.5)
                picture = ImageGrab.grab(xdisplay=display)
                flaw = flaw_of(picture, found["/bm/posterior"][2], found["/bm/pose"][2]["pose"])
    except TimeoutError:
        raise CheckError(f"rviz shows something else: {flaw}") from None
    if scene.pictures:
        picture.quantize().save(PICTURES / "rviz.png", optimize=True)


def flaw_of(picture: "Image.Image", grid: dict[str, Any], pose: dict[str, Any]) -> str | None:
    """Return how the picture of rviz's window differs from grid and pose, or None if the picture is right."""
    pixels = np.asarray(picture.convert("RGB"), int)
    grey = (pixels == BACKGROUND).all(axis=2)
    down, across = (np.flatnonzero(grey.sum(axis=axis) > FEW) for axis in (1, 0))
    if not (down.size and across.size):
        return "no background"
    scene = pixels[down[0] : down[-1] + 1, across[0] : across[-1] + 1]
    painted = (scene != BACKGROUND).any(axis=2)
    cells = np.count_nonzero(grid["data"]) * (SCALE * grid["info"]["resolution"]) ** 2
    if not 0.85 < painted.sum() / cells < 1.15:
        return f"{painted.sum()} pixels are painted, and the grid has {cells:.0f}"
    red, green, blue = np.moveaxis(scene, 2, 0)
    if not ((red > 200) & (blue < 100)).any() or not ((blue > 200) & (red < 50)).any():
        return "the colours of probable and of improbable cells are not both there"
    rows, columns = np.nonzero(painted & (green > 8) & (green < 70))  # the grid has no green, axes have more
    (xx, xy), (_, yy) = np.reshape(pose["covariance"], (6, 6))[:2, :2]
    area = math.pi * math.sqrt(xx * yy - xy**2) * SCALE**2
    if not 0.75 < len(rows) / area < 1.25:
        return f"the ellipse has {len(rows)} pixels instead of {area:.0f}"
    height, width = painted.shape
    place = (columns.mean() - width / 2) / SCALE, (height / 2 - rows.mean()) / SCALE
    wanted = pose["pose"]["position"]["x"], pose["pose"]["position"]["y"]
    if math.dist(place, wanted) > 1.5:
        return f"the ellipse is at {place[0]:.1f}, {place[1]:.1f} instead of {wanted[0]:.1f}, {wanted[1]:.1f}"
    return None


def draw(last: dict[str, Any]) -> None:
    """Draw the topics that rviz does not show, from their `last` messages."""
    from matplotlib.figure import Figure

    counts = last["/bm/counts"]
    rows = np.reshape(counts["data"], (counts["layout"]["dim"][0]["size"], -1))
    figure = Figure((8, 4), layout="constrained")
    for board, axes in enumerate(figure.subplots(len(rows), sharex=True, sharey=True)):
        axes.bar(range(rows.shape[1]), rows[board], width=1)
        axes.set_ylabel(f"board {board}")
    figure.supxlabel("count")
    figure.savefig(PICTURES / "topic-counts.png")
    lines = [f"{pair['key']:15}{pair['value']}" for pair in last["/bm/decision"]["status"][0]["values"]]
    health = [
        f"{each['name']:23}{Level(each['level']).name:8}{each['message']}"
        for each in last["/diagnostics"]["status"]
    ]
    for name, text in (("decision", lines), ("diagnostics", health)):
        figure = Figure()
        figure.text(0, 0, "\n".join(text), family="monospace", linespacing=1.6)
        figure.savefig(PICTURES / f"topic-{name}.png", bbox_inches="tight", pad_inches=0.1)


async def foxglove(scene: Scene) -> None:
    """Check that Foxglove's readers decode each topic, as its application would."""
    modules, decoded = install_node_packages("foxglove", HERE), scene.stand.folder / "decoded.json"
    command = (shutil.which("node") or "node", str(HERE / "foxglove.mjs"), str(modules))
    outcome = (scene.stand.uri, scene.ros_version, str(decoded))
    await scene.stand.start("foxglove", "messages of each", *command, *outcome)
    if scene.pictures and scene.ros_version == "1":
        draw(json.loads(decoded.read_text()))


CHECKS: Final = {"1": {"Foxglove's readers": foxglove, "rviz": rviz}, "2": {"Foxglove's readers": foxglove}}


async def verify(arguments: argparse.Namespace) -> int:
    """Run a stack for each version of ROS, and let the tools read its topics."""
    os.environ |= {name: f"{limit:g}" for name, limit in PRODUCT_LIMITS.items()}
    tally = Tally()
    for version, checks in CHECKS.items():
        chosen = {
            name: check
            for tool, check in checks.items()
            if arguments.only in (name := f"{tool}, ROS {version}")
        }
        if not chosen:
            continue
        async with temporary_stand() as stand:
            scene = Scene(stand, version, arguments.pictures)
            await stand.start_hub("--ros-version", version)
            await stand.start_boat_master()
            await stand.start_boat()
            for name, check in chosen.items():
                errors = (ProcessError, StackError, BridgeError, TimeoutError)
                with tally.check(name, *errors, details=stand.tails):
                    await check(scene)
            name = f"no process has shown a traceback, ROS {version}"
            tally.report(name, time.monotonic(), stand.traceback())
    return tally.end()


if __name__ == "__main__":
    parser = ScriptParser("scripts/verify tools", __doc__)
    parser.flag("--only", "checks with this in their names, such as rviz", "")
    parser.switch("--pictures", "also draw docs/pictures/rviz.png and topic-*")
    parser.run(verify, LIMIT)
