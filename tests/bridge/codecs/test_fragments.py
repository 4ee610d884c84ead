"""Fragments: those of real servers, in any order, and hostile ones that must not exhaust memory."""

import json
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.codecs.fragments import MAX_FRAGMENTS, OVERHEAD, Reassembler, split
from bridge.errors import DecodeError


def fragment(num, data, total, key="a"):
    return {"op": "fragment", "id": key, "data": data, "num": num, "total": total}


def pieces_of(message, size, key="a"):
    return [json.loads(piece) for piece in split(message.encode(), size, key)]


def take_all(box, fragments, now=0.0):
    return [whole.decode() for each in fragments if (whole := box.take(each, now)) is not None]


def test_a_message_that_does_not_fit_is_cut_between_characters():
    assert list(split(b'{"op":"x"}', 10, "a")) == [b'{"op":"x"}']
    pieces = pieces_of('"\u00e4\U0001f600\u00e4\u00e4"', 3)
    assert [piece["data"] for piece in pieces] == ['"\u00e4', "\U0001f600", "\u00e4", '\u00e4"']
    assert [(piece["num"], piece["total"], piece["id"]) for piece in pieces] == [
        (n, 4, "a") for n in range(4)
    ]


@given(st.text(min_size=1), st.integers(1, 40), st.randoms(use_true_random=False))
def test_fragments_may_arrive_in_any_order(text, size, order):
    message = json.dumps({"op": "publish", "msg": text}, ensure_ascii=False)
    try:
        message.encode()
    except UnicodeEncodeError:
        return  # half a character is not a message
    pieces = pieces_of(message, size)
    if len(pieces) == 1:
        return
    order.shuffle(pieces)
    box = Reassembler()
    assert [box.take(piece, 0.0) for piece in pieces[:-1]] == [None] * (len(pieces) - 1)
    assert box.take(pieces[-1], 0.0) == message.encode()
    assert (len(box), box.waiting_bytes) == (0, 0)


@pytest.mark.parametrize("length", [101, 150, 199, 200, 201, 236])
def test_the_reference_server_forgets_to_round_the_total(length):
    text = "x" * length
    total = (length - 1) / 100 + 1
    parts = [text[at : at + 100] for at in range(0, length, 100)]
    assert take_all(Reassembler(), [fragment(n, part, total) for n, part in enumerate(parts)]) == [text]


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("write", [int, float, str, lambda n: f"{n}.0"])
def test_numbers_from_0_or_1_of_any_kind(first, write):
    fragments = [fragment(write(first + n), part, write(3)) for n, part in enumerate("abc")]
    random.Random(1).shuffle(fragments)
    assert take_all(Reassembler(), fragments) == ["abc"]


@pytest.mark.parametrize(
    ("fragments", "messages"),
    [
        ([fragment(0, "abc", 1), fragment(1, "abc", 1.0)], ["abc", "abc"]),
        ([fragment(0, "a", 2), fragment(0, "a", 2), fragment(1, "b", 2)], ["ab"]),
        ([fragment(0, "old", 2), fragment(0, "new", 2), fragment(1, "er", 2)], ["newer"]),
        ([fragment(0, "a", 3), fragment(0, "a", 2), fragment(1, "b", 2)], ["ab"]),
        (
            [fragment(n, f"{key}{n}", 2, key) for n in (0, 1) for key in ("a", 7, "7")],
            ["a0a1", "7071", "7071"],
        ),
    ],
    ids=["single", "repeated", "id used again", "total changed", "mixed"],
)
def test_fragments_that_repeat_or_mix(fragments, messages):
    box = Reassembler()
    assert take_all(box, fragments) == messages
    assert len(box) == 0


@pytest.mark.parametrize(
    "broken",
    [
        {},
        fragment(0, "a", 2, True),
        fragment(0, "a", 2, "x" * 2000),
        fragment(0, "a", 2, 10**2000),
        fragment(0, None, 2),
        fragment(0, "a", 0),
        fragment(0, "a", True),
        fragment(0, "a", "9" * 5000),
        fragment(0, "a", math.inf),
        fragment(0, "a", math.nan),
        fragment(0, "a", MAX_FRAGMENTS + 1),
        fragment(-1, "a", 2),
        fragment(3, "a", 2),
        fragment(0.5, "a", 2),
        fragment("-1", "a", 2),
        fragment([0], "a", 2),
    ],
)
def test_malformed_fragments_are_refused(broken):
    box = Reassembler()
    with pytest.raises(DecodeError) as caught:
        box.take(broken, 0.0)
    assert len(str(caught.value)) < 200
    assert len(box) == 0


@pytest.mark.parametrize(
    ("taken", "refused"),
    [
        ([fragment(0, "a", 2)], fragment(2, "c", 2)),  # a hole
        ([fragment(0, "x" * 600, 3)], fragment(1, "x" * 600, 3)),
        ([fragment(number, "", 60000) for number in range(35)], fragment(35, "", 60000)),  # no content
    ],
)
def test_a_message_that_cannot_become_whole_or_is_too_large_is_given_up(taken, refused):
    box = Reassembler(max_size=1000)
    assert take_all(box, taken) == []
    with pytest.raises(DecodeError):
        box.take(refused, 0.0)
    assert (len(box), box.waiting_bytes) == (0, 0)
    with pytest.raises(DecodeError, match="more than 1000 bytes"):
        box.take(fragment(0, "x" * 1001, 1), 0.0)
    assert (len(box), box.waiting_bytes) == (0, 0)


def test_messages_that_never_end_are_bounded_in_time_and_charged_in_bytes():
    box = Reassembler()
    box.take(fragment(0, "\N{GRINNING FACE}" * 100, 2), 0.0)
    assert box.waiting_bytes == 400 + OVERHEAD  # one such character makes Python store four bytes each
    box.clear()
    box.take(fragment(0, "a", 3), 0.0)
    box.take(fragment(1, "b", 3), 9.0)
    box.take(fragment(0, "z", 3, "other"), 18.0)
    assert len(box) == 2, "a fragment gives its message more time"
    box.take(fragment(1, "z", 3, "other"), 20.0)
    assert len(box) == 1
    box.clear()
    assert (len(box), box.waiting_bytes) == (0, 0)
