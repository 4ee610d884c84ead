"""The bytes before a message, which tell its topic or are no envelope."""

import orjson
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bridge.codecs.json_codec import LONGEST, envelope_of, topic_of

CANONICAL = b'{"op":"publish","topic":"/t","msg":'


def test_the_bytes_before_a_message_are_its_envelope():
    assert envelope_of(CANONICAL + b'{"msg":1}}') == CANONICAL
    assert envelope_of(b'{"op":"status"}') == b""
    assert envelope_of(b'{"op":"publish","topic":"' + b"t" * LONGEST + b'","msg":{}}') == b""


@pytest.mark.parametrize(
    ("envelope", "topic"),
    [
        (CANONICAL, "/t"),
        (b'{"op": "publish", "topic": "/t", "msg": ', "/t"),
        (b'{"topic":"\\/t","op":"publish","msg":', "/t"),
        (b'{"op":"publish","msg":{},"topic":"/t","msg":', "/t"),
        (b"", None),
        (b'{"op":"publish","topic":"/t","msg"', None),
        (b'{"op":"publish","topic":"/t","id":1,"msg":', None),
        (b'{"op":"publish","topic":7,"msg":', None),
        (b'{"op":"status","topic":"/t","msg":', None),
        (b'{"op":"publish","topic":"/t","msg":{"a":', None),
        (b'{"op":"publish","topic":"/t","msg":{},"x":', None),
        (b'{"op":"publish","topic":"/t","msg":"', None),
        (b'{"op":"publish","msg":{},"topic":', None),
        (CANONICAL + b"{}}", None),
    ],
)
def test_an_envelope_tells_its_topic_and_other_beginnings_are_none(envelope, topic):
    assert topic_of(envelope) == topic


@settings(max_examples=500, deadline=None)
@given(
    st.lists(
        st.sampled_from([*b'{}[]":, \\', *b'"op""topic""msg""publish""/t"']).map(lambda byte: bytes([byte]))
        | st.sampled_from([b'"op":"publish"', b'"topic":"/t"', b'"topic":"/u"', b'"msg":', b"{}", b","]),
        max_size=12,
    ).map(b"".join)
)
@example(b'"op":"publish","msg":{},"topic":"/t","msg":')
def test_a_proven_envelope_says_the_same_around_any_message(middle):
    envelope = b"{" + middle
    topic = topic_of(envelope)
    if topic is not None:
        for message in (b"{}", b'{"a":1}', b'{"op":"x","topic":"y","msg":{}}', b' {"}":"{"} '):
            whole = orjson.loads(envelope + message + b"}")
            assert whole == {"op": "publish", "topic": topic, "msg": orjson.loads(message)}
