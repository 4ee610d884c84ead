"""Flow of frames: each reading becomes one result, or is counted with a reason, whatever a peer does.

Run.read ──▶ FrameFlow ──▶ app.frames;  computed(), failed() ──▶ publisher;  published() ──▶ counts
"""

import msgspec
import numpy as np
import pytest

from machines.kind import BoardResult
from services import errors
from services.boards.frames import encode_boards
from services.child import RESTARTS
from services.master.flow import MOST_AT_PUBLISHER, QUEUE_ALL_DEPTH, REMEMBERED, Latencies
from services.pipeline.inference import infer, report_of
from services.sockets.records import (
    FailureReason,
    FrameFailed,
    FrameResult,
    LossReason,
    Notice,
    Outcome,
    Publish,
    Published,
    Rosbridge,
    Unusable,
)
from tests.services.master.conftest import Run
from tests.toolchain.running import build_model
from toolchain.deployment import load_deployment
from toolchain.deployment.filter import Transition
from toolchain.models.model import Known, Model, dimension

RAW = msgspec.Raw(b"\xc1")  # bytes that no decoder takes


def computed(run, number=None):
    run.take(run.app, FrameResult(number or run.app.frames[-1], RAW, 0, 0, 0, 0))


def failed(run, reason=FailureReason.AWAY):
    run.take(run.app, FrameFailed(run.app.frames[-1], 0, 5, "Board 0 is silent", reason))


def published(run, number, outcome=Outcome.PUBLISHED, **fields):
    run.take(run.publisher, Published(number, outcome, None, 0, 1.0, 1, 1, **fields))


async def test_a_reading_becomes_a_result(run, monkeypatch):
    now = [1000]
    monkeypatch.setattr("time.monotonic_ns", lambda: now[0])
    run.read(2, stamp_ns=3, received_ns=4, received_tick=5, sent_tick=6, addresses=[7], prior_codes=b"x")
    (frame,) = run.app.records
    assert (frame.number, frame.addresses, frame.bank, frame.prior_codes) == (1, [7], 1, b"x")
    computed(run, 9)  # of a frame that nobody waits for
    assert run.publisher.records == []
    now[0] = 1500
    computed(run)
    (publish,) = run.publisher.records
    assert isinstance(publish, Publish)
    assert publish.result.boards is RAW
    stamps = publish.stamp_ns, publish.received_ns, publish.received_tick, publish.reading_sent_tick
    assert stamps == (3, 4, 5, 6)
    assert publish.waited_ns == 0
    assert run.app.frames == [1, 2]
    published(run, 1)
    frames = run.master.status().frames
    assert (frames.received, frames.completed, frames.last_number, frames.lost) == (2, 1, 1, {})
    computed(run)
    assert run.publisher.records[-1].waited_ns == 500


async def test_the_newest_reading_wins_unless_all_are_kept(boat):
    run = Run(boat)
    for at in range(5):
        run.read(passed_over=2, unpaired=3, addresses=[at])
    assert run.lost == {LossReason.PASSED_OVER: 13, LossReason.UNPAIRED: 15}
    computed(run)
    computed(run)
    assert [each.addresses for each in run.app.records] == [[0], [4]]  # no other reading was kept


async def test_a_publisher_that_takes_nothing_costs_its_results_and_no_more(run):
    run.publisher.takes = False
    run.read(MOST_AT_PUBLISHER + 4)
    for _ in range(MOST_AT_PUBLISHER + 3):
        computed(run)
    assert run.lost == {LossReason.WITH_PUBLISHER: MOST_AT_PUBLISHER + 3}
    assert run.app.frames[-1] == MOST_AT_PUBLISHER + 4
    assert run.flow.awaited(run.peers.publisher) is None


async def test_frames_wait_for_a_publisher_that_does_not_answer(run):
    run.read(MOST_AT_PUBLISHER + 2)
    for _ in range(MOST_AT_PUBLISHER):
        computed(run)
    assert len(run.app.frames) == MOST_AT_PUBLISHER
    assert run.flow.awaited(run.peers.publisher) is not None
    assert run.flow.awaited(run.peers.subscriber) is None
    published(run, 1)
    assert len(run.app.frames) == MOST_AT_PUBLISHER + 1
    run.flow.lost(run.peers.subscriber)
    assert run.lost == {}
    run.flow.lost(run.peers.publisher)
    assert run.lost == {LossReason.WITH_PUBLISHER: MOST_AT_PUBLISHER - 1}
    run.flow.lost(run.peers.app)
    assert run.lost[LossReason.WITH_APP] == 1
    run.flow.ready(run.peers.app)
    assert len(run.app.frames) == MOST_AT_PUBLISHER + 2


async def test_a_publisher_has_its_time_from_the_first_result_or_its_last_answer_on(run, monkeypatch):
    now = [1.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    run.read(3)
    computed(run)
    now[0] = 2.0
    computed(run)
    assert run.flow.awaited(run.peers.publisher).since == 1.0
    now[0] = 3.0
    published(run, 1)
    assert run.flow.awaited(run.peers.publisher).since == 3.0


async def test_no_frame_is_computed_whose_result_nobody_could_get(run):
    for service in (run.publisher, run.subscriber):
        run.take(service, Rosbridge(connected=False))
    run.read(3)
    assert run.app.frames == []
    assert run.lost == {LossReason.ROSBRIDGE_AWAY: 3}
    run.take(run.subscriber, Rosbridge(connected=True))
    assert run.publisher.records == [Rosbridge(connected=True)]  # so that it tries at once
    run.take(run.publisher, Rosbridge(connected=True))
    assert run.subscriber.records == []
    run.read(1)
    assert run.app.frames == [1]


async def test_a_single_frame_does_not_wait_for_the_server(boat):
    run = Run(boat, once=True)
    run.take(run.publisher, Rosbridge(connected=False))
    run.read()
    assert (run.app.frames, run.lost) == ([1], {})


async def test_a_failure_of_another_frame_leaves_the_present_one(run):
    run.read(2)
    run.take(run.app, FrameFailed(9, 0, 5, "Board 0 is silent", FailureReason.AWAY))
    computed(run, 1)
    assert [each.result.number for each in run.publisher.records] == [1]


async def test_frames_wait_for_peers_that_are_not_ready(run):
    for peer in (run.peers.app, run.peers.publisher):
        peer.ready = False
        run.read()
        run.flow.ready(run.peers.subscriber)
        assert run.app.frames == []
        peer.ready = True
    run.flow.ready(run.peers.app)
    assert run.app.frames == [1]


async def test_too_many_readings_end_the_run(run):
    for at in range(1 + QUEUE_ALL_DEPTH):  # one is on the boards
        run.read(addresses=[at])
    assert run.error is None
    for _ in range(3):
        computed(run)
    assert [each.addresses for each in run.app.records] == [[0], [1], [2], [3]]
    run.read(4)
    assert isinstance(run.error, errors.OverflowedQueueError)
    assert run.error.exit_code == 6
    assert run.lost == {}


async def test_a_run_publishes_the_requested_number_of_results(boat):
    """A publisher that waits for its server has several results at once; it will publish them all."""
    run = Run(boat, queue="all", count=3)
    run.read(10)
    for _ in range(5):
        computed(run)
    assert run.app.frames == [1, 2, 3]
    published(run, 1, Outcome.NO_POSTERIOR)  # so one more is needed
    assert run.app.frames == [1, 2, 3, 4]
    computed(run)
    for number in (2, 3, 4):
        assert not run.flow.end.done()
        published(run, number)
    assert run.flow.end.result() is None
    assert run.app.frames == [1, 2, 3, 4]


async def test_every_outcome_is_counted(run):
    published(run, 1, missed=1)
    published(run, 2)
    published(run, 3, Outcome.ROSBRIDGE_AWAY)
    published(run, 4, Outcome.NO_POSTERIOR)
    assert run.lost == {LossReason.SOME_TOPICS: 1, LossReason.ROSBRIDGE_AWAY: 1, LossReason.NO_POSTERIOR: 1}
    assert run.master.summary().endswith(
        ", 1 of them on some topics only; not published: 1 rosbridge away, 1 no posterior"
    )


@pytest.mark.parametrize("reason", FailureReason)
async def test_only_a_board_that_fails_again_and_again_ends_the_run(run, reason):
    run.read(RESTARTS + 2)
    for _ in range(RESTARTS):
        failed(run, reason)
    assert run.lost == {LossReason.FAILED: RESTARTS}
    assert run.error is None
    failed(run, reason)
    assert isinstance(run.error, errors.BoardFailedError) is (reason is FailureReason.FAILED)
    assert len(run.app.frames) == RESTARTS + (2 if run.error is None else 1)


async def test_boards_that_fail_seldom_do_not_end_the_run(boat, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    run = Run(boat, queue="all", restart_window=5)
    run.read(2 * RESTARTS + 2)
    for count in (RESTARTS, RESTARTS, 1):
        for _ in range(count):
            assert run.error is None
            failed(run, FailureReason.FAILED)
        now[0] += 5.1 if count == RESTARTS and now[0] < 105 else 0.0
    assert isinstance(run.error, errors.BoardFailedError)
    assert str(run.error).endswith(f"; {RESTARTS + 1} frames failed on boards within 5 s")


async def test_a_cause_is_reported_once(run):
    for cause in ("a", "b", "a", "a"):
        run.take(run.subscriber, Unusable(cause, "D1 is missing"))
    assert run.lost == {LossReason.UNUSABLE: 4}
    assert len(run.warnings) == 2
    assert run.flow.has_data


async def test_a_cause_of_no_posterior_is_reported_once_with_the_reason_of_the_machine(run):
    run.read(3)
    for number, cause in enumerate(("ops time-out", "impossible", "ops time-out"), 1):
        computed(run)
        published(run, number, Outcome.NO_POSTERIOR, why=f"no posterior: board0 {number}", cause=cause)
    assert run.lost == {LossReason.NO_POSTERIOR: 3}
    first, second = run.warnings
    assert "frame 1: no posterior: board0 1" in first
    assert "board0 2" in second


async def test_a_biased_posterior_is_shown_with_a_warning(boat):
    run = Run(boat, once=True)
    run.read()
    published(run, 1, why="biased posterior: board0", cause="max cycles")
    assert run.error is None
    assert len(run.warnings) == 1


async def test_one_cause_of_a_biased_posterior_and_of_none_has_two_warnings(run):
    run.read(4)
    for outcome in (Outcome.PUBLISHED, Outcome.NO_POSTERIOR) * 2:
        computed(run)
        published(run, run.publisher.records[-1].result.number, outcome, why="a reason", cause="max cycles")
    assert len(run.warnings) == 2


@pytest.mark.parametrize(
    ("end", "error", "code"),
    [
        (lambda run: run.take(run.subscriber, Unusable("a", "D1 is missing")), errors.VariableError, 4),
        (failed, errors.ReportedError, 5),
        (lambda run: published(run, 1, Outcome.NO_POSTERIOR), errors.VariableError, 4),
        (lambda run: published(run, 1, Outcome.ROSBRIDGE_AWAY), errors.RosbridgeLostError, 3),
    ],
    ids=["unusable", "failed", "no posterior", "rosbridge away"],
)
async def test_a_single_frame_that_has_no_result_ends_the_run(boat, end, error, code):
    run = Run(boat, once=True)
    run.read(2)  # the second is not looked at
    assert run.master.status().frames.received == 1
    end(run)
    assert isinstance(run.error, error)
    assert run.error.exit_code == code


async def test_a_single_frame_without_a_posterior_ends_with_the_reason_of_its_machine(boat):
    run = Run(boat, once=True)
    run.read()
    published(run, 1, Outcome.NO_POSTERIOR, why="no posterior: board0 timed out")
    assert str(run.error) == "frame 1: no posterior: board0 timed out; nothing was published"


async def test_a_record_of_another_service_is_reported(run):
    run.take(run.subscriber, Publish(None, 0, 0, 0, 0, 0))
    assert len(run.warnings) == 1
    assert run.error is None


async def test_a_frame_is_followed_by_its_number(boat):
    run = Run(boat, log_level="debug")
    run.read(stamp_ns=17, received_tick=1000, sent_tick=3500)
    (notice,) = run.subscriber.records
    assert isinstance(notice, Notice)
    assert notice.sentence.startswith("complete frame=1 stamp_ns=17 ")
    assert notice.sentence.endswith(" taken_us=2")


async def test_the_time_before_the_first_reading_does_not_count(run, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    assert "in 0.0 s" in run.master.summary()
    now[0] = 400.0
    run.read()
    now[0] = 402.0
    computed(run)
    published(run, 1)
    assert "1 result published in 2.0 s" in run.master.summary()


MS = 1_000_000


def add(latencies, total_ms=20):
    result = FrameResult(1, RAW, MS, 5 * MS, 2 * MS, 4 * MS)
    publish = Publish(
        result, stamp_ns=5, received_ns=6, received_tick=7, reading_sent_tick=7 + MS, waited_ns=3 * MS
    )
    outcome = Published(1, Outcome.PUBLISHED, None, 0, 0.5, 512, total_ms * MS, out_ns=4 * MS)
    latencies.add(publish, outcome)


def test_each_stage_has_its_time():
    latencies = Latencies()
    assert latencies.summary() == []
    add(latencies)
    assert {each.stage: each.p50_ms for each in latencies.summary()} == {
        "rosbridge_in": 1,
        "waited": 3,
        "register_writes": 1,
        "compute": 5,
        "reads": 2,
        "rosbridge_out": 4,
        "local_hops": 4,  # what is left of 20 ms
        "frame": 20,
    }


def test_quantiles_are_of_the_last_frames_and_counts_of_all():
    latencies = Latencies()
    for number in range(1, REMEMBERED + 101):
        add(latencies, total_ms=1000 if number <= 100 else 20 if number % 50 else 40)
    stages = {each.stage: each for each in latencies.summary()}
    assert (stages["frame"].p50_ms, stages["frame"].p99_ms) == (20, 40)
    assert all(sum(each.buckets) == each.frames == REMEMBERED + 100 for each in stages.values())
    assert stages["frame"].sum_s == pytest.approx(100 * 1 + 980 * 0.02 + 20 * 0.04)
    assert sum(stages["frame"].buckets[:11]) == 980  # up to 20 ms
    assert sum(stages["frame"].buckets[:15]) == 1000  # up to 0.5 s


async def test_only_published_frames_count(run):
    run.read(3)
    for number, outcome in enumerate((Outcome.PUBLISHED, Outcome.ROSBRIDGE_AWAY, Outcome.NO_POSTERIOR), 1):
        computed(run)
        published(run, number, outcome)
    assert {each.frames for each in run.flow.latencies.summary()} == {1}


MOVES = np.array([[0.9, 0.1, 0.0], [0.0, 0.7, 0.3], [0.2, 0.0, 0.8]])


@pytest.fixture
def filtered(tmp_path):
    """A deployment with a filter: three rooms, in order."""
    known = (Known(name="heard", table=np.full((2, 3), 0.5)),)
    transition = Transition(np.array([1.0, 0, 0]), MOVES)
    model = Model(name="rooms", searched=(dimension("room", size=3),), known=known, transition=transition)
    build_model(model, tmp_path)
    return load_deployment(tmp_path)


def counted(run, *counts):
    """The result of the last frame."""
    boards = encode_boards([BoardResult(np.array(counts, "<u4").tobytes(), 100, 1)])
    run.take(run.app, FrameResult(run.app.frames[-1], boards, 0, 0, 0, 0))


def codes_of(belief):
    """The codes of a prior, computed here, number by number."""
    scaled = [each / max(belief) * 65536 for each in belief]
    return [min(65535, max(1, int(each + 0.5))) if each else 0 for each in scaled]


def prior_of(frame):
    return np.frombuffer(frame.prior_codes, "<u2").tolist()


async def test_the_posterior_of_a_frame_becomes_the_prior_of_the_next(filtered):
    run = Run(filtered, queue="all")
    run.read(3)
    assert len(run.app.frames) == 1  # the next prior needs this posterior
    assert prior_of(run.app.records[0]) == codes_of([0.9, 0.1, 0])
    assert run.infos == ["the filter begins with its start distribution"]
    counted(run, 10, 30, 0)
    assert prior_of(run.app.records[1]) == codes_of(0.25 * MOVES[0] + 0.75 * MOVES[1])
    counted(run, 0, 0, 0)  # without a posterior, the prediction stays
    assert prior_of(run.app.records[2]) == codes_of((0.25 * MOVES[0] + 0.75 * MOVES[1]) @ MOVES)
    assert len(run.infos) == 1
    assert Run(filtered).flow._filter.belief.tolist() == [1, 0, 0]  # another master begins again


async def test_every_lost_reading_is_a_step_of_the_filter(filtered):
    run = Run(filtered)
    run.read(2, passed_over=7)  # the first reading is the first step, whatever was before
    belief = np.array([1.0, 0, 0]) @ MOVES
    assert prior_of(run.app.records[0]) == codes_of(belief)
    run.read(2, passed_over=1)  # passed over: 7 and 1 and 1 by the subscriber, and two that waited
    run.take(run.subscriber, Unusable("a", "room is missing"))
    failed(run)
    belief = belief @ np.linalg.matrix_power(MOVES, 12)
    assert prior_of(run.app.records[1]) == codes_of(belief)
    counted(run, 0, 0, 4)
    run.take(run.publisher, Rosbridge(connected=False))
    run.read(3)
    run.take(run.publisher, Rosbridge(connected=True))
    run.read()  # after the unusable one and three that nobody could have received
    belief = np.array([0, 0, 1.0]) @ np.linalg.matrix_power(MOVES, 5)
    assert prior_of(run.app.records[2]) == codes_of(belief)
    run.flow.lost(run.peers.app)  # with its frame, whose prediction stays
    run.read()
    assert prior_of(run.app.records[3]) == codes_of(belief @ MOVES)
    assert run.lost[LossReason.PASSED_OVER] == 7 + 7 + 1 + 1 + 2


async def test_lost_messages_of_several_topics_are_fewer_steps(filtered):
    run = Run(filtered.model_copy(update={"sources": [filtered.sources[0]] * 2}))
    run.read()
    counted(run, 0, 1, 0)
    for lost, steps in ((3, 2), (2, 2), (1, 2), (1, 1), (3, 3)):  # each two messages are a reading
        run.read(passed_over=lost)
        expected = codes_of(np.linalg.matrix_power(MOVES, steps)[1])
        assert prior_of(run.app.records[-1]) == expected
        counted(run, 0, 1, 0)


async def test_a_prediction_that_would_take_too_long_is_shortened_and_reported(filtered):
    run = Run(filtered)
    run.flow._filter.most_steps = 4
    run.read()
    counted(run, 0, 1, 0)
    for _ in range(2):
        run.read(passed_over=1000)
        counted(run, 0, 1, 0)
    assert prior_of(run.app.records[1]) == codes_of(np.linalg.matrix_power(MOVES, 4)[1])
    (warning,) = run.warnings
    assert warning.startswith("1000 readings were lost before frame 2, and the filter predicts 4 at most")


async def test_a_report_says_what_the_filter_does_without_a_posterior(filtered):
    run = Run(filtered)
    run.read(2)
    counted(run, 0, 0, 0)
    (publish,) = run.publisher.records
    inference = infer(publish.result, filtered)
    report = report_of(publish, inference, filtered, now=(0, 0), previous_out_ns=0)
    assert report.outcome == inference.outcome + "; the filter goes on with its prediction"
