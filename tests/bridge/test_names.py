import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.errors import BridgeError, NameFormError
from bridge.names import (
    MAX_NAME,
    absolute,
    check_name,
    ros1_type,
    ros2_type,
    ros_version_of_type,
    same_type,
    split_type,
)

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,20}", fullmatch=True)


@given(names, names, st.sampled_from(["msg", "srv", "action"]))
def test_forms_convert_into_each_other(package, own, kind):
    one, two = f"{package}/{own}", f"{package}/{kind}/{own}"
    assert ros2_type(one, kind) == ros2_type(two) == two
    assert ros2_type(one) == f"{package}/msg/{own}"
    assert ros1_type(two) == ros1_type(one) == one
    assert same_type(one, two)
    assert same_type(two, one)
    assert (ros_version_of_type(one), ros_version_of_type(two)) == (1, 2)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("std_msgs/String", "std_msgs/msg/String", True),
        ("std_msgs/String", "std_msgs/Int32", False),
        ("a/String", "b/String", False),
        ("a/srv/X", "a/msg/X", False),
        ("a/srv/X", "a/X", True),
        ("*", "*", True),
        ("*", "std_msgs/String", False),
        ("", "std_msgs/String", False),
    ],
)
def test_same_type(one, other, same):
    assert same_type(one, other) is same
    assert same_type(other, one) is same


@pytest.mark.parametrize(
    "bad", [*("", "String", "a/b/c", "a/msg/", "/String", "a//B", "1a/B", "a b/C", "a/B\n", "a/" + "B" * 300)]
)
def test_malformed_types_are_refused(bad):
    with pytest.raises(NameFormError):
        split_type(bad)
    assert ros_version_of_type(bad) is None


@pytest.mark.parametrize(
    "good", ["/a", "a", "/boat/sensors", "~private", "/_x/y1", "/" + "a" * (MAX_NAME - 1)]
)
def test_good_names_stay_as_they_are(good):
    assert check_name(good) == good
    assert absolute(good) == (good if good[0] == "/" else f"/{good}")


@pytest.mark.parametrize("bad", ["", "//a", "/a/", "/a b", "/1a", "/a\n", "/ä", "/" + "a" * MAX_NAME])
def test_bad_names_are_refused(bad):
    with pytest.raises(NameFormError):
        check_name(bad)


@given(st.text())
def test_any_text_is_named_or_refused(text):
    for check in (check_name, split_type, ros1_type, ros2_type):
        try:
            check(text)
        except BridgeError as error:
            assert error.exit_code == 2
            assert len(str(error)) < 500
