"""Latencies: quantiles of the last published frames, and counts over all of them."""

import msgspec
import pytest

from services.master.flow import REMEMBERED, Latencies
from services.sockets.records import FrameResult, Outcome, Publish, Published

MS = 1_000_000
RAW = msgspec.Raw(b"\xc1")


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
    for number in (1, 2, 3):
        run.take(run.app, FrameResult(number, RAW, 0, 0, 0, 0))
    for number, outcome in ((1, Outcome.PUBLISHED), (2, Outcome.ROSBRIDGE_AWAY), (3, Outcome.NO_POSTERIOR)):
        run.take(run.publisher, Published(number, outcome, None, 0, 1.0, 1, 1))
    assert {each.frames for each in run.flow.latencies.summary()} == {1}
