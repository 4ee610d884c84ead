import base64
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.errors import BridgeError, FieldAmbiguousError, FieldMissingError, PathError
from bridge.fields import MAX_LISTED, Field, find_field, find_places, format_place, parse_path

POSE = {
    "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"},
    "pose": {"position": {"x": 1.5, "y": 2.5}, "orientation": {"w": 1.0, "x": 0.5}},
    "ranges": [0.1, None, {"deep": 7}, [8, 9]],
    "D1": 4,
    "empty": [],
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("D1", 4),
        ("w", 1.0),
        ("frame_id", "map"),
        ("position", {"x": 1.5, "y": 2.5}),
        ("ranges", POSE["ranges"]),
        ("empty", []),
        ("pose.position.x", 1.5),
        ("header.stamp.sec", 1),
        ("ranges[0]", 0.1),
        ("ranges[1]", None),
        ("ranges[2].deep", 7),
        ("ranges[3][1]", 9),
    ],
)
def test_what_is_there(name, value):
    assert find_field(POSE, name) == value
    assert Field(name).value(POSE) == (True, value)


def test_a_bare_name_is_not_searched_in_arrays():
    assert Field("deep").value(POSE) == (False, None)
    with pytest.raises(FieldMissingError, match="'deep'"):
        find_field(POSE, "deep")


def test_a_bare_name_that_is_there_twice_is_an_error_with_both_places():
    with pytest.raises(
        FieldAmbiguousError, match=r"2 fields named 'x' \(pose\.position\.x, pose\.orientation\.x\)"
    ) as caught:
        find_field(POSE, "x")
    assert caught.value.exit_code == 4


@pytest.mark.parametrize(
    "message",
    [
        {"v": 1, "a": {"v": 2}},
        {"a": {"v": 2}, "v": 1},
        {"v": {"v": 1}},
        {"a": {"b": {"c": {"v": {}}}}, "z": {"v": []}},
    ],
)
def test_a_second_occurrence_counts_anywhere(message):
    with pytest.raises(FieldAmbiguousError):
        Field("v").locate(message)


def test_an_occurrence_in_an_array_does_not_count():
    assert find_field({"a": [{"v": 1}], "v": 2}, "v") == 2


def test_the_first_message_with_it_decides_the_place():
    field = Field("v")
    assert field.value({"other": 1}) == (False, None)
    assert field.place is None
    assert field.value({"a": {"v": 1}}) == (True, 1)
    assert field.place == ("a", "v")
    # A second occurrence later is not looked for, and elsewhere is not there.
    assert field.value({"a": {"v": 2}, "v": 3}) == (True, 2)
    assert field.value({"v": 3}) == (False, None)
    with pytest.raises(FieldMissingError, match="'v'.*it has no 'a'; it has v"):
        field.locate({"v": 3})


def test_places_come_depth_first():
    message = {"a": {"b": {"v": 1}, "v": 2}, "v": 3}
    assert list(map(format_place, find_places(message, "v"))) == ["a.b.v", "a.v", "v"]


def test_a_missing_name_is_told_with_what_was_there():
    with pytest.raises(FieldMissingError) as caught:
        Field("D2").locate(POSE)
    assert str(caught.value) == (
        "the message has no field 'D2'; it has header.stamp.sec, header.stamp.nanosec, header.frame_id, "
        "pose.position.x, pose.position.y, pose.orientation.w, pose.orientation.x, ranges (an array of 4), D1, "
        "empty (an array of 0)"
    )
    assert caught.value.exit_code == 4


def test_a_long_list_is_cut():
    message = {f"field_{i}_{'x' * 5000}": i for i in range(1000)}
    with pytest.raises(FieldMissingError, match="and more$") as caught:
        find_field(message, "D1")
    assert str(caught.value).count("field_") == MAX_LISTED
    assert len(str(caught.value)) < 4000


def test_an_empty_message():
    with pytest.raises(FieldMissingError, match="no fields at all"):
        find_field({}, "D1")


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("pose.position.z", "it has no 'z' in 'pose.position'; it has x, y"),
        ("nothing.x", "it has no 'nothing'; it has header"),
        ("D1.x", "'D1' is a number, not an object"),
        ("header.frame_id.x", "'header.frame_id' is a string, not an object"),
        ("ranges.x", "'ranges' is an array of 4, not an object"),
        ("ranges[1].x", "'ranges[1]' is null, not an object"),
        ("ranges[4]", "'ranges' has 4 elements"),
        ("empty[0]", "'empty' has 0 elements"),
        ("pose[0]", "'pose' is an object, not an array"),
    ],
)
def test_how_far_a_path_went(path, reason):
    field = Field(path)
    assert field.value(POSE) == (False, None)
    with pytest.raises(FieldMissingError) as caught:
        field.locate(POSE)
    assert str(caught.value).startswith(f"the message has no field {path!r}: {reason}")


@pytest.mark.parametrize(
    "bad",
    ["", ".", "a.", ".a", "a..b", "a[", "a]", "a[]", "a[-1]", "a[x]", "[0]", "a.[0]", "a[0]b", "a b", "a.b c", "1a", "a[0].", "ä", "a[1 ]", "a\n", "a.b\n"],
)  # fmt: skip
def test_what_is_neither_a_name_nor_a_path(bad):
    with pytest.raises(PathError) as caught:
        Field(bad)
    assert caught.value.exit_code == 2


keys = st.sampled_from("abcv")
leaves = st.none() | st.booleans() | st.integers() | st.text(max_size=3)
messages = st.dictionaries(
    keys,
    st.recursive(
        leaves,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=4),
        max_leaves=12,
    ),
    max_size=4,
)


def places_of(value, place=()):
    """All places of a message, written down the simple way."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for step, part in parts:
        yield (*place, step), part
        yield from places_of(part, (*place, step))


@given(messages)
def test_every_place_is_found_by_its_path(message):
    for place, value in places_of(message):
        path = format_place(place)
        assert parse_path(path) == place
        if "." in path or "[" in path:
            assert Field(path).value(message) == (True, value)


@given(messages)
def test_a_bare_name_is_found_where_a_simple_search_finds_it(message):
    found = [
        place
        for place, _value in places_of(message)
        if place[-1] == "v" and all(isinstance(step, str) for step in place)
    ]
    field = Field("v")
    if len(found) > 1:
        with pytest.raises(FieldAmbiguousError):
            field.value(message)
    elif found:
        assert field.locate(message) == found[0]
    else:
        assert field.value(message) == (False, None)
        assert "'v'" in str(field.missing(message))


@given(st.text(alphabet="ab.[]01 -", max_size=8), messages)
def test_any_name_is_found_or_told(name, message):
    try:
        find_field(message, name)
    except BridgeError as error:
        assert str(error)


# What real sensors send, in every form in which it may come

STAMP = {"sec": 1700000000, "nanosec": 250000000}
HEADER = {"stamp": STAMP, "frame_id": "base_link"}
RANGE = {
    "header": HEADER,
    "radiation_type": 0,
    "field_of_view": 0.26,
    "min_range": 0.02,
    "max_range": 4.0,
    "range": 1.25,
    "variance": 0.0,
}
BEAMS = [0.1 * n for n in range(360)]
SCAN = {
    "header": HEADER,
    "angle_min": -3.14,
    "angle_max": 3.14,
    "angle_increment": 0.0175,
    "time_increment": 0.0,
    "scan_time": 0.1,
    "range_min": 0.12,
    "range_max": 3.5,
    "ranges": BEAMS,
    "intensities": [],
}
VECTOR = {"x": 0.1, "y": 0.2, "z": 9.81}
IMU = {
    "header": HEADER,
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.5, "w": 0.866},
    "orientation_covariance": [0.01] * 9,
    "angular_velocity": {"x": 0.0, "y": 0.0, "z": 1.5},
    "angular_velocity_covariance": [-1.0] + [0.0] * 8,
    "linear_acceleration": VECTOR,
    "linear_acceleration_covariance": [0.0] * 9,
}
PIXELS = bytes(range(250, 256)) + b"\x00\x7f"
IMAGE = {"header": HEADER, "height": 2, "width": 4, "encoding": "mono8", "step": 4, "data": PIXELS}


@pytest.mark.parametrize(
    ("message", "path", "value"),
    [
        (RANGE, "range", 1.25),
        (RANGE, "header.stamp.sec", 1700000000),
        (SCAN, "ranges[0]", 0.0),
        (SCAN, "ranges[90]", 9.0),
        (SCAN, "ranges[359]", pytest.approx(35.9)),
        (IMU, "angular_velocity.z", 1.5),
        (IMU, "linear_acceleration.z", 9.81),
        (IMU, "orientation_covariance[8]", 0.01),
        (IMU, "w", 0.866),
    ],
)
def test_a_sensor_needs_no_more_than_a_path(message, path, value):
    assert find_field(message, path) == value


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_beam_of_an_array(dtype):
    scan = SCAN | {"ranges": np.array([*BEAMS[:3], np.nan, np.inf], dtype)}
    for index in range(3):
        value = find_field(scan, f"ranges[{index}]")
        assert type(value) is float
        assert value == pytest.approx(BEAMS[index], rel=1e-6)
    assert math.isnan(find_field(scan, "ranges[3]"))
    assert find_field(scan, "ranges[4]") == math.inf
    with pytest.raises(FieldMissingError, match="'ranges' has 5 elements"):
        find_field(scan, "ranges[5]")
    with pytest.raises(FieldMissingError, match=r"ranges \(an array of 5\)"):
        find_field(scan, "nothing")
    with pytest.raises(FieldMissingError, match="'ranges' is an array of 5, not an object"):
        find_field(scan, "ranges.x")
    assert type(find_field({"n": np.array([7], np.uint8)}, "n[0]")) is int


@pytest.mark.parametrize("length", range(9))
def test_a_byte_of_an_image_in_any_form(length):
    pixels = PIXELS[:length]
    for data in (pixels, list(pixels), np.frombuffer(pixels, np.uint8), base64.b64encode(pixels).decode()):
        image = IMAGE | {"data": data}
        found = [find_field(image, f"data[{index}]") for index in range(length)]
        assert found == list(pixels)
        assert {type(value) for value in found} <= {int}
        assert Field(f"data[{length}]").value(image) == (False, None)
        with pytest.raises(FieldMissingError):
            find_field(image, f"data[{length}]")


@pytest.mark.parametrize("text", ["\u00e4\u00e4\u00e4\u00e4", "a b!", "====", "a===", "ab=c"])
def test_a_text_that_is_no_base64_has_no_bytes(text):
    for index in range(3):
        present, value = Field(f"a[{index}]").value({"a": text})
        assert not present or value is None or type(value) is int
    assert Field("a[0]").value({"a": "abc"}) == (False, None)
    assert Field("a[0]").value({"a": 5}) == (False, None)
    assert Field("a[0]").value({"a": np.zeros((2, 2))}) == (False, None)
