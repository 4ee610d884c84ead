"""The campaign's observer, on runs in which a bug is planted."""

import copy

import pytest

from scripts.campaigning.judging.accounts import Counters, Excuses, Overdue, judge
from scripts.campaigning.judging.expected import (
    BANKS,
    LINES,
    BoardOutcome,
    Outcome,
    UnusableError,
    addresses_of,
)
from scripts.campaigning.judging.observer import Flaw, Observer, Reading
from scripts.campaigning.round import Round
from scripts.campaigning.stack import Topology

NAMES = ("campaign1", "campaign2")


def outcome(name, addresses, bank):
    """Outcomes that differ for each deployment, reading and bank."""
    weights = [1 + (line * (3 + NAMES.index(name)) + sum(addresses) * 5 + bank) % 13 for line in range(LINES)]
    total = sum(weights)
    half = LINES // 2
    boards = (
        BoardOutcome(200 + bank, sum(weights[:half]), "overflow"),
        BoardOutcome(256, sum(weights[half:]), "slice"),
    )
    return Outcome(tuple(each / total for each in weights), boards)


def stamp(index):
    return 1_700_000_000 * 10**9 + index


def report(index, number, *, deployment=0):
    right = outcome(NAMES[deployment], (index, index), number % BANKS)
    boards = [
        {
            "hardware_id": f"board{at}",
            "level": 0,
            "message": board.reason,
            "values": [
                {"key": key, "value": str(value)}
                for key, value in (
                    ("cycles", board.cycles),
                    ("counts_total", board.total),
                    ("reason", board.reason),
                )
            ],
        }
        for at, board in enumerate(right.boards)
    ]
    values = {
        "number": number,
        "published": "true",
        "cycles": max(board.cycles for board in right.boards),
        "counts_total": sum(board.total for board in right.boards),
    }
    first = {"hardware_id": NAMES[deployment], "level": 0, "message": "posterior"}
    first["values"] = [{"key": key, "value": str(value)} for key, value in values.items()]
    secs, nsecs = divmod(stamp(index), 10**9)
    return {"header": {"stamp": {"secs": secs, "nsecs": nsecs}}, "status": [first, *boards]}


def result(index, number):
    data = list(outcome(NAMES[0], (index, index), number % BANKS).posterior)
    dim = [{"label": "x", "size": LINES, "stride": LINES}]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": data}


class Recording:
    """Eight readings and their results, 0.1 s apart, in a list that a test may spoil before it is played."""

    def __init__(self):
        self.events = []
        for index in range(8):
            self.events.append(("reading", index, index * 0.1))
            self.events.append(("report", report(index, index + 1), index * 0.1 + 0.05))
            self.events.append(("result", result(index, index + 1), index * 0.1 + 0.05))
        self.counters = Counters(8, 8)
        self.excuses = Excuses()

    def message(self, kind, index):
        """The message of a reading, to be changed in its place."""
        return self.events[3 * index + ("reading", "report", "result").index(kind)][1]

    def value(self, index, key, value, *, status=0):
        pairs = self.message("report", index)["status"][status]["values"]
        next(pair for pair in pairs if pair["key"] == key)["value"] = value

    def play(self):
        observer = Observer(outcome, NAMES[0])
        for kind, what, now in self.events:
            if kind == "reading":
                observer.published(stamp(what), (what, what), now)
                observer.forwarded(stamp(what))
            elif kind == "fault":
                observer.fault()
            elif kind == "calm":
                observer.calm()
            else:
                getattr(observer, kind)(copy.deepcopy(what), now)
        observer.findings += judge(self.counters, observer.pending_readings(), self.excuses, 1.0)
        return {finding.flaw for finding in observer.findings}


def stale(run):
    run.message("result", 4)["data"] = run.message("result", 3)["data"]


def swapped_boards(run):
    data = run.message("result", 4)["data"]
    data[:] = data[LINES // 2 :] + data[: LINES // 2]


def swapped_board_reports(run):
    status = run.message("report", 4)["status"]
    status[1], status[2] = status[2], status[1]


def wrong_reading(run):
    """A result is paired with the reading after its own, as without sequence numbers."""
    run.events[3 * 4 + 2] = ("result", result(5, 5), 0.45)


def wrong_reading_throughout(run):
    run.events[3 * 4 + 1] = ("report", report(3, 5), 0.45)


def cycles_off_by_one(run):
    run.value(4, "cycles", "257")
    run.value(4, "cycles", "257", status=2)


def slice_too_early(run):
    run.value(4, "cycles", "128", status=2)


def counts_off_by_one(run):
    run.value(4, "counts_total", "1", status=1)


def sums_disagree(run):
    run.value(4, "counts_total", "1")


def wrong_reason(run):
    status = run.message("report", 4)["status"][1]
    status["message"] = "max cycles"
    run.value(4, "reason", "max cycles", status=1)


def board_without_report(run):
    run.message("report", 4)["status"].pop()


def duplicated(run):
    run.events[3 * 4 + 3 : 3 * 4 + 3] = run.events[3 * 4 + 1 : 3 * 4 + 3]


def duplicated_with_another_number(run):
    again = [("report", report(7, 9), 0.8), ("result", result(7, 9), 0.8)]
    run.events += again


def repeated_result(run):
    run.events.insert(3 * 4 + 3, run.events[3 * 4 + 2])


def out_of_order(run):
    del run.events[10:12]
    later = [("report", report(3, 6), 0.5), ("result", result(3, 6), 0.5)]
    run.events[13:13] = later


def number_falls(run):
    run.value(4, "number", "1")


def number_of_another_bank(run):
    """A wrong frame number: the bank, and so the result, is another."""
    run.value(7, "number", "9")


def lost_uncounted(run):
    del run.events[3 * 7 + 1 :]
    run.counters = Counters(8, 7)


def lost_on_the_way(run):
    """The publisher counts a result that never arrives."""
    del run.events[3 * 7 + 1 :]


def counted_twice(run):
    run.counters = Counters(8, 8, {"passed over": 1})


def forgotten_result(run):
    """The counters know nothing of a result that arrived."""
    run.counters = Counters(8, 7, {"failed on a board": 1})


def wrong_layout(run):
    run.message("result", 4)["layout"]["dim"][0]["stride"] = 1


def wrong_label(run):
    run.message("result", 4)["layout"]["dim"][0]["label"] = "y"


def shorter(run):
    run.message("result", 4)["data"].pop()


def nan(run):
    run.message("result", 4)["data"][3] = float("nan")


def null(run):
    run.message("result", 4)["data"][3] = None


def not_normalised(run):
    data = run.message("result", 4)["data"]
    data[:] = [each / 2 for each in data]


def last_bit(run):
    data = run.message("result", 4)["data"]
    data[3] += 2**-54


def unknown_stamp(run):
    run.message("report", 4)["header"]["stamp"]["nsecs"] += 1000


def without_report(run):
    del run.events[3 * 4 + 1]


def without_result(run):
    run.events[3 * 7 + 1 :] = []
    del run.events[3 * 4 + 2]


def unfinished_report(run):
    del run.message("report", 4)["status"][0]["values"][0]


def said_to_have_none(run):
    run.value(4, "published", "false")


def other_tables(run):
    """The report names another deployment than the folder of the master."""
    run.events[13] = ("report", report(4, 5, deployment=1), 0.45)


BUGS = {
    stale: Flaw.WRONG,
    swapped_boards: Flaw.WRONG,
    swapped_board_reports: Flaw.WRONG,
    wrong_reading: Flaw.WRONG,
    wrong_reading_throughout: Flaw.WRONG,
    cycles_off_by_one: Flaw.WRONG,
    slice_too_early: Flaw.WRONG,
    counts_off_by_one: Flaw.WRONG,
    sums_disagree: Flaw.WRONG,
    wrong_reason: Flaw.WRONG,
    board_without_report: Flaw.WRONG,
    duplicated: Flaw.DUPLICATE,
    duplicated_with_another_number: Flaw.DUPLICATE,
    repeated_result: Flaw.UNREPORTED,
    out_of_order: Flaw.OUT_OF_ORDER,
    number_falls: Flaw.OUT_OF_ORDER,
    number_of_another_bank: Flaw.WRONG,
    lost_uncounted: Flaw.UNCOUNTED,
    lost_on_the_way: Flaw.UNCOUNTED,
    counted_twice: Flaw.MISCOUNTED,
    forgotten_result: Flaw.MISCOUNTED,
    wrong_layout: Flaw.MALFORMED,
    wrong_label: Flaw.MALFORMED,
    shorter: Flaw.MALFORMED,
    nan: Flaw.MALFORMED,
    null: Flaw.MALFORMED,
    not_normalised: Flaw.MALFORMED,
    last_bit: Flaw.WRONG,
    unknown_stamp: Flaw.UNKNOWN,
    without_report: Flaw.UNREPORTED,
    without_result: Flaw.WITHOUT_RESULT,
    unfinished_report: Flaw.MALFORMED,
    said_to_have_none: Flaw.WRONG,
    other_tables: Flaw.WRONG,
}


def test_a_right_run_has_no_findings():
    assert Recording().play() == set()


@pytest.mark.parametrize("plant", BUGS, ids=lambda plant: plant.__name__)
def test_a_planted_bug_is_found(plant):
    run = Recording()
    plant(run)
    assert BUGS[plant] in run.play()


def faulty(run, lost):
    """Cut off the results of the last readings by a fault."""
    run.events = [each for at, each in enumerate(run.events) if at < 3 * (8 - lost) or at % 3 == 0]
    run.events.insert(3 * (8 - lost), ("fault", None, 0.6))


def test_readings_and_results_that_a_fault_cuts_off_are_excused():
    run = Recording()
    faulty(run, 2)
    run.counters = Counters(7, 7)
    run.excuses = Excuses(readings=True, results=True, until=0.8)
    assert run.play() == set()


def test_a_fault_excuses_only_readings_before_the_recovery():
    run = Recording()
    del run.events[-2:]
    run.events[-1] = ("reading", 7, 0.9)
    run.counters = Counters(7, 7)
    run.excuses = Excuses(readings=True, results=True, until=0.8)
    assert run.play() == {Flaw.UNCOUNTED}


def test_a_reading_that_comes_after_the_counters_were_read_is_counted_next_time():
    observer = Observer(outcome, NAMES[0])
    observer.published(stamp(0), (0, 0), 0.0)
    observer.settle()
    observer.forwarded(stamp(0))
    assert judge(Counters(1, 0, {"passed over": 1}), observer.pending_readings(), Excuses(), 1.0) == []
    observer.settle()
    assert not observer.pending_readings()


@pytest.mark.parametrize(
    ("added", "arrives", "flaws"),
    [
        (Counters(7, 8), True, set()),
        (Counters(7, 7, {"passed over": 1}), False, set()),
        (Counters(7, 7), False, set()),
        (Counters(7, 8), False, {Flaw.UNCOUNTED}),
        (Counters(7, 7), True, {Flaw.UNCOUNTED, Flaw.MISCOUNTED}),  # another one is in flight
        (Counters(7, 9), True, {Flaw.MISCOUNTED, Flaw.UNCOUNTED}),
        (Counters(7, 7, {"passed over": 2}), False, {Flaw.MISCOUNTED}),
    ],
)
def test_a_reading_that_was_excused_too_early_is_counted_in_the_next_step(added, arrives, flaws):
    late = Reading(0, (0, 0), 0.0, forwarded=True, settled=True)
    others = [Reading(at, (0, 0), 0.0, forwarded=True, arrived=1.0) for at in range(1, 8)]
    if arrives:
        late.arrived = 1.0
    found = judge(added, others, Excuses(overdue=Overdue([late], 1)), 1.0)
    assert {each.flaw for each in found} == flaws


async def test_a_round_carries_a_late_reading_over_to_its_next_step(tmp_path):
    played = Round(tmp_path, Topology.OWN, [tmp_path / NAMES[0]], outcome, 1, calm_frames=1)
    observer, counted = played.observer, Counters(1, 0)

    async def counters():
        return counted

    def arrive(index, number):
        observer.report(report(index, number), 1.0)
        observer.result(result(index, number), 1.0)

    def publish(index):
        observer.published(stamp(index), (index, index), 0.5)
        observer.forwarded(stamp(index))

    played.stack.counters = counters
    publish(0)
    await played._settle(Excuses(readings=True, until=1.0))
    assert observer.findings == []
    arrive(0, 1)  # the machine was busy, not the stack wrong
    publish(1)
    arrive(1, 2)
    counted = Counters(2, 2)
    await played._settle(Excuses())
    assert observer.findings == []


def test_results_of_a_killed_publisher_may_arrive():
    run = Recording()
    run.counters = Counters(8, 7, {"lost with the publisher": 1})
    assert run.play() == set()


@pytest.mark.parametrize(
    ("values", "addresses"),
    [
        ({"near": 3, "far": 2}, (3, 2)),
        ({"near": 2.5, "far": None}, (3, None)),
        ({"near": float("nan")}, (None, None)),
        ({"near": 1e300, "far": -(10**400)}, (6, 0)),
        ({"near": float("inf"), "far": float("-inf")}, (6, 0)),
    ],
)
def test_addresses_are_those_of_the_deployment(values, addresses):
    assert addresses_of(values) == addresses


def test_a_word_is_not_a_reading():
    with pytest.raises(UnusableError):
        addresses_of({"near": "three", "far": 1})
