"""What a reload says of the frames that were under way."""

import pytest

from services.reload import what_became_of


@pytest.mark.parametrize(
    ("in_flight", "lost", "said"),
    [
        (0, 0, "0 frames were in flight and finished before"),
        (1, 0, "1 frame was in flight and finished before"),
        (5, 2, "5 frames were in flight: 3 finished before, 2 lost after 30 s"),
    ],
)
def test_what_was_lost_is_not_finished(in_flight, lost, said):
    assert what_became_of(in_flight, lost) == said
