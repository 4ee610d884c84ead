import json
import math

import numpy as np
import orjson
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bridge.codecs.json_codec import (
    LONGEST,
    MAX_DEPTH,
    MAX_SIZE,
    decode,
    encode,
    envelope_of,
    find_nonfinite,
    is_deeper,
    topic_of,
)
from bridge.errors import DecodeError, EncodeError

numbers = st.integers(-(2**63), 2**64 - 1) | st.floats()
values = st.recursive(
    st.none() | st.booleans() | numbers | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=20,
)
objects = st.dictionaries(st.text(max_size=5), values, max_size=5)


def nested(levels, inner=0):
    for _ in range(levels):
        inner = {"a": inner}
    return inner


def depth_of(value):
    if not isinstance(value, dict | list):
        return 0
    return 1 + max(map(depth_of, value.values() if isinstance(value, dict) else value), default=0)


# Inbound


@given(objects)
def test_output_of_the_standard_library_is_read(message):
    assert decode(json.dumps(message).encode()) == json.loads(
        orjson.dumps(message)
    )  # both without what is not finite


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": NaN}', {"a": None}),
        ('{"a": [Infinity, -Infinity, 1]}', {"a": [None, None, 1]}),
        ('{"a": 1e999, "b": -1e999}', {"a": None, "b": None}),
        ('{"a": NaN, "b": 1e999}', {"a": None, "b": None}),
        ('{"a": NaN, "b": 18446744073709551616}', {"a": None, "b": 18446744073709551616.0}),
        ('{"a": NaN, "b": 1' + "0" * 400 + "}", {"a": None, "b": None}),
        ('{"a": 18446744073709551615}', {"a": 2**64 - 1}),
        ('{"a": 18446744073709551616}', {"a": 2.0**64}),
        ('{"a": 1, "a": 2}', {"a": 2}),
        ('{"NaN": "Infinity"}', {"NaN": "Infinity"}),
        ('{"topic": "\\/a\\/b"}', {"topic": "/a/b"}),
    ],
)
def test_leaked_nonfinite_numbers_are_none(text, message):
    read = decode(text.encode())
    assert read == message
    assert {key: type(value) for key, value in read.items()} == {k: type(v) for k, v in message.items()}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"42",
        b"[1]",
        b"{",
        b'{"a": nan}',
        b'{"a": NaN',
        b'{"a": NaN, "b": "\\ud800"}',
        b'{"a": NaN, "b": 1' + b"0" * 5000 + b"}",
        b'{"a": NaN, "b": ' + b"[" * 5000 + b"]" * 5000 + b"}",
        b'{"a": "\xff"}',
        b'{"a": NaN, "b": "\xff"}',
    ],
)
def test_malformed_messages_are_refused(data):
    with pytest.raises(DecodeError):
        decode(data)


@given(values, st.integers(0, 5))
def test_depth_is_counted_outside_of_strings(value, limit):
    for text in (json.dumps({"a": value, "[": '\\"[['}), json.dumps([[value, '{"\\']], ensure_ascii=False)):
        data = text.encode("utf-8", "surrogatepass")
        assert is_deeper(data, limit) == (depth_of(json.loads(text)) > limit) or len(data) <= 2 * limit


@pytest.mark.parametrize("filling", [0, 3000])
@pytest.mark.parametrize("leaf", ["", "NaN"])
def test_the_limit_of_depth_is_exact_whatever_the_size(filling, leaf):
    head = '{"x":[' + ",".join(["0.12345"] * (filling // 8)) + "],"  # two levels, and two brackets
    for levels in (1, 2, 62, 63, 64, 65, 200):
        message = f'{head}"a":{"[" * levels}{leaf}{"]" * levels}}}'.encode()
        value = {"x": [0.12345] * (filling // 8), "a": []}
        for _ in range(levels - 1):
            value["a"] = [value["a"]]
        if levels < MAX_DEPTH:
            assert depth_of(decode(message)) == levels + 1
            assert encode(value)
        else:
            with pytest.raises(DecodeError):
                decode(message)
            with pytest.raises(EncodeError):
                encode(value)


# Outbound


def test_bytes_are_base64():
    assert encode({"a": b"\x00\xff", "b": bytearray(b"x")}) == b'{"a":"AP8=","b":"eA=="}'


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).astype(">f4"),
        np.arange(12.0)[::2],
        np.arange(6.0).reshape(2, 3).T,
        np.arange(6, dtype=">i8")[::-1],
        np.array(1.5, ">f8"),
        np.arange(3, dtype=np.float16),
        np.array([1, 2**32 - 1], dtype=np.uint32),
        np.bool_(True),
    ],
)
def test_arrays_of_any_layout(array):
    message = {"deep": [{"a": array}], "s": np.float32(0.5), "t": (np.int8(1), None)}
    expected = {"deep": [{"a": array.tolist()}], "s": 0.5, "t": [1, None]}
    assert json.loads(encode(message)) == expected


@pytest.mark.parametrize("before", ["", "n" * 2000, "an" * 700, "x" * 2000])
def test_a_nan_is_found_wherever_it_is(before):
    for message in ({"a": before, "b": math.nan}, {"b": [math.inf], "a": before}):
        with pytest.raises(EncodeError, match="^b"):
            encode(message)
    assert encode({"a": before, "b": 1.5, "c": "null", "d": None})


@given(objects)
def test_nothing_nonfinite_leaves(message):
    try:
        json.loads(encode(message), parse_constant=pytest.fail)
    except EncodeError:
        assert find_nonfinite(message) is not None
    else:
        assert find_nonfinite(message) is None


@pytest.mark.parametrize(
    ("message", "place"),
    [
        ({"a": math.nan}, "a"),
        ({"a": {"b": [1.0, {"c": math.inf}]}}, r"a\.b\[1\]\.c"),
        ({"a": np.array([1.0, 2.0, -math.inf])}, r"a\[2\]"),
        ({"a": np.float32("nan")}, "a"),
        ({"a": np.array([[1, 2], [3, math.nan]])}, r"a\[1\]\[1\]"),
        ({"ok": None, "a": (1.0, math.nan)}, r"a\[1\]"),
        ({"a": np.array([[1, np.nan]], ">f4"), "b": None}, r"a\[0\]\[1\]"),
        ({"a": np.array([[1, 0, np.nan]])[:, ::2], "b": None}, r"a\[0\]\[1\]"),
    ],
)
def test_a_refused_number_is_named_with_its_place(message, place):
    with pytest.raises(EncodeError, match=f"^{place} "):
        encode(message)


@pytest.mark.parametrize(
    "message",
    [
        {"a": memoryview(b"bytes")},
        {"a": object()},
        {1: 2},
        {"a": 2**64},
        {"a": "\ud800"},
        {"a": np.zeros(2, complex)},
        {"other": np.arange(3, dtype=">f8"), "a": np.array([object()], object)},
    ],
)
def test_values_without_a_json_form_are_refused(message):
    with pytest.raises(EncodeError):
        encode(message)


def test_the_limits_of_size_and_of_what_goes_out():
    text, size = encode({"a": "x" * (MAX_SIZE - 8)}), f"{MAX_SIZE + 1} bytes"
    assert len(text) == MAX_SIZE
    decode(text)
    with pytest.raises(DecodeError, match=size):
        decode(text + b" ")
    with pytest.raises(EncodeError, match=size):
        encode({"a": "x" * (MAX_SIZE - 7)})
    encode(nested(MAX_DEPTH))
    loop = {}
    loop["a"] = loop
    for message in (loop, *(nested(levels) for levels in (MAX_DEPTH + 1, 250, 260, 5000))):
        with pytest.raises(EncodeError):
            encode(message)


# Envelopes: the bytes before a message, which tell its topic

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
