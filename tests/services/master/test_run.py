"""A run that keeps all readings, while a reload keeps them from the boards: what is too much then is no board's fault."""

import asyncio

import msgspec
import pytest

from services.errors import OverflowedQueueError
from services.master.peers import Peer
from services.master.reload import LOST_IN_RELOAD
from services.master.run import MISSED, Master
from services.pipeline.frames import QUEUE_ALL_DEPTH, WaitingFrames
from services.settings import Settings
from services.sockets.control_socket import ReloadOrder
from services.sockets.records import (
    FailureReason,
    Frame,
    FrameFailed,
    FrameResult,
    Outcome,
    Prepare,
    Prepared,
    Published,
    Reading,
    Switched,
)
from tests.integration.conftest import build_boat
from toolchain.deployment import load_deployment

READ = Reading(stamp_ns=0, received_ns=0, received_tick=0, sent_tick=0, addresses=(), passed_over=0)


class App:
    """A pcie-app that takes a frame and answers when it is told to."""

    where = "here"

    def __init__(self):
        self.frames = []

    def send(self, record):
        self.frames += [record] if isinstance(record, Frame) else []
        return True


class Service:
    """A service that does what a reload asks; or tells of being asked to switch, and does not answer."""

    where = "here"

    def __init__(self, peer, silent):
        self.asked = []
        self._peer, self._silent = peer, silent

    def send(self, record):
        self.asked.append(record)
        if isinstance(record, Prepare):
            self._peer.answered(Prepared(record.generation))
        elif self._silent is None:
            self._peer.answered(Switched(record.generation))
        else:
            self._silent.set()
        return True


@pytest.fixture(scope="module")
def boat(tmp_path_factory):
    return load_deployment(build_boat(tmp_path_factory.mktemp("boat") / "deployment"))


@pytest.fixture
async def run(boat):
    """A run that keeps all, and whose boards wait for frames."""
    run = Master(Settings(queue="all"), boat, once=False, count=None, json=False)
    for role in ("subscriber", "publisher", "pcie-app"):
        peer = run._peers._by_role[role] = Peer(role, None, None)
        peer.protocol, peer.ready = App(), True
    return run


def read(run, count):
    for _ in range(count):
        run.take(run._peers.subscriber, READ)


def compute(run, count):
    for _ in range(count):
        number = run._peers.app.protocol.frames[-1].number
        run.take(run._peers.app, FrameFailed(number, 0, 5, "", FailureReason.AWAY))


async def test_readings_that_come_while_boards_are_held_end_no_run(run):
    run.hold()
    read(run, QUEUE_ALL_DEPTH + 7)
    assert run.status().frames.lost == {LOST_IN_RELOAD: 7}
    assert not run._end.done()


async def test_boards_may_catch_up_after_a_reload(run):
    run.hold()
    waited = WaitingFrames("all")
    for _ in range(QUEUE_ALL_DEPTH):
        waited.put((READ, 0))
    run.go_on(waited)
    read(run, 3)
    assert run._losses[LOST_IN_RELOAD] == 2  # one is on the boards, so one more could wait
    for _ in range(QUEUE_ALL_DEPTH - 1):
        compute(run, 1)
        read(run, 1)
    assert not run._end.done()
    # those that waited for the reload are done, and still as many wait: now it is the boards
    read(run, 1)
    with pytest.raises(OverflowedQueueError, match="the slow part"):
        run._end.result()


async def test_too_many_without_a_reload_end_the_run(run):
    read(run, QUEUE_ALL_DEPTH + 1)
    assert not run._end.done()
    read(run, 1)
    with pytest.raises(OverflowedQueueError, match="the slow part"):
        run._end.result()


async def test_no_more_is_published_than_was_asked_for(boat):
    """A publisher that waits for its server has several results at once; it will publish them all."""
    run = Master(Settings(queue="all"), boat, once=False, count=3, json=False)
    for role in ("subscriber", "publisher", "pcie-app"):
        peer = run._peers._by_role[role] = Peer(role, None, None)
        peer.protocol, peer.ready = App(), True
    read(run, 10)

    def computed():
        run.take(
            run._peers.app,
            FrameResult(run._peers.app.protocol.frames[-1].number, msgspec.Raw(b"\x90"), 0, 0, 0, 0),
        )

    def published(number, outcome):
        run.take(run._peers.publisher, Published(number, outcome, None, 0, 1.0, 1, 1))

    for _ in range(5):
        computed()
    assert len(run._peers.app.protocol.frames) == 3
    published(1, Outcome.NO_POSTERIOR)  # so one more is needed
    assert len(run._peers.app.protocol.frames) == 4
    computed()
    for number in (2, 3, 4):
        assert not run._end.done()
        published(number, Outcome.PUBLISHED)
    assert run._end.done()
    assert len(run._peers.app.protocol.frames) == 4


async def test_a_result_that_went_to_some_servers_only_is_counted(run):
    run.take(run._peers.publisher, Published(1, Outcome.PUBLISHED, None, 0, 1.0, 1, 1, missed=1))
    run.take(run._peers.publisher, Published(2, Outcome.PUBLISHED, None, 0, 1.0, 1, 1))
    run.take(run._peers.publisher, Published(3, Outcome.ROSBRIDGE_AWAY, None, 0, 1.0, 1, 1))
    assert run.status().frames.lost == {MISSED: 1, "rosbridge away": 1}
    assert run._summary().endswith(", 1 of them on some topics only; not published: 1 rosbridge away")


async def test_a_reload_ends_with_its_run(boat, run):
    """Nobody is asked to go back: they have ended, or end now."""
    run._began = True
    asked = asyncio.Event()
    subscriber, publisher, app = peers = tuple(run._peers)
    for peer in peers:
        peer.protocol = Service(peer, asked if peer is app else None)
    reloading = asyncio.ensure_future(run._reloads.order(ReloadOrder(str(boat.directory))))
    await asyncio.wait_for(asked.wait(), 120)
    run.take(subscriber, msgspec.structs.replace(READ, generation=1))
    told = len(subscriber.protocol.asked)
    reloading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asyncio.wait_for(reloading, 120)
    assert len(subscriber.protocol.asked) == told
    assert run.status().frames.lost == {LOST_IN_RELOAD: 1}
    assert [type(each) for each in publisher.protocol.asked] == [Prepare]
