"""Serialised messages: written by rosbags' serialisers (or by hand), read through MessageTypes."""

import struct
import subprocess
import sys

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from bridge.codecs.serialised import MessageTypes
from bridge.errors import DecodeError, DefinitionError, NameFormError
from tests.patience import PROCESS_PATIENCE

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.LATEST)
TYPES = MessageTypes()
SENSORS = "std_msgs/Header header\nfloat32[4] distances\nboat_msgs/Beam[] beams\nint32 LIMIT=5\n"
BEAM = "float64 angle\nuint8[] quality\nstring name"
SEPARATED = SENSORS + "=" * 80 + "\nMSG: boat_msgs/Beam\n" + BEAM


def scan(store):
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=12, nanosec=34)
    extra = {"seq": 7} if store is ROS1 else {}
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="laser", **extra)
    numbers = (-1.5, 1.5, 0.1, 0.0, 0.05, 0.2, 10.0)
    arrays = (np.array([1, np.inf, 3], np.float32), np.empty(0, np.float32))
    return types["sensor_msgs/msg/LaserScan"](header, *numbers, *arrays)


def of_ros1(message):
    return bytes(ROS1.serialize_ros1(message, message.__msgtype__))


def of_ros2(message, *, little_endian=True):
    return bytes(ROS2.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


@pytest.mark.parametrize("types", [TYPES, MessageTypes(1), MessageTypes(2)])
@pytest.mark.parametrize("name", ["sensor_msgs/LaserScan", "sensor_msgs/msg/LaserScan"])
def test_a_scan_of_either_ros(types, name):
    forms = {
        1: (of_ros1(scan(ROS1)), {"seq": 7, "stamp": {"secs": 12, "nsecs": 34}, "frame_id": "laser"}),
        2: (of_ros2(scan(ROS2)), {"stamp": {"sec": 12, "nanosec": 34}, "frame_id": "laser"}),
        3: (
            of_ros2(scan(ROS2), little_endian=False),
            {"stamp": {"sec": 12, "nanosec": 34}, "frame_id": "laser"},
        ),
    }
    for version, (data, header) in forms.items():
        if types._version not in {None, min(version, 2)}:
            with pytest.raises(DecodeError):
                types.read(data, name)
            continue
        message = types.read(data, name)
        assert message["header"] == header
        assert (message["angle_min"], message["range_max"]) == (-1.5, 10.0)
        assert (message["ranges"].dtype.kind, message["ranges"].tolist()) == ("f", [1, np.inf, 3])
        assert message["intensities"].tolist() == []


def test_padding_after_cdr_is_taken():
    data = of_ros2(ROS2.types["std_msgs/msg/String"]("abcd"))
    assert TYPES.read(data + b"\xff\xff", "std_msgs/String") == {"data": "abcd"}
    with pytest.raises(DecodeError):
        TYPES.read(data + bytes(4), "std_msgs/String")


@pytest.mark.parametrize("n", [0, 1, 256, 65536])
def test_bytes_of_ros1_that_begin_like_cdr(n):
    assert TYPES.read(struct.pack("<I", n), "std_msgs/UInt32") == {"data": n}
    text = "x" * n
    assert TYPES.read(struct.pack("<I", n) + text.encode(), "std_msgs/String") == {"data": text}


@pytest.mark.parametrize("together", [True, False])
def test_types_of_ones_own(together):
    types = MessageTypes()
    if together:
        types.register("boat_msgs/Sensors", SEPARATED)
    else:
        types.register("boat_msgs/msg/Sensors", SENSORS)
        types.register("boat_msgs/Beam", BEAM)
    data = struct.pack("<IiiI", 1, 2, 3, 1) + b"m" + struct.pack("<4f", 1, 2, 3, 4) + struct.pack("<I", 1)
    data += struct.pack("<dI", 0.5, 2) + b"\x07\x08" + struct.pack("<I", 2) + b"ab"
    message = types.read(data, "boat_msgs/Sensors")
    assert message["header"] == {"seq": 1, "stamp": {"secs": 2, "nsecs": 3}, "frame_id": "m"}
    assert message["distances"].tolist() == [1, 2, 3, 4]
    (beam,) = message["beams"]
    assert (beam["angle"], beam["quality"].tolist(), beam["name"]) == (0.5, [7, 8], "ab")


def test_a_type_that_is_not_known():
    with pytest.raises(DefinitionError, match="boat_msgs/Sensors"):
        TYPES.read(b"", "boat_msgs/Sensors")
    types = MessageTypes()
    types.register("boat_msgs/Sensors", SENSORS)
    with pytest.raises(DefinitionError, match="Beam"):
        types.read(bytes(40), "boat_msgs/Sensors")
    with pytest.raises(NameFormError):
        types.read(b"", "no type")


@pytest.mark.parametrize("text", ["???", "int32[ a", "float32 x\n====\nMSG: \n"])
def test_a_definition_that_is_none(text):
    with pytest.raises(DefinitionError) as caught:
        MessageTypes().register("a/B", text)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_another_definition_of_a_standard_type():
    types = MessageTypes()
    types.register("std_msgs/String", "int32 data")
    with pytest.raises(DefinitionError):
        types.read(b"", "std_msgs/String")


def test_without_rosbags_one_sentence_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(DefinitionError, match="pip install rosbags"):
        MessageTypes().read(b"", "std_msgs/String")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "use",
    [
        "import bridge.client, bridge.codecs.serialised, bridge.discovery",
        "import bridge.fields, bridge.stamps; from bridge.codecs.json_codec import encode; encode({'a': 1.0})",
        "from bridge.codecs.cbor_codec import *; decode(encode({'a': typed_array([1.5], 'f8')}))",
    ],
)
def test_nothing_heavy_is_imported_before_it_is_wanted(use):
    code = f"import sys; {use}; assert not {{'rosbags', 'numpy', 'zeroconf'}} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PROCESS_PATIENCE)
