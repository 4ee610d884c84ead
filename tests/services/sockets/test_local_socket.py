"""Framing of the local sockets: any split of the bytes gives the same records, anything else is refused.

encode_record --bytes--> [split anywhere] --> RecordSplitter --> records
"""

import contextlib
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.errors import LocalSocketError, OtherPeerError
from services.sockets.local_socket import MAX_RECORD, RecordSplitter, check_hello, encode_record, own_hello
from services.sockets.records import VERSION, FrameRequest, FrameResult, Hello, Notice


def raw(value):
    return msgspec.Raw(msgspec.msgpack.encode(value))


small = st.integers(0, 2**40)
records = st.one_of(
    st.builds(
        FrameRequest,
        number=small,
        addresses=st.lists(
            st.none() | st.integers(0, 2**16) | st.lists(st.integers(-1, 9), max_size=4), max_size=40
        ),
        bank=small,
    ),
    st.builds(Notice, level=st.text(max_size=9), sentence=st.text(max_size=99)),
    st.builds(
        FrameResult,
        number=small,
        boards=st.builds(raw, st.binary(max_size=400)),
        register_writes_ns=small,
        compute_ns=small,
        reads_ns=small,
        boards_compute_ns=small,
    ),
)


@given(st.lists(records, max_size=6), st.lists(st.integers(0, 600), max_size=10))
def test_any_split_gives_the_same_records(sent, cuts):
    data = b"".join(encode_record(record) for record in sent)
    edges = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    splitter = RecordSplitter("a peer")
    got = [record for start, end in pairwise(edges) for record in splitter.feed(data[start:end])]
    assert got == sent


@given(st.binary(max_size=300))
def test_any_bytes_are_records_or_refused(data):
    with contextlib.suppress(LocalSocketError):
        RecordSplitter("a peer").feed(data)


def test_a_record_is_bounded_both_ways():
    largest = Notice(
        "info", "x" * (MAX_RECORD - len(encode_record(Notice("info", "x" * (1 << 16)))) + 4 + (1 << 16))
    )
    encoded = encode_record(largest)
    assert len(encoded) == MAX_RECORD + 4
    assert RecordSplitter("a peer").feed(encoded) == [largest]
    with pytest.raises(LocalSocketError):
        encode_record(Notice("info", largest.sentence + "x"))
    with pytest.raises(LocalSocketError):  # before its bytes come
        RecordSplitter("a peer").feed((MAX_RECORD + 1).to_bytes(4, "little"))


def test_a_part_that_stays_encoded_outlives_its_buffer():
    splitter = RecordSplitter("a peer")
    records = [FrameResult(number, raw(bytes([number] * 50)), 0, 0, 0, 0) for number in range(20)]
    kept = [record for each in records for record in splitter.feed(encode_record(each))]
    assert kept == records
    assert [encode_record(each) for each in kept] == [encode_record(each) for each in records]


@pytest.mark.parametrize(
    ("record", "names"),
    [
        (Notice("info", "x"), ["Notice", "subscriber"]),
        (own_hello("publisher", "abc"), ["publisher", "subscriber"]),
        (Hello("subscriber", "0.0.1", "abc"), ["0.0.1", VERSION]),
        (own_hello("subscriber", "def"), ["def", "abc"]),
    ],
    ids=["no greeting", "role", "version", "deployment"],
)
def test_a_wrong_greeting_is_refused_with_the_expected_one(record, names):
    with pytest.raises(OtherPeerError) as refused:
        check_hello(record, "subscriber", "abc", "here")
    assert [name for name in names if name not in str(refused.value)] == []
    check_hello(own_hello("subscriber", "abc"), "subscriber", "abc", "here")
