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


def test_both_forms_of_a_message_type():
    assert ros1_type("std_msgs/msg/String") == ros1_type("std_msgs/String") == "std_msgs/String"
    assert ros2_type("std_msgs/String") == ros2_type("std_msgs/msg/String") == "std_msgs/msg/String"


def test_services_keep_their_kind():
    assert ros1_type("std_srvs/srv/SetBool") == "std_srvs/SetBool"
    assert ros2_type("std_srvs/SetBool", "srv") == "std_srvs/srv/SetBool"
    assert ros2_type("std_srvs/srv/SetBool") == "std_srvs/srv/SetBool"


@given(names, names)
def test_forms_convert_into_each_other(package, own):
    one, two = f"{package}/{own}", f"{package}/msg/{own}"
    assert ros2_type(one) == two
    assert ros1_type(two) == one
    assert same_type(one, two)
    assert same_type(two, one)
    assert ros_version_of_type(one) == 1
    assert ros_version_of_type(two) == 2


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
    "bad",
    [
        "",
        "String",
        "a/b/c",
        "a/msg/",
        "/String",
        "a//B",
        "a/msg/b/C",
        "1a/B",
        "a b/C",
        "a/B\n",
        "a/" + "B" * 300,
    ],
)
def test_malformed_types_are_refused(bad):
    with pytest.raises(NameFormError, match="package/Type"):
        split_type(bad)
    assert ros_version_of_type(bad) is None


@pytest.mark.parametrize(
    "good", ["/a", "a", "/boat/sensors", "~private", "/_x/y1", "/" + "a" * (MAX_NAME - 1)]
)
def test_good_names_stay_as_they_are(good):
    assert check_name(good) == good


@pytest.mark.parametrize(
    "bad", ["", "/", "//a", "/a/", "/a b", "/1a", "/a/-b", "/a\n", 'x"', "/ä", "/" + "a" * MAX_NAME]
)
def test_bad_names_are_refused(bad):
    with pytest.raises(NameFormError):
        check_name(bad)


def test_absolute():
    assert absolute("chatter") == absolute("/chatter") == "/chatter"


@given(st.text())
def test_any_text_is_named_or_refused(text):
    for check in (check_name, split_type, ros1_type, ros2_type):
        try:
            check(text)
        except BridgeError as error:
            assert error.exit_code == 2
            assert len(str(error)) < 500
