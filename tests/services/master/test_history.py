"""Memory of the last frames: their stages, boards and outcomes, and latencies over all of them.

Run.read ──▶ FrameFlow ──▶ FrameHistory ──▶ timeline(N), latencies()
"""

import msgspec
import pytest

from services.master.history import REMEMBERED, FrameHistory
from services.sockets.frame_timeline import FrameTimeline
from services.sockets.records import (
    FailureReason,
    FrameFailed,
    FrameResult,
    LossReason,
    Outcome,
    Published,
    Reading,
)

MS = 1_000_000
RAW = msgspec.Raw(b"\xc1")


def reading(tick=0, **fields):
    return Reading(
        **{"stamp_ns": 5, "received_ns": 1_700_000_000 * 10**9, "received_tick": tick, "sent_tick": tick + MS}
        | fields
    )


def publish(history, number, tick=0, total_ms=20):
    history.sent(number, number % 2, reading(tick), (tick + 2 * MS, tick + 3 * MS))
    history.computed(FrameResult(number, RAW, MS, 5 * MS, 2 * MS, 4 * MS, began_tick=tick + 4 * MS))
    record = Published(
        number,
        Outcome.PUBLISHED,
        None,
        0,
        0.5,
        512,
        total_ms * MS,
        out_ns=3 * MS,
        boards=[(512, 1), (500, 3)],
    )
    history.ended(record, record.outcome)


def test_a_published_frame_has_its_stages_in_order():
    history = FrameHistory()
    publish(history, 1, tick=77)
    timeline = history.timeline(1)
    assert isinstance(timeline, FrameTimeline)
    assert [(each.stage, each.began_ms, each.took_ms) for each in timeline.stages] == [
        ("rosbridge_in", 0, 1),
        ("waited", 2, 1),
        ("register_writes", 4, 1),
        ("compute", 5, 5),
        ("reads", 10, 2),
        ("rosbridge_out", 17, 3),
    ]
    assert (timeline.outcome, timeline.total_ms, timeline.local_hops_ms, timeline.cycles) == (
        "published",
        20,
        7,
        512,
    )
    assert [(board.index, board.cycles) for board in timeline.boards] == [(0, 512), (1, 500)]
    assert (timeline.bank, timeline.stamp_ns) == (1, 5)
    assert msgspec.json.decode(msgspec.json.encode(timeline), type=FrameTimeline) == timeline


def test_the_memory_is_bounded_and_says_what_it_has():
    history = FrameHistory()
    assert isinstance(history.timeline(1), str)
    for number in range(1, REMEMBERED + 11):
        publish(history, number)
    assert history.timeline(REMEMBERED + 10).number == REMEMBERED + 10
    assert history.timeline(11).number == 11
    assert "11 to 1010" in history.timeline(10)
    assert "1010" in history.timeline(REMEMBERED + 11)
    assert isinstance(history.timeline(0), str)


def test_latencies_are_quantiles_of_the_last_frames_and_counts_of_all():
    history = FrameHistory()
    assert history.latencies() == []
    for number in range(1, REMEMBERED + 101):
        publish(history, number, total_ms=1000 if number <= 100 else 20 if number % 50 else 40)
    stages = {each.stage: each for each in history.latencies()}
    assert (stages["frame"].p50_ms, stages["frame"].p99_ms) == (20, 40)
    assert (stages["compute"].p50_ms, stages["local_hops"].p50_ms) == (5, 7)
    assert all(sum(each.buckets) == each.frames == REMEMBERED + 100 for each in stages.values())
    assert stages["frame"].sum_s == pytest.approx(100 * 1 + 980 * 0.02 + 20 * 0.04)
    assert sum(stages["frame"].buckets[:11]) == 980  # up to 20 ms
    assert sum(stages["frame"].buckets[:15]) == 1000 + 0  # up to 0.5 s


async def test_a_lost_frame_says_why(run):
    history = run.flow.history
    run.read(4)
    failure = FrameFailed(1, 0, 5, "Board 0 is tired", FailureReason.AWAY)
    assert history.timeline(1).outcome == "on the boards"
    run.take(run.app, failure)
    assert (history.timeline(1).outcome, history.timeline(1).why) == (LossReason.FAILED, "Board 0 is tired")
    run.take(run.app, FrameResult(2, RAW, 0, 0, 0, 0))
    assert history.timeline(2).outcome == "at the publisher"
    run.take(run.publisher, Published(2, Outcome.ROSBRIDGE_AWAY, None, -1, 0.0, 0, 0))
    assert history.timeline(2).outcome == Outcome.ROSBRIDGE_AWAY
    assert history.timeline(2).total_ms is None
    run.take(run.app, FrameResult(3, RAW, 0, 0, 0, 0))
    run.flow.lost(run.peers.publisher)
    run.flow.lost(run.peers.app)
    assert [history.timeline(number).outcome for number in (3, 4)] == [
        LossReason.WITH_PUBLISHER,
        LossReason.WITH_APP,
    ]
    assert history.latencies() == []
