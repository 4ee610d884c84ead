"""The boat's world for Gazebo: the same map, beacons and sensors as in `sensors.py`, in valid SDFormat."""

import os
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from casestudies.boat import sensors
from casestudies.boat.sensors import BEACON_NAMES, BEACONS, MAP_HIGH, MAP_LOW
from casestudies.boat.simulator import Boat

PATH = Path(sensors.__file__).with_name("world.sdf")
WORLD = ET.parse(PATH).find("world")  # noqa: S314 - a file of this project


def model(name):
    found = WORLD.find(f"model[@name='{name}']")
    assert found is not None, name
    return found


def numbers(element, path):
    return [float(text) for text in element.findtext(path).split()]


def test_map_beacons_and_boat_are_those_of_the_simulator():
    names = [each.get("name") for each in WORLD.iter("model")]
    assert names == ["map", *BEACON_NAMES, "boat"]
    assert [tuple(numbers(model(name), "pose")[:2]) for name in BEACON_NAMES] == list(BEACONS)
    assert (MAP_LOW + MAP_HIGH, model("map").find("pose")) == (0, None)  # both centred on the origin
    for size in model("map").iter("size"):
        assert size.text.split() == [f"{MAP_HIGH - MAP_LOW:g}"] * 2
    boat = Boat(0, 60)
    assert numbers(model("boat"), "pose")[:2] == [boat.x, boat.y]


def test_the_plug_in_has_the_sensors_their_noise_and_the_topics():
    plugin = model("boat").find("plugin")
    distances = [(each.get("name"), each.get("beacon")) for each in plugin.iter("distance")]
    bearings = [(each.get("name"), each.get("beacon")) for each in plugin.iter("bearing")]
    assert distances == list(zip(sensors.DISTANCE_NAMES, BEACON_NAMES, strict=True))
    assert bearings == list(zip(sensors.BEARING_NAMES, BEACON_NAMES, strict=True))
    for each in plugin.iter("distance"):
        for true in (0.0, 50.0, 141.0):
            sigma = float(each.get("offset")) + float(each.get("slope")) * true
            assert sigma == pytest.approx(sensors.distance_sigma(true))
    assert {float(each.get("sigma")) for each in plugin.iter("bearing")} == {sensors.BEARING_SIGMA}
    assert plugin.findtext("frame") == sensors.MAP_FRAME
    published = [(each.get("topic"), each.get("type")) for each in plugin if each.get("topic")]
    assert published == [
        (sensors.TRUE_POSE_TOPIC, sensors.TRUE_POSE_TYPE),
        (sensors.RAW_TOPIC, sensors.RAW_TYPE),
    ]


@pytest.mark.thorough
@pytest.mark.skipif(
    shutil.which("ign") is None,
    reason="ign sdf is not installed (Debian: apt-get install ignition-tools libsdformat-dev)",
)
def test_sdformat_accepts_it(tmp_path):
    def check(path):
        command = ["ign", "sdf", "-k", str(path)]
        environment = os.environ | {"HOME": str(tmp_path)}  # where it keeps its logs
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    accepted = check(PATH)
    assert (accepted.returncode, accepted.stdout.strip()) == (0, "Valid."), accepted.stderr
    wrong = tmp_path / "wrong.sdf"
    wrong.write_text(PATH.read_text().replace("<radius>1.5", "<radius>wide"))
    assert check(wrong).returncode != 0
