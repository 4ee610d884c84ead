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
    with pytest.raises(FieldMissingError, match="'v'.*it has no 'a'; there it has v"):
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
        ("pose.position.z", "it has no 'z' in 'pose.position'; there it has x, y"),
        ("nothing.x", "it has no 'nothing'; there it has header"),
        ("D1.x", "'D1' is a number, not an object"),
        ("header.frame_id.x", "'header.frame_id' is a string, not an object"),
        ("ranges.x", "'ranges' is an array of 4, not an object"),
        ("ranges[1].x", "'ranges[1]' is null, not an object"),
        ("ranges[4]", "'ranges' has 4 elements, the index 4 is none of theirs"),
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
