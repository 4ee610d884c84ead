"""The synchroniser: sets of one instant, whatever the order of the messages."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.pipeline.synchroniser import ALIVE_PERIODS, DEPTH, Synchroniser

MS = 1_000_000
TOLERANCE = 50 * MS


def sets_of(needed, arrivals, tolerance=TOLERANCE):
    """Add messages (topic, stamp, receipt: ms) in order of receipt, and return all sets, by time as a loop would."""
    synchroniser = Synchroniser(needed, tolerance)
    sets = []

    def take(tick):
        while (found := synchroniser.take_set(tick)) is not None:
            sets.append(found)

    for at, stamp, receipt in sorted(arrivals, key=lambda each: each[2]):
        while synchroniser.deadline is not None and synchroniser.deadline <= receipt * MS:
            take(synchroniser.deadline)
        synchroniser.add(at, round(stamp * MS), receipt * MS, stamp)
        take(receipt * MS)
    for _ in range(len(arrivals)):
        if synchroniser.deadline is not None:
            take(synchroniser.deadline)
    return sets, synchroniser


def test_a_set_is_complete_with_its_last_message():
    synchroniser = Synchroniser([False] * 2, TOLERANCE)
    synchroniser.add(0, 0, 5, "a")
    assert synchroniser.take_set(5) is None
    assert synchroniser.deadline == 5 + TOLERANCE
    synchroniser.add(1, 0, 6, "b")
    assert synchroniser.take_set(6) == {0: "a", 1: "b"}
    assert synchroniser.deadline is None


@pytest.mark.parametrize("repeated", [[], [(1, 100, 101)]], ids=["once", "a message came twice"])
def test_a_topic_whose_next_message_is_far_is_not_waited_for(repeated):
    arrivals = [(at, t, t) for t in range(0, 300, 100) for at in range(2)] + repeated
    _, synchroniser = sets_of([True, False], arrivals)
    synchroniser.add(0, 210 * MS, 210 * MS, 210)
    assert synchroniser.take_set(210 * MS) == {0: 210}


def test_a_second_message_of_an_instant_waits_for_no_partner():
    synchroniser = sets_of([True, False], [(0, 0, 0), (1, 0, 1)])[1]
    synchroniser.add(0, 0, 2 * MS, "again")
    assert synchroniser.take_set(2 * MS) == {0: "again"}


@pytest.mark.parametrize(
    ("silence", "waits"), [(ALIVE_PERIODS * 100, True), (ALIVE_PERIODS * 100 + 1, False)]
)
def test_a_topic_is_alive_for_some_periods(silence, waits):
    arrivals = [(at, t, t) for t in range(0, 300, 100) for at in range(2)]
    _, synchroniser = sets_of([True, False], arrivals)
    tick = (200 + silence) * MS
    synchroniser.add(0, tick, tick, "late")
    assert (synchroniser.take_set(tick) is None) is waits
    assert synchroniser.absent == []


def test_a_slow_topic_delays_nothing_between_its_messages():
    """A topic of 1 Hz beside one of 100 Hz belongs to the nearest of its sets only."""
    fast = [(0, t, t) for t in range(0, 3000, 10)]
    slow = [(1, t, t + 1) for t in range(3, 3000, 1000)]
    sets, synchroniser = sets_of([True, False], fast + slow)
    assert [set_[0] for set_ in sets] == list(range(0, 3000, 10))
    assert [set_ for set_ in sets[100:] if len(set_) == 2] == [{0: 1000, 1: 1003}, {0: 2000, 1: 2003}]
    assert synchroniser.unpaired <= 1  # the first one, before its period was known


def test_a_set_waits_from_the_message_that_completed_its_needed_topics():
    synchroniser = Synchroniser([True, True, False], TOLERANCE)
    synchroniser.add(0, 10, 5, "a")
    synchroniser.add(1, 0, 8, "b")  # the pivot is a, which came before
    assert synchroniser.take_set(8) is None
    assert synchroniser.deadline == 8 + TOLERANCE
    assert synchroniser.take_set(7 + TOLERANCE) is None
    assert synchroniser.deadline == 8 + TOLERANCE  # looking again does not prolong it
    assert synchroniser.take_set(8 + TOLERANCE) == {0: "a", 1: "b"}


def test_a_set_without_needed_topics_ends_with_its_newest_message():
    synchroniser = Synchroniser([False] * 2, TOLERANCE)
    synchroniser.add(0, 0, 1, "a")
    synchroniser.add(1, 30 * MS, 2, "b")
    assert synchroniser.take_set(1 + TOLERANCE) == {0: "a", 1: "b"}
    synchroniser.add(0, 20 * MS, 2 + TOLERANCE, "older")
    assert (synchroniser.take_set(10 * TOLERANCE), synchroniser.unpaired) == (None, 1)
    synchroniser.add(0, 40 * MS, 3 + TOLERANCE, "newer")
    assert (synchroniser.take_set(10 * TOLERANCE), synchroniser.unpaired) == ({0: "newer"}, 1)


@pytest.mark.parametrize("late", [300, 345], ids=["same stamp", "within half a period"])
def test_a_late_message_of_an_optional_topic_makes_no_set_of_its_own(late):
    arrivals = [(at, t, t) for t in range(0, 300, 100) for at in range(2)]
    sets, synchroniser = sets_of(
        [False] * 2, [*arrivals, (0, 300, 300), (1, late, 360), (0, 400, 400), (1, 400, 401)]
    )
    assert sets[-2:] == [{0: 300}, {0: 400, 1: 400}]
    assert synchroniser.unpaired == 1
    again, synchroniser = sets_of([False] * 2, [(0, 0, 0), (1, 0, 1), (1, 0, 2)])
    assert (again, synchroniser.unpaired) == ([{0: 0, 1: 0}], 1)


def test_stamps_pair_up_to_the_tolerance():
    assert sets_of([True] * 2, [(0, 0, 1), (1, 50, 2)])[0] == [{0: 0, 1: 50}]
    assert sets_of([True] * 2, [(0, 0, 1), (1, 50.001, 2)])[0] == []


def test_stamps_that_begin_again_are_a_new_beginning():
    """A bag that is played twice, or a simulation that starts again."""
    once = [(at, 1000 * 100 + 100 * turn, 100 * turn) for turn in range(5) for at in range(2)]
    again = [(at, 100 * turn, 1000 + 100 * turn) for turn in range(5) for at in range(2)]
    for needed in ([True] * 2, [False] * 2):
        sets, _ = sets_of(needed, [*once[:-1], *again])
        assert sets[-5:] == [{0: 100 * turn, 1: 100 * turn} for turn in range(5)]


def test_an_endless_topic_without_partner_stays_bounded():
    sets, synchroniser = sets_of([True] * 2, [(0, t, t) for t in range(DEPTH + 11)])
    assert (sets, synchroniser.unpaired) == ([], 11)
    synchroniser.forget()
    assert synchroniser.unpaired == DEPTH + 11


@st.composite
def instants(draw):
    """Messages of instants: each topic has every n-th, with jitter, delay, and at most two drop-outs in a row."""
    topics = draw(st.integers(2, 4))
    needed = draw(st.lists(st.booleans(), min_size=topics, max_size=topics))
    spacing = draw(st.integers(75, 400))
    length = draw(st.integers(6, 16))
    arrivals, truth = [], [dict[int, int]() for _ in range(length)]
    jitter = draw(st.sampled_from([0, 5]))
    for at in range(topics):
        every = draw(st.sampled_from([1, 1, 1, 2, 3]))
        last = 0
        dropped = 0
        for turn in range(0, length, every):
            dropped = dropped + 1 if turn > 2 * every and dropped < 2 and draw(st.integers(0, 3)) == 0 else 0
            if dropped:
                continue
            stamp = 1000 + turn * spacing + draw(st.integers(-jitter, jitter))
            last = max(last, stamp + draw(st.integers(0, 25)))
            arrivals.append((at, stamp, last))
            truth[turn][at] = stamp
    return needed, draw(st.permutations(arrivals)), truth


@given(instants())
def test_any_order_gives_the_sets_of_a_plain_offline_pairing(case):
    needed, arrivals, truth = case
    wanted = [
        instant
        for instant in truth
        if instant and all(at in instant for at, is_needed in enumerate(needed) if is_needed)
    ]
    sets, synchroniser = sets_of(needed, arrivals)
    assert sets == wanted
    synchroniser.forget()
    assert synchroniser.unpaired == len(arrivals) - sum(map(len, sets))


def nearest_pairs(stamps, tolerance):
    """Pair the stamps of two topics plainly: knowing all of them."""
    pairs, (left, right) = [], map(list, stamps)
    while left and right:
        pivot = max(left[0], right[0])
        chosen = [min(each, key=lambda stamp: abs(stamp - pivot)) for each in (left, right)]
        for each, stamp in zip((left, right), chosen, strict=True):
            if abs(stamp - pivot) > tolerance:
                del each[: sum(s < pivot - tolerance for s in each)]
                break
        else:
            pairs.append(tuple(chosen))
            for each, stamp in zip((left, right), chosen, strict=True):
                del each[: each.index(stamp) + 1]
    return pairs


@pytest.mark.parametrize("periods", [(100, 100), (100, 10), (10, 100), (40, 70), (30, 1000)])
@given(data=st.data())
def test_needed_topics_of_any_rates_pair_as_they_would_offline(periods, data):
    phases = [data.draw(st.integers(0, period)) for period in periods]
    stamps = [range(1000 + phase, 4000, period) for phase, period in zip(phases, periods, strict=True)]
    arrivals = [(at, stamp, stamp) for at, each in enumerate(stamps) for stamp in each]
    sets, synchroniser = sets_of([True] * 2, arrivals)
    synchroniser.forget()
    assert synchroniser.unpaired == len(arrivals) - sum(map(len, sets))
    pairs = [(each[0], each[1]) for each in sets]
    wanted = nearest_pairs(stamps, 50)
    # the last ones have no later messages that show they are the nearest
    assert pairs[: len(wanted) - 2] == wanted[: len(pairs)][: len(wanted) - 2]
