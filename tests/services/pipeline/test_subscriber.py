"""The subscriber's counters: what is lost reaches the master once, and stays in the status."""

from bridge.client import Message
from services.pipeline.subscriber import Subscriber
from services.settings import Settings
from services.sockets.records import LossReason, Unusable
from tests.integration.conftest import READING

BUSY = 1 << 19
"""Bytes that wait for a master that is too slow."""


def test_passed_over_readings_are_reported_once_and_counted_in_all(boat, link):
    subscriber = Subscriber(Settings(), boat, link.make)
    for passed_over in (2, 3, 0):
        link.backlog = BUSY
        for _ in range(passed_over):
            subscriber._read(0, Message("/boat/sensors", dict(READING), 1, 2))
        link.backlog = 0
        subscriber._read(0, Message("/boat/sensors", dict(READING), 1, 2))
    assert [reading.passed_over for reading in link.sent] == [2, 3, 0]
    frames = subscriber.status().frames
    assert (frames.completed, frames.lost) == (3, {LossReason.PASSED_OVER: 5})


def test_an_unusable_message_is_reported_by_its_cause(boat, link):
    subscriber = Subscriber(Settings(), boat, link.make)
    for value in ("x", "y"):
        subscriber._read(0, Message("/boat/sensors", READING | {"D2": value}, 1, 2))
    first, second = link.sent
    assert isinstance(first, Unusable)
    assert first.cause == second.cause
    assert subscriber.status().frames.lost == {LossReason.UNUSABLE: 2}
