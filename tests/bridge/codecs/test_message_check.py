"""Messages are compared with the definition of their type: names of fields, and shapes of arrays."""

from types import MappingProxyType

import numpy as np
import pytest

from bridge.codecs.message_check import (
    MessageCheck,
    bundled_definitions,
    check_from_rosapi,
    definitions_from_rosapi,
)
from bridge.errors import MessageTypeError
from bridge.hub.definitions import MessageDefinitions

TWIST = "geometry_msgs/Twist"
ODOMETRY = "nav_msgs/Odometry"


@pytest.fixture(params=[1, 2])
def version(request):
    return request.param


@pytest.fixture(params=["rosapi", "bundled"])
def check(request, version):
    """Return the check of a type, from either source."""

    def make(type_name):
        if request.param == "bundled":
            return MessageCheck(type_name, bundled_definitions(type_name, version))
        answer = {"typedefs": MessageDefinitions(version).details(type_name)}
        return MessageCheck(type_name, definitions_from_rosapi(answer))

    return make


@pytest.mark.parametrize(
    ("type_name", "msg"),
    [
        (TWIST, {}),
        (TWIST, {"linear": {"x": 1}, "angular": {}}),
        (TWIST, MappingProxyType({"linear": MappingProxyType({"x": np.float64(1)})})),
        (TWIST, {"linear": None}),
        (ODOMETRY, {"pose": {"covariance": [0.0] * 36}, "header": {"stamp": {"secs": 1, "sec": 1}}}),
        (ODOMETRY, {"pose": {"covariance": np.zeros(36)}, "child_frame_id": "base"}),
        ("sensor_msgs/Image", {"data": b"abc", "height": 1}),
        ("sensor_msgs/Image", {"data": "YWJj"}),
        ("sensor_msgs/Image", {"data": np.zeros(3, np.uint8)}),
        ("sensor_msgs/LaserScan", {"ranges": (1.0, None, 2)}),
        ("nav_msgs/Path", {"poses": [{"pose": {"position": {"x": 1}}}, {}]}),
    ],
)
def test_what_fits_passes(check, type_name, msg):
    check(type_name)(msg)


@pytest.mark.parametrize(
    ("type_name", "msg", "named"),
    [
        (TWIST, {"lineer": {}}, ("geometry_msgs/Twist", "lineer", "linear")),
        (TWIST, {"linear": {"x": 1, "zz": 2}}, ("geometry_msgs/Vector3", "linear.zz", "linear.z")),
        (TWIST, {"linear": 1.0}, ("linear", "int|float", "geometry_msgs/Vector3")),
        (TWIST, {"linear": {"x": [1.0]}}, ("linear.x", "array of 1", "float64")),
        (TWIST, {"linear": {"x": {}}}, ("linear.x", "object", "float64")),
        (ODOMETRY, {"pose": {"covariance": [0.0] * 35}}, ("pose.covariance", "array of 35", "float64[36]")),
        (ODOMETRY, {"pose": {"covariance": np.zeros((6, 6))}}, ("pose.covariance", "6x6", "float64[36]")),
        (
            ODOMETRY,
            {"pose": {"covariance": [[0.0] * 6] * 6}},
            ("pose.covariance", "array of 6 arrays", "float64[36]"),
        ),
        ("sensor_msgs/LaserScan", {"ranges": 1.0}, ("ranges", "float", "float32[]")),
        ("sensor_msgs/LaserScan", {"ranges": "text"}, ("ranges", "str", "float32[]")),
        ("sensor_msgs/LaserScan", {"ranges": {}}, ("ranges", "object", "float32[]")),
        ("sensor_msgs/Image", {"data": np.zeros((2, 2, 3), np.uint8)}, ("data", "2x2x3", "uint8[]")),
        ("nav_msgs/Path", {"poses": [{}, {"pos": 1}]}, ("geometry_msgs/PoseStamped", "poses[1].pos", "pose")),
        ("nav_msgs/Path", {"poses": [1]}, ("poses[0]", "int", "geometry_msgs/PoseStamped")),
    ],
)
def test_what_does_not_fit_is_refused_with_type_field_and_expectation(check, type_name, msg, named):
    with pytest.raises(MessageTypeError) as caught:
        check(type_name)(msg)
    for part in named:
        assert any(each in str(caught.value) for each in part.split("|"))


def test_a_type_that_is_not_a_standard_one_is_not_bundled():
    assert bundled_definitions("boat_msgs/Sensors", 2) == {}


@pytest.mark.parametrize(
    "answer",
    [
        None,
        [],
        {},
        {"typedefs": 1},
        {"typedefs": [1, {}, {"type": "a/B"}]},
        {"typedefs": [{"type": 1, "fieldnames": [], "fieldtypes": [], "fieldarraylen": []}]},
        {"typedefs": [{"type": "a/B", "fieldnames": ["x"], "fieldtypes": [], "fieldarraylen": []}]},
        {"typedefs": [{"type": "a/B", "fieldnames": ["x"], "fieldtypes": [1], "fieldarraylen": [0]}]},
        {"typedefs": [{"type": "a/B", "fieldnames": ["x"], "fieldtypes": ["f"], "fieldarraylen": ["0"]}]},
        {"typedefs": [{"type": "a/B", "fieldnames": ["x"], "fieldtypes": ["f"], "fieldarraylen": [-2]}]},
        {"typedefs": [{"type": "a/B", "fieldnames": ["x"], "fieldtypes": ["f"], "fieldarraylen": [2**32]}]},
        {"typedefs": [{"type": "a/B", "fieldnames": ["x"], "fieldtypes": ["f"], "fieldarraylen": [True]}]},
    ],
)
def test_an_answer_that_is_not_a_definition(answer):
    assert definitions_from_rosapi(answer) == {}


def test_names_of_fields_from_ros2s_rosapi_have_an_underscore():
    typedef = {"type": "a/B", "fieldnames": ["_x"], "fieldtypes": ["int32"], "fieldarraylen": [-1]}
    assert list(definitions_from_rosapi({"typedefs": [typedef]})["a/B"]) == ["x"]


def test_the_check_is_that_of_the_first_type_or_of_none():
    empty = {"fieldnames": [], "fieldtypes": [], "fieldarraylen": []}
    checked = check_from_rosapi({"typedefs": [{"type": "a/B_Request", **empty}, {"type": "a/C", **empty}]})
    with pytest.raises(MessageTypeError, match="a/B_Request"):
        checked({"x": 1})
    assert check_from_rosapi({"typedefs": [{"type": "a/B"}, {"type": "a/C", **empty}]}) is None
    assert check_from_rosapi({"typedefs": []}) is None
    assert check_from_rosapi(None) is None


def test_parts_of_unknown_type_are_not_checked():
    typedef = {"type": "a/B", "fieldnames": ["c"], "fieldtypes": ["x/Y"], "fieldarraylen": [-1]}
    checked = MessageCheck("a/B", definitions_from_rosapi({"typedefs": [typedef]}))
    for value in ({"anything": 1}, 3, [1]):
        checked({"c": value})
    with pytest.raises(MessageTypeError):
        checked({"d": 1})
