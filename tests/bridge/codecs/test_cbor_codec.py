"""CBOR: typed arrays in both directions, and only the types of ROS messages."""

import math
import struct
import subprocess
import sys

import cbor2
import numpy as np
import pytest

from bridge.codecs.cbor_codec import TYPED_ARRAYS, decode, encode_json, typed_array, with_arrays, with_lists
from bridge.errors import DecodeError, EncodeError
from tests.patience import PROCESS_PATIENCE

FORMATS = {69: "H", 70: "I", 71: "Q", 72: "b", 77: "h", 78: "i", 79: "q", 85: "f", 86: "d"}


def written(value):
    return cbor2.dumps({"data": value})


def packed(tag, *values):
    return written(cbor2.CBORTag(tag, struct.pack(f"<{len(values)}{FORMATS[tag]}", *values)))


@pytest.mark.parametrize("tag", FORMATS)
def test_a_typed_array_as_list_and_as_array(tag):
    values = [1, 2, 100] if FORMATS[tag] in "HIQ" else [-1, 0, 100]
    data = packed(tag, *values)
    numbers = decode(data)["data"]
    assert numbers == values
    assert {type(number) for number in numbers} == {float if tag in {85, 86} else int}
    found = decode(data, arrays="numpy")["data"]
    assert isinstance(found, np.ndarray)
    assert found.dtype == np.dtype(TYPED_ARRAYS[tag][0])
    assert found.tolist() == values
    assert not found.flags.writeable
    assert decode(packed(tag))["data"] == []


def test_bytes_of_uint8():
    for data in (written(b"\x01\xff"), written(cbor2.CBORTag(64, b"\x01\xff"))):
        assert decode(data)["data"] == b"\x01\xff"
        found = decode(data, arrays="numpy")["data"]
        assert (found.dtype, found.tolist()) == (np.uint8, [1, 255])


@pytest.mark.parametrize("value", [1, "a", b"abc", [1, 2], {"a": 1}])
def test_no_other_tag_is_taken(value):
    """Some would cost hours (a bigfloat's power), memory, or make an object that holds itself."""
    tags = [tag for tag in [*range(300), 1004, 43000, 55799, 65536, 2**63] if tag not in TYPED_ARRAYS]
    for tag in tags:
        with pytest.raises(DecodeError, match=f"tag {tag} "):
            decode(written(cbor2.CBORTag(tag, value)))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff",
        b"\x80",
        b"\xa0\x00",
        b"\xa1\x41a\x02",
        b"\xa1\x61a",
        b"\xa1\x61\xff\x01",
        bytes.fromhex("a161619b0000ffffffffffff"),
        bytes.fromhex("a161615b0000ffffffffffff"),
        bytes.fromhex("bb0000ffffffffffff"),
        written(cbor2.undefined),
        written(cbor2.CBORSimpleValue(7)),
        written(cbor2.CBORTag(86, b"123")),
        written(cbor2.CBORTag(86, "12345678")),
        written(cbor2.CBORTag(64, 8)),
        written(cbor2.CBORTag(86, cbor2.CBORTag(64, b"12345678"))),
        written(cbor2.CBORTag(64, cbor2.CBORTag(86, b"12345678"))),
        bytes.fromhex("a16161d81c81d81d00"),
        bytes.fromhex("a16161c4821a7fffffff03"),
        b"\xc6" * 100_000,
        b"\xa1\x61a" + b"\x81" * 100_000,
    ],
)
def test_malformed_messages_are_refused(data):
    for arrays in ("list", "numpy"):
        with pytest.raises(DecodeError) as caught:
            decode(data, arrays=arrays)
        assert len(str(caught.value)) < 300
        assert "\n" not in str(caught.value)


def test_limits_of_size_and_depth():
    message = {"a": 1}
    for _ in range(9):
        message = {"a": message}
    assert decode(cbor2.dumps(message), max_depth=10) == message
    with pytest.raises(DecodeError):
        decode(cbor2.dumps(message), max_depth=9)
    size = len(cbor2.dumps(message))
    assert decode(cbor2.dumps(message), max_size=size)
    with pytest.raises(DecodeError, match=f"at most {size - 1}"):
        decode(cbor2.dumps(message), max_size=size - 1)


def test_lists_of_floats_are_packed():
    message = {"ints": [1, 2], "mixed": [1.5, "a"], "empty": []}
    floats = {"floats": [1.5, 2, None, math.inf], "nested": [[1.5], [2.5]]}
    read = cbor2.loads(encode_json(message | floats))
    assert {name: read[name] for name in message} == message
    assert [tag.tag for tag in (read["floats"], *read["nested"])] == [86] * 3
    one, two, nothing, infinite = decode(encode_json(floats))["floats"]
    assert (one, two, infinite) == (1.5, 2.0, math.inf)
    assert math.isnan(nothing)
    assert decode(encode_json({"a": [1.5, 2**63]}))["a"] == [1.5, 2.0**63]


def test_typed_arrays_of_anything():
    assert decode(written(typed_array([1, 2], "i4")), arrays="numpy")["data"].dtype == np.int32
    assert decode(written(typed_array([0, 1, 2], "u1")))["data"] == b"\x00\x01\x02"
    for values, elements in [([300], "u1"), (["a"], "f8"), ([1.5], "i4")]:
        with pytest.raises(EncodeError):
            typed_array(values, elements)


def test_lists_of_numbers_become_arrays():
    message = with_arrays(
        {
            "floats": [1.5, 2, None],
            "ints": [1, -2],
            "large": [2**64 - 1, 0],
            "beyond": [2**64 - 1, -1],
            "texts": ["a"],
            "flags": [True, False],
            "nulls": [None],
            "gaps": [1, None],
            "empty": [],
            "deep": [{"x": [1.5]}, [2.5, 3.5]],
            "text": "abc",
        }
    )
    floats = message["floats"]
    assert (floats.dtype, floats[:2].tolist(), math.isnan(floats[2])) == (np.float64, [1.5, 2.0], True)
    assert (message["ints"].dtype, message["ints"].tolist()) == (np.int64, [1, -2])
    assert (message["large"].dtype, message["large"].tolist()) == (np.uint64, [2**64 - 1, 0])
    assert message["deep"][0]["x"].tolist() == [1.5]
    assert message["deep"][1].tolist() == [2.5, 3.5]
    left = {"beyond", "texts", "flags", "nulls", "gaps", "empty"}
    assert {name for name in message if isinstance(message[name], list)} == left | {"deep"}


def test_arrays_become_lists():
    message = {"a": np.array([1.5]), "b": [{"c": np.array([1, 2], np.uint8)}], "d": 1, "e": [np.array([3])]}
    assert with_lists(message) == {"a": [1.5], "b": [{"c": b"\x01\x02"}], "d": 1, "e": [[3]]}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "use",
    [
        "import bridge.client, bridge.discovery",
        "import bridge.fields, bridge.stamps; from bridge.codecs.json_codec import encode; encode({'a': 1.0})",
        "from bridge.codecs.cbor_codec import *; decode(encode_json({'a': [1.5]}))",
    ],
)
def test_nothing_heavy_is_imported_before_it_is_wanted(use):
    code = f"import sys; {use}; assert not {{'rosbags', 'numpy', 'zeroconf'}} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PROCESS_PATIENCE)
