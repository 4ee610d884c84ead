"""The campaign: its observer finds planted bugs."""

import copy
import subprocess
import sys

import pytest

from scripts.campaigning.accounts import (
    FAILED,
    PASSED_OVER,
    ROSBRIDGE_AWAY,
    UNUSABLE,
    WITH_APP,
    WITH_PUBLISHER,
    Counters,
    Excuses,
    judge,
)
from scripts.campaigning.expected import BANKS, LINES, BoardOutcome, Outcome
from scripts.campaigning.faults import Fault, Kind, excuses_of
from scripts.campaigning.observer import DEPLOYMENT, Flaw, Observer
from scripts.campaigning.stack import Topology
from scripts.running.script import ROOT
from tests.posteriors.messages import status

CLOCK = ROOT / "scripts/campaigning/clock"
HALF = LINES // 2


def outcome(addresses, bank, tables=0):
    """Outcomes that differ for each reading, bank and set of tables."""
    weights = [1 + (line * (3 + tables) + sum(addresses) * 5 + bank) % 13 for line in range(LINES)]
    boards = (
        BoardOutcome(200 + bank, sum(weights[:HALF]), "overflow"),
        BoardOutcome(256, sum(weights[HALF:]), "slice"),
    )
    return Outcome(tuple(each / sum(weights) for each in weights), boards)


def stamp(index):
    return 1_700_000_000 * 10**9 + index


def report(index, number, tables=0):
    boards = outcome((index, index), number % BANKS, tables).boards
    sums = {"cycles": max(each.cycles for each in boards), "counts_total": sum(each.total for each in boards)}
    secs, nsecs = divmod(stamp(index), 10**9)
    boards = [
        status("", each.reason, f"board{at}", cycles=each.cycles, counts_total=each.total, reason=each.reason)
        for at, each in enumerate(boards)
    ]
    frame = status("", "posterior", DEPLOYMENT, number=number, published="true", **sums)
    return {"header": {"stamp": {"secs": secs, "nsecs": nsecs}}, "status": [frame, *boards]}


def result(index, number, tables=0):
    dim = [{"label": "x", "size": LINES, "stride": LINES}]
    data = list(outcome((index, index), number % BANKS, tables).posterior)
    return {"layout": {"dim": dim, "data_offset": 0}, "data": data}


class Recording:
    """Eight readings and their results, in a list that a test may spoil before it is played."""

    def __init__(self):
        self.events = []
        for index in range(8):
            self.events.append(("reading", index))
            self.events += [("report", report(index, index + 1)), ("result", result(index, index + 1))]
        self.counters = Counters(8)
        self.excuses = Excuses()

    def message(self, kind, index):
        """The message of a reading, to be changed in its place."""
        return self.events[3 * index + ("reading", "report", "result").index(kind)][1]

    def values(self, index, *, status):
        """The values of a report's status, to be changed."""
        return self.message("report", index)["status"][status]["values"]

    def replace(self, first, last, *events):
        self.events[first:last] = events

    def end(self, completed, lost=None):
        """Let the last reading have no result, and the counters be these."""
        self.replace(3 * 7 + 1, None)
        self.counters = Counters(completed, lost or {})

    def play(self):
        observer = Observer(outcome)
        for kind, what in self.events:
            if kind == "reading":
                observer.published(stamp(what), (what, what), what * 0.1)
                observer.forwarded(stamp(what))
            elif kind == "fault":
                observer.fault()
            else:
                getattr(observer, kind)(copy.deepcopy(what))
        observer.findings += judge(self.counters, observer.pending_readings(), self.excuses)
        return {finding.flaw for finding in observer.findings}


def both(index, number, **more):
    return ("report", report(index, number, **more)), ("result", result(index, number, **more))


def shift(run):
    run.message("report", 4)["header"]["stamp"]["nsecs"] += 1000


def lose_result(run):
    run.replace(3 * 7 + 1, None)
    del run.events[3 * 4 + 2]


def reorder(run):
    run.replace(10, 12)
    run.replace(13, 13, *both(3, 6))


def lose_under_another_reason(run):
    run.end(7, {FAILED: 1})
    run.excuses = Excuses(reasons=frozenset({WITH_APP}))


def data(run):
    return run.message("result", 4)["data"]


BUGS = {
    "last bit": (Flaw.WRONG, lambda run: data(run).__setitem__(3, data(run)[3] + 2**-54)),
    # as without sequence numbers on the link
    "result of another reading": (Flaw.WRONG, lambda run: run.replace(14, 15, ("result", result(5, 5)))),
    "other tables": (Flaw.WRONG, lambda run: run.replace(13, 15, *both(4, 5, tables=1))),
    "other deployment": (
        Flaw.WRONG,
        lambda run: run.message("report", 4)["status"][0].update(hardware_id="other"),
    ),
    "slice too early": (Flaw.WRONG, lambda run: run.values(4, status=2)[0].update(value="128")),
    "duplicated": (Flaw.DUPLICATE, lambda run: run.replace(99, 99, *both(7, 9))),
    "out of order": (Flaw.OUT_OF_ORDER, reorder),
    "lost uncounted": (Flaw.UNCOUNTED, lambda run: run.end(7)),
    # the publisher counts a result that never arrives
    "lost after counting": (Flaw.UNCOUNTED, lambda run: run.end(8)),
    "counted twice": (Flaw.MISCOUNTED, lambda run: setattr(run, "counters", Counters(8, {PASSED_OVER: 1}))),
    "lost without a fault": (Flaw.UNEXPLAINED, lambda run: run.end(7, {FAILED: 1})),
    "lost under another reason than the fault's": (Flaw.UNEXPLAINED, lose_under_another_reason),
    "unusable without an unusable variable": (Flaw.UNEXPLAINED, lambda run: run.end(7, {UNUSABLE: 1})),
    # the last reading is not followed by another one
    "passed over alone": (Flaw.UNEXPLAINED, lambda run: run.end(7, {PASSED_OVER: 1})),
    "not a number": (Flaw.MALFORMED, lambda run: data(run).__setitem__(3, float("nan"))),
    "unknown stamp": (Flaw.UNKNOWN, shift),
    "without result": (Flaw.WITHOUT_RESULT, lose_result),
}


def test_a_right_run_has_no_findings():
    assert Recording().play() == set()


@pytest.mark.parametrize(("flaw", "plant"), BUGS.values(), ids=BUGS)
def test_a_planted_bug_is_found(flaw, plant):
    run = Recording()
    plant(run)
    assert flaw in run.play()


@pytest.mark.parametrize(("until", "flaws"), [(0.8, set()), (0.55, {Flaw.UNCOUNTED})])
def test_a_fault_excuses_what_it_cuts_off_before_the_recovery(until, flaws):
    run = Recording()
    run.events = [each for at, each in enumerate(run.events) if at < 3 * 6 or at % 3 == 0]
    run.events.insert(3 * 6, ("fault", None))
    run.counters = Counters(7)
    run.excuses = Excuses(readings=True, results=True, until=until)
    assert run.play() == flaws


@pytest.mark.parametrize(
    ("what", "target", "reasons"),
    [
        ("kill", "pcie-app", {WITH_APP}),
        ("stop", "pcie-app", {FAILED}),
        ("kill", "publisher", {WITH_PUBLISHER, ROSBRIDGE_AWAY}),
        ("stop", "publisher", set()),
        ("kill", "subscriber", set()),
        ("cut", "board0", {FAILED}),
        ("gone", "rosbridge", {ROSBRIDGE_AWAY}),
        ("clock", "all", set()),
    ],
)
def test_a_fault_explains_losses_of_its_own_reasons_only(what, target, reasons):
    excuses = excuses_of((Fault(Kind.SIGNALS, what, target, 1.0),), Topology.OWN)
    assert excuses.reasons == reasons


WITHOUT_DESCRIPTORS = """
import mmap, os, resource, struct, time
shared = mmap.mmap(os.open(os.environ["CAMPAIGN_CLOCK"], os.O_RDWR), 0)
_, most = resource.getrlimit(resource.RLIMIT_NOFILE)
resource.setrlimit(resource.RLIMIT_NOFILE, (0, most))
for seconds in (0, 3600, -3600):
    shared[:8] = struct.pack("<q", seconds)
    before = time.clock_gettime_ns(time.CLOCK_REALTIME)
    shifted = [time.time_ns(), round(time.time() * 1e9)]
    after = time.clock_gettime_ns(time.CLOCK_REALTIME)
    steps = [before - 1000 <= each - seconds * 10**9 <= after + 1000 for each in shifted]  # a float has 0.2 us
    print(seconds, *steps)
"""


@pytest.mark.process
def test_a_process_without_free_descriptors_sees_the_clocks_steps(tmp_path):
    """A clock that opened its file at each call would end a master whose descriptors are used up."""
    clock = tmp_path / "clock"
    clock.write_bytes(bytes(8))
    environment = {"PYTHONPATH": str(CLOCK), "CAMPAIGN_CLOCK": str(clock)}
    command = [sys.executable, "-c", WITHOUT_DESCRIPTORS]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert run.stdout.split("\n") == ["0 True True", "3600 True True", "-3600 True True", ""], run.stderr
