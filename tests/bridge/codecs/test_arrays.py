import math

import numpy as np

from bridge.codecs.cbor_codec import with_arrays, with_lists


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
