"""The kept frames, five minutes of stage times, rate and losses, with the test's own clock."""

import numpy as np
import pytest

from services.dashboard import feed as module
from services.dashboard.feed import KEPT_FRAMES, OTHER, RATE_SECONDS, STAGE_SECONDS, STAGES, Feed
from tests.services.dashboard.frames import posterior, report, stages


def test_the_last_frames_are_kept():
    feed = Feed()
    for number in range(1, KEPT_FRAMES + 11):
        feed.add(posterior(number), 0.0)
    assert len(feed.frames) == KEPT_FRAMES
    assert (feed.frames[0].at, feed.newest.at) == (11, KEPT_FRAMES + 10)
    assert feed.frame(20).report.number == 20
    assert feed.frame(1).at == 11, "the oldest one that is left"
    assert feed.frame(10**6).at == feed.newest.at


def test_fine_grids_take_no_more_memory(monkeypatch):
    monkeypatch.setattr(module, "KEPT_BYTES", 5 * 12 * 4)
    feed = Feed()
    for number in range(1, 20):
        feed.add(posterior(number), 0.0)
        feed.add(report(number, outcome="impossible", published=False), 0.0)
    assert sum(each.values is not None for each in feed.frames) == 5
    assert feed.newest.at == 38


def test_stage_times_are_means_of_seconds_for_five_minutes():
    feed = Feed()
    for second in range(STAGE_SECONDS + 50):
        for time in (100.0, 300.0):
            feed.add(
                posterior(1, stages=stages(compute=time + second, rosbridge_in=10.0)), second + time / 1000
            )
    now = STAGE_SECONDS + 49
    rows = feed.stage_times(now)
    assert [rows[0][0], rows[-1][0]] == [STAGE_SECONDS, 0]
    assert rows[-1][1][STAGES.index("compute")] == 200.0 + now
    assert rows[-1][1][STAGES.index("rosbridge_in")] == 10.0
    assert feed.stage_times(now + 2 * STAGE_SECONDS) == []


def test_the_rate_covers_the_last_seconds():
    feed = Feed()
    assert feed.rate(0.0) == 0
    for at in range(100):
        feed.add(posterior(at), 10 + at / 10)
    assert feed.rate(12.0) == 10, "since the first frame"
    assert feed.rate(20.0) == 10
    assert feed.rate(20.0 + RATE_SECONDS) == 0


def test_losses_have_reasons_and_a_bound():
    feed = Feed()
    feed.add(report(1, outcome="no posterior: impossible on every board", published=False), 0.0)
    for number in range(100):
        feed.add_loss(f"strange {number}")
    feed.add_loss("no posterior: impossible on every board")
    assert feed.lost["no posterior: impossible on every board"] == 2
    assert sum(feed.lost.values()) == 102
    assert len(feed.lost) <= 21
    assert feed.lost[OTHER] > 0


def test_watchers_learn_of_a_frame_with_its_truth():
    feed, told = Feed(), []
    feed.truth = (1.0, 2.0)
    feed.watchers.add(lambda: told.append(feed.newest.truth))
    feed.add(posterior(1), 0.0)
    assert told == [(1.0, 2.0)]


AGREE, APART = {"r_hat": "1.0010"}, {"r_hat": "inf"}


@pytest.mark.parametrize(
    ("details", "errors"),
    [
        ({"effective_samples": "400", "standard_error": "0.025"}, [0.015, 0.025]),
        ({"effective_samples": "400", "standard_error": "0.025"} | AGREE, [0.015, 0.025]),
        ({"effective_samples": "400", "standard_error": "0.02"} | APART, [0.02, 0.025]),
        ({"standard_error": "0.3"} | APART, [0.3, 0.3]),
        ({"samples": "400"}, None),
        ({"effective_samples": "?", "standard_error": "?"}, None),
        ({"standard_error": "-9"}, None),
        ({"standard_error": "1e308"}, None),
        ({"effective_samples": "-5"}, None),
        ({"effective_samples": "inf"}, None),
    ],
)
def test_each_probability_has_its_own_sampling_error(details, errors):
    frame = Feed().add(posterior(1, details=details), 0.0)
    found = frame.sampling_error(np.array([0.1, 0.5]))
    assert found is errors is None or found == pytest.approx(errors, abs=5e-4)
