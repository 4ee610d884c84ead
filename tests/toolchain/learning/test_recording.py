"""Recordings as columns: CSV files and bags give the same rows, and errors name what is missing.

std_msgs/Float64 on /range and geometry_msgs/PointStamped on /truth, 10 ms later ──▶ ROS 1 bag, ROS 2 bag, MCAP ──▶ columns
"""

import math

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from toolchain.errors import ModelError
from toolchain.learning.recording import read_recording

COLUMNS = ["/range:data", "/truth:point.x", "/scan:data[1]"]
RANGES = [1.5, math.nan, 2.5, 3.5]


def csv_file(folder, text):
    path = folder / "readings.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_csv_file(tmp_path):
    path = csv_file(tmp_path, "\ufefftime, range ,door\n0, 1.5 ,open\n1,,shut\n\n2,-3e1,\n")
    recording = read_recording(path, ["range", "door", "range"])
    assert recording.rows == 3
    assert recording.columns == {"range": [1.5, None, -30.0], "door": ["open", "shut", None]}


@pytest.mark.parametrize(
    ("text", "column"),
    [
        ("a,b\n1,2\n", "c"),
        ("a,b\n1,2\n3\n", "a"),
        ('a,b\n1,"2\n', "a"),
        ("", "a"),
        ("a,b\n", "a"),
        ("a,b,a\n1,2,3\n", "a"),
        ("a\tb\n1\t2\n", "a"),
        ("a,b\n1,sí\n".encode("latin-1"), "b"),
        (b"a" * ((1 << 20) + 1), "a"),
    ],
)
def test_damaged_csv_files(tmp_path, text, column):
    with pytest.raises(ModelError):
        read_recording(csv_file(tmp_path, text), [column])


def messages(store):
    """Topic, type, time in ns and message: a range every second, the truth 10 ms later but for the last."""
    float64, multi = store.types["std_msgs/msg/Float64"], store.types["std_msgs/msg/Float64MultiArray"]
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    stamped, point = store.types["geometry_msgs/msg/PointStamped"], store.types["geometry_msgs/msg/Point"]
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    has_seq = "seq" in header.__dataclass_fields__
    for at, value in enumerate(RANGES):
        yield "/range", "std_msgs/msg/Float64", at * 10**9, float64(data=value)
        head = header(stamp=time(sec=at, nanosec=0), frame_id="map", **({"seq": at} if has_seq else {}))
        late = 10**7 if at < 3 else 5 * 10**8
        truth = stamped(header=head, point=point(x=float(at), y=0.0, z=0.0))
        yield "/truth", "geometry_msgs/msg/PointStamped", at * 10**9 + late, truth
        array = multi(layout=layout, data=np.arange(at + 1, dtype=np.float64))
        yield "/scan", "std_msgs/msg/Float64MultiArray", at * 10**9 + 1, array


def write(writer, store, serialize):
    with writer:
        connections = {}
        for topic, kind, stamp, message in messages(store):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], stamp, serialize(message, kind))


def bag1(folder):
    store = get_typestore(Stores.ROS1_NOETIC)
    write(Writer1(folder / "r.bag"), store, store.serialize_ros1)
    return folder / "r.bag"


def bag2(folder, plugin):
    store = get_typestore(Stores.LATEST)
    write(Writer2(folder / "bag", version=9, storage_plugin=plugin), store, store.serialize_cdr)
    return folder / "bag"


BAGS = {
    "ros1": bag1,
    "ros2": lambda folder: bag2(folder, StoragePlugin.SQLITE3),
    "ros2 mcap": lambda folder: bag2(folder, StoragePlugin.MCAP),
    "mcap": lambda folder: next(bag2(folder, StoragePlugin.MCAP).glob("*.mcap")),
}


@pytest.mark.parametrize("kind", BAGS)
def test_bags(tmp_path, kind):
    recording = read_recording(BAGS[kind](tmp_path), COLUMNS, tolerance_s=0.1)
    assert recording.rows == 4
    assert recording.columns == {
        "/range:data": [1.5, None, 2.5, 3.5],
        "/truth:point.x": [0.0, 1.0, 2.0, None],
        "/scan:data[1]": [None, 1.0, 1.0, 1.0],
    }


@pytest.mark.parametrize(
    "columns", [["range"], ["/rnge:data"], ["/range:value"], ["/range:data[x]"], ["/range:__class__.__mro__"]]
)
def test_columns_that_a_bag_does_not_have(tmp_path, columns):
    with pytest.raises(ModelError):
        read_recording(bag1(tmp_path), columns)


def test_a_bag_that_is_none(tmp_path):
    for name in ("r.bag", "r.mcap", "r.xyz"):
        (tmp_path / name).write_bytes(b"nothing of a bag" * 50)
        with pytest.raises(ModelError, match=rf"{name} cannot be read as a bag, after 0 messages: "):
            read_recording(tmp_path / name, ["/range:data"])
    (tmp_path / "cut").mkdir()
    path = bag1(tmp_path / "cut")
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(ModelError, match="cannot be read as a bag"):
        read_recording(path, ["/range:data"])
