"""Framing of the local sockets: any split of the bytes gives the same records, anything else is refused.

encode_record --bytes--> [split anywhere] --> RecordSplitter --> records
"""

import socket
import threading
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.errors import LocalSocketError, OtherPeerError
from services.sockets.local_socket import (
    MAX_RECORD,
    BlockingRecordSocket,
    RecordSplitter,
    check_hello,
    encode_record,
    own_hello,
)
from services.sockets.records import Frame, FrameResult, Hello, Notice


def raw(value) -> msgspec.Raw:
    return msgspec.Raw(msgspec.msgpack.encode(value))


small = st.integers(0, 2**40)
records = st.one_of(
    st.builds(
        Frame, number=small, addresses=st.lists(st.none() | st.integers(0, 2**16), max_size=40), bank=small
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
    splitter = RecordSplitter("a peer")
    try:
        splitter.feed(data)
    except LocalSocketError as error:
        assert "a peer" in str(error)


def test_a_length_beyond_the_limit_is_refused_before_its_bytes_come():
    with pytest.raises(LocalSocketError, match="announced a record of"):
        RecordSplitter("a peer").feed((MAX_RECORD + 1).to_bytes(4, "little"))


def test_a_record_beyond_the_limit_is_not_sent():
    with pytest.raises(LocalSocketError, match="more than"):
        encode_record(Notice("info", "x" * MAX_RECORD))


@pytest.mark.parametrize(
    ("record", "match"),
    [
        (Notice("info", "x"), "did not greet"),
        (own_hello("publisher", "abc"), "expected a subscriber there, found a publisher"),
        (Hello("subscriber", "0.0.1", "abc"), "rosbayes 0.0.1"),
        (own_hello("subscriber", "def"), "give both the same deployment"),
    ],
)
def test_a_wrong_greeting_says_what_was_expected(record, match):
    with pytest.raises(OtherPeerError, match=match):
        check_hello(record, "subscriber", "abc", "here")


def test_the_right_greeting_passes():
    check_hello(own_hello("subscriber", "abc"), "subscriber", "abc", "here")


def test_the_blocking_socket_sends_large_records_whole_and_sees_the_end():
    ours, theirs = socket.socketpair()
    record = FrameResult(1, raw(bytes(3_000_000)), 0, 0, 0, 0)
    got = []

    def read() -> None:
        splitter = RecordSplitter("us")
        while data := theirs.recv(65536):
            got.extend(splitter.feed(data))

    reader = threading.Thread(target=read)
    reader.start()
    with BlockingRecordSocket(ours, "them") as sender:
        assert sender.receive() == []
        assert sender.send(record)
    reader.join(60)
    assert got == [record]


def test_the_blocking_socket_gives_up_on_a_peer_that_does_not_read():
    ours, theirs = socket.socketpair()
    with BlockingRecordSocket(ours, "them", send_timeout=0.05) as sender, theirs:
        assert not sender.send(FrameResult(1, raw(bytes(4_000_000)), 0, 0, 0, 0))


def test_the_blocking_socket_tells_a_closed_peer():
    ours, theirs = socket.socketpair()
    with BlockingRecordSocket(ours, "them") as receiver:
        theirs.close()
        assert receiver.receive() is None
