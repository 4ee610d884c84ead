import base64
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.errors import FieldAmbiguousError, FieldMissingError, PathError
from bridge.fields import MAX_LISTED, Field, all_missing, format_place, parse_path

POSE = {
    "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"},
    "pose": {"position": {"x": 1.5, "y": 2.5}, "orientation": {"w": 1.0, "x": 0.5}},
    "ranges": [0.1, None, {"deep": 7}, [8, 9]],
    "D1": 4,
    "empty": [],
}


def find(message, name):
    field = Field(name)
    present, value = field.value(message)
    if not present:
        raise field.missing(message)
    return value


def test_a_bare_name_that_is_there_more_than_once_is_an_error_with_all_places():
    message = {"v": {"v": 3}, "a": [{"v": 1}], "b": {"c": {"v": {}}, "v": []}}
    with pytest.raises(FieldAmbiguousError, match=r"4 fields named 'v' \(v, v\.v, b\.c\.v, b\.v\)") as caught:
        Field("v").value(message)
    assert caught.value.exit_code == 4


def test_the_first_message_with_it_decides_the_place():
    field = Field("v")
    assert field.value({"other": 1}) == (False, None)
    assert field.place is None
    assert field.value({"a": {"v": 1}}) == (True, 1)
    assert field.place == ("a", "v")
    # A second occurrence is not searched for later, and at another place the field is absent.
    assert field.value({"a": {"v": 2}, "v": 3}) == (True, 2)
    assert field.value({"v": 3}) == (False, None)
    assert "'v': it has no 'a'; it has v" in str(field.missing({"v": 3}))


@pytest.mark.parametrize(
    ("message", "listed"),
    [
        (
            POSE,
            (
                "header.stamp.sec, header.stamp.nanosec, header.frame_id, pose.position.x, pose.position.y, "
                "pose.orientation.w, pose.orientation.x, ranges (an array of 4), D1, empty (an array of 0)"
            ),
        ),
        ({}, "no fields at all"),
    ],
)
def test_the_error_for_a_missing_field_lists_the_fields_of_the_message(message, listed):
    with pytest.raises(FieldMissingError) as caught:
        find(message, "D2")
    assert str(caught.value) == f"the message has no field 'D2'; it has {listed}"
    assert caught.value.exit_code == 4


def test_a_long_list_is_cut():
    message = {f"field_{i}_{'x' * 5000}": i for i in range(1000)}
    with pytest.raises(FieldMissingError, match="and more$") as caught:
        find(message, "D1")
    assert str(caught.value).count("field_") == MAX_LISTED
    assert len(str(caught.value)) < 4000


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("pose.position.z", "it has no 'z' in 'pose.position'; it has x, y"),
        ("nothing.x", "it has no 'nothing'; it has header"),
        ("D1.x", "'D1' is a number, not an object"),
        ("header.frame_id.x", "'header.frame_id' is a string, not an object"),
        ("ranges[1].x", "'ranges[1]' is null, not an object"),
        ("ranges[4]", "'ranges' has 4 elements"),
        ("empty[0]", "'empty' has 0 elements"),
        ("pose[0]", "'pose' is an object, not an array"),
    ],
)
def test_how_far_a_path_went(path, reason):
    with pytest.raises(FieldMissingError) as caught:
        find(POSE, path)
    assert str(caught.value).startswith(f"the message has no field {path!r}: {reason}")


@pytest.mark.parametrize(
    "bad", ["", ".", "a.", ".a", "a..b", "a[", "a[-1]", "[0]", "a.[0]", "a[0]b", "a b", "1a", "ä", "a.b\n"]
)
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
def test_a_field_is_found_where_a_simple_search_finds_it(message):
    places = dict(places_of(message))
    for place, value in places.items():
        path = format_place(place)
        assert parse_path(path) == place
        if "." in path or "[" in path:
            assert Field(path).value(message) == (True, value)
    found = [place for place in places if place[-1] == "v" and all(isinstance(step, str) for step in place)]
    field = Field("v")
    if len(found) > 1:
        with pytest.raises(FieldAmbiguousError):
            field.value(message)
    else:
        assert field.value(message)[0] == bool(found)
        assert field.place == (found[0] if found else None)


PIXELS = bytes(range(250, 256)) + b"\x00\x7f"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_element_of_an_array(dtype):
    scan = {"ranges": np.array([0.5, np.nan, np.inf], dtype)}
    value = find(scan, "ranges[0]")
    assert type(value) is float
    assert value == 0.5
    assert math.isnan(find(scan, "ranges[1]"))
    assert find(scan, "ranges[2]") == math.inf
    for path, reason in (
        ("ranges[3]", "'ranges' has 3 elements"),
        ("nothing", r"ranges \(an array of 3\)"),
        ("ranges.x", "'ranges' is an array of 3, not an object"),
    ):
        with pytest.raises(FieldMissingError, match=reason):
            find(scan, path)


@pytest.mark.parametrize("length", [0, 1, 3, 8])
def test_a_byte_of_an_image_in_any_form(length):
    pixels = PIXELS[:length]
    for data in (pixels, list(pixels), np.frombuffer(pixels, np.uint8), base64.b64encode(pixels).decode()):
        image = {"data": data}
        found = [find(image, f"data[{index}]") for index in range(length)]
        assert found == list(pixels)
        assert {type(value) for value in found} <= {int}
        assert Field(f"data[{length}]").value(image) == (False, None)
        with pytest.raises(FieldMissingError):
            find(image, f"data[{length}]")


@pytest.mark.parametrize("text", ["\u00e4\u00e4\u00e4\u00e4", "a b!", "====", "a===", "ab=c"])
def test_a_text_that_is_not_base64_has_no_bytes(text):
    for index in range(3):
        present, value = Field(f"a[{index}]").value({"a": text})
        assert not present or value is None or type(value) is int
    for data in ("abc", 5, np.zeros((2, 2))):
        assert Field("a[0]").value({"a": data}) == (False, None)


def test_all_missing_names_are_in_one_error():
    error = all_missing([Field("D7"), Field("pose.position.q")], POSE)
    assert (error.exit_code, type(error)) == (4, FieldMissingError)
    for name in ("'D7'", "'pose.position.q'", "pose.position.x"):
        assert name in str(error)
    many = str(all_missing([Field(f"n{at}") for at in range(MAX_LISTED + 3)], {}))
    assert f"'n{MAX_LISTED - 1}'" in many
    assert f"'n{MAX_LISTED}'" not in many
    assert str(all_missing([Field("ranges[9]")], POSE)) == str(Field("ranges[9]").missing(POSE))
