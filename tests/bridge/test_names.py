"""Names, types, stamps and qualities of service: what is written is read, and the malformed is refused."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.errors import BridgeError, NameFormError, OptionError
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
from bridge.qos import Qos
from bridge.stamps import header, header_stamp_ns, ros_version_of_message, stamp, stamp_ns

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


# Stamps

times = st.integers(min_value=0, max_value=2**31 * 10**9)


def test_keys_of_either_ros_or_of_both():
    assert stamp(5_000_000_006, 1) == {"secs": 5, "nsecs": 6}
    assert stamp(5_000_000_006, 2) == {"sec": 5, "nanosec": 6}
    assert stamp(5_000_000_006) == {"sec": 5, "nanosec": 6, "secs": 5, "nsecs": 6}


@given(times, st.sampled_from([1, 2, None]))
def test_what_is_built_is_read(time, version):
    assert stamp_ns(stamp(time, version)) == time
    msg = {"header": header(time, "map", version)}
    assert set(msg["header"]) == {"stamp", "frame_id"}
    assert header_stamp_ns(msg) == (time or None)
    assert ros_version_of_message(msg) == version


@pytest.mark.parametrize(
    ("time", "nanoseconds"),
    [(time, None) for time in (None, 5, "now", [], {}, {"sec": "5"}, {"sec": 5, "nanosec": None})]
    + [({"secs": 1.5}, None), ({"sec": True}, None), ({"sec": 3}, 3_000_000_000)]
    + [(time, None) for time in ({"sec": 1 << 32}, {"sec": -(1 << 31) - 1}, {"sec": 1, "nanosec": 1 << 32})]
    + [({"sec": 1, "nanosec": -1}, None), ({"sec": -(1 << 31)}, -(10**9 << 31))],
)
def test_what_is_a_time(time, nanoseconds):
    assert stamp_ns(time) == nanoseconds


@pytest.mark.parametrize("head", [None, 3, {}, {"stamp": 1}, {"stamp": {}}])
def test_messages_without_a_stamp(head):
    for msg in ({}, {"header": head}):
        assert header_stamp_ns(msg) is None
        assert ros_version_of_message(msg) is None


# Quality of service


def test_only_given_options_are_requested():
    assert Qos().as_operation() == {}
    assert Qos(
        history="keep_last",
        depth=5,
        reliability="best_effort",
        durability="transient_local",
        deadline=1.25,
        lifespan=math.inf,
    ).as_operation() == {
        "history": "keep_last",
        "depth": 5,
        "reliability": "best_effort",
        "durability": "transient_local",
        "deadline": {"secs": 1, "nsecs": 250_000_000},
        "lifespan": "infinite",
    }


@pytest.mark.parametrize(
    "wrong",
    [
        {"history": "all"},
        {"reliability": "RELIABLE"},
        {"durability": 1},
        {"depth": -1},
        {"depth": 1.0},
        {"depth": True},
        {"deadline": -1},
        {"deadline": math.nan},
        {"lifespan": True},
    ],
)
def test_what_servers_would_refuse_is_refused_here(wrong):
    with pytest.raises(OptionError, match=f"qos {next(iter(wrong))}"):
        Qos(**wrong)
