"""What pcie-app and publisher read from standard input, alone: readings, results, probabilities."""

import pytest

from services.errors import InputLineError
from services.pcie_app import reading_from_line
from services.publisher import result_from_line


def test_a_reading():
    reading = reading_from_line(b'{"addresses": [1, null], "stamp_ns": 5, "more": "of no interest"}', 1)
    assert (reading.addresses, reading.stamp_ns) == ([1, None], 5)


@pytest.mark.parametrize(
    "line",
    [
        b"3",
        b"x",
        b"{}",
        b'{"addresses": [71.9]}',
        b'{"addresses": [true]}',
        b'{"addresses": ["1"]}',
        b"[" * 10**5,
    ],
)
def test_no_reading(line):
    with pytest.raises(InputLineError, match="line 7 of standard input is no reading .*expected"):
        reading_from_line(line, 7)


def test_a_result_and_an_array():
    counted, stamp = result_from_line(
        b'{"number": 1, "boards": [{"counts": [1, 258], "cycles": 5, "reason": 1}]}', 1, 2
    )
    assert (counted.boards[0].counts, counted.boards[0].cycles, stamp) == (b"\1\0\0\0\2\1\0\0", 5, None)
    assert result_from_line(b"[0.25, 0.75]", 1, 2) == [0.25, 0.75]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"[1, -1]", "is no result"),
        (b"[1e999, 1]", "is no result"),
        (b"[1]", "has 1 values"),
        (b'{"number": 1, "boards": [{"counts": [1, true], "cycles": 5, "reason": 1}]}', "is no result"),
        (b'{"number": 1, "boards": [{"counts": [1, 4294967296], "cycles": 5, "reason": 1}]}', "is no result"),
        (b'{"number": 1, "boards": [{"counts": [1, 2], "cycles": 5, "reason": 9}]}', "is no result"),
        (b'{"number": 1, "boards": [{"counts": [1], "cycles": 5, "reason": 1}]}', "has 1 values"),
    ],
)
def test_no_result(line, said):
    with pytest.raises(
        InputLineError, match=f"line 3 of standard input {said}.*expected a result of pcie-app"
    ):
        result_from_line(line, 3, 2)
