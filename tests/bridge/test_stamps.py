import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.stamps import header, header_stamp_ns, ros_version_of_message, stamp, stamp_ns

times = st.integers(min_value=0, max_value=2**31 * 10**9)


def test_keys_of_either_ros_or_of_both():
    assert stamp(5_000_000_006, 1) == {"secs": 5, "nsecs": 6}
    assert stamp(5_000_000_006, 2) == {"sec": 5, "nanosec": 6}
    assert stamp(5_000_000_006) == {"sec": 5, "nanosec": 6, "secs": 5, "nsecs": 6}


@given(times, st.sampled_from([1, 2, None]))
def test_what_is_built_is_read(time, version):
    assert stamp_ns(stamp(time, version)) == time
    msg = {"header": header(time, "map", version)}
    assert header_stamp_ns(msg) == (time or None)
    assert ros_version_of_message(msg) == version


def test_a_header_has_no_seq():
    assert set(header(1, "map", 1)) == {"stamp", "frame_id"}


@pytest.mark.parametrize(
    "time", [None, 5, "now", [], {}, {"sec": "5"}, {"sec": 5, "nanosec": None}, {"secs": 1.5}, {"sec": True}]
)
def test_what_is_no_time(time):
    assert stamp_ns(time) is None


@pytest.mark.parametrize(
    "msg",
    [
        {},
        {"header": None},
        {"header": 3},
        {"header": {}},
        {"header": {"stamp": 1}},
        {"header": {"stamp": {}}},
    ],
)
def test_messages_without_a_stamp(msg):
    assert header_stamp_ns(msg) is None
    assert ros_version_of_message(msg) is None


def test_a_stamp_that_was_never_set_is_none():
    assert header_stamp_ns({"header": {"stamp": {"sec": 0, "nanosec": 0}}}) is None


def test_nanoseconds_may_be_missing():
    assert stamp_ns({"sec": 3}) == 3_000_000_000
