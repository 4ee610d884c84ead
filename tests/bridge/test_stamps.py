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
    assert set(msg["header"]) == {"stamp", "frame_id"}
    assert header_stamp_ns(msg) == (time or None)
    assert ros_version_of_message(msg) == version


@pytest.mark.parametrize(
    ("time", "nanoseconds"),
    [(time, None) for time in (None, 5, "now", [], {}, {"sec": "5"}, {"sec": 5, "nanosec": None})]
    + [({"secs": 1.5}, None), ({"sec": True}, None), ({"sec": 3}, 3_000_000_000)],
)
def test_what_is_a_time(time, nanoseconds):
    assert stamp_ns(time) == nanoseconds


@pytest.mark.parametrize("head", [None, 3, {}, {"stamp": 1}, {"stamp": {}}])
def test_messages_without_a_stamp(head):
    for msg in ({}, {"header": head}):
        assert header_stamp_ns(msg) is None
        assert ros_version_of_message(msg) is None
