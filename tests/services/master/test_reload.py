"""Reloads: requests to the services, readings during the switch, and the return after a failure."""

import asyncio
import re
from pathlib import Path
from unittest.mock import AsyncMock, Mock, call

import msgspec
import pytest

from services.errors import NotReloadedError, ReportedError, SettingsError
from services.master import reload
from services.master.reload import describe_frames
from services.pipeline.frames import QUEUE_ALL_DEPTH
from services.sockets.control_socket import ReloadOrder
from services.sockets.records import (
    FrameResult,
    LossReason,
    NotReloaded,
    Outcome,
    Prepare,
    Published,
    Switch,
)
from tests.patience import PATIENCE
from tests.services.master.conftest import Run

MEANWHILE = "; 3 readings that came meanwhile found no place to wait and were lost"


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        ((0, 0), "0 frames were in flight and finished before"),
        ((1, 0, 3), f"1 frame was in flight and finished before{MEANWHILE}"),
        (
            (5, 2, 1),
            "5 frames were in flight: 3 finished before, 2 lost after 30 s; 1 reading that came meanwhile found no place to wait and was lost",
        ),
    ],
)
def test_lost_frames_are_not_counted_as_finished(counts, text):
    assert describe_frames(*counts) == text


@pytest.fixture
async def begun(run):
    run.peers.begun.set()
    return run


@pytest.fixture
def order(built):
    return ReloadOrder(str(built))


def kinds(service):
    return [type(each) for each in service.records if isinstance(each, Prepare | Switch)]


async def test_readings_that_come_while_boards_are_programmed_wait_or_are_counted(begun, order):
    begun.flow._losses[LossReason.IN_RELOAD] = 40  # of an earlier reload
    begun.app.before_switch = lambda: begun.read(QUEUE_ALL_DEPTH + 3, generation=1)
    sentence = await begun.reloads.order(order)
    assert f"0 frames were in flight and finished before{MEANWHILE}, " in sentence
    assert begun.master.status().generation == 1
    assert begun.lost == {LossReason.IN_RELOAD: 43}
    assert begun.app.frames == [1]
    assert begun.flow.waiting == QUEUE_ALL_DEPTH - 1
    assert kinds(begun.subscriber) == kinds(begun.publisher) == kinds(begun.app) == [Prepare, Switch]
    assert [peer.generation for peer in begun.peers] == [1, 1, 1]


async def test_frames_in_flight_finish_by_the_deployment_that_they_were_read_for(begun, order):
    begun.read(2)
    reloading = asyncio.ensure_future(begun.reloads.order(order))
    for number in (1, 2):
        while not (kinds(begun.subscriber) == [Prepare, Switch] and begun.app.frames[-1] == number):
            await asyncio.sleep(0.01)
        assert kinds(begun.app) == [Prepare]
        begun.take(begun.app, FrameResult(number, msgspec.Raw(b""), 0, 0, 0, 0))
        begun.take(begun.publisher, Published(number, Outcome.PUBLISHED, None, 0, 1.0, 1, 1))
    assert (await reloading).count("2 frames were in flight and finished before,") == 1
    assert begun.lost == {}


async def test_readings_that_still_wait_after_the_drain_are_lost(begun, order, monkeypatch):
    monkeypatch.setattr(reload, "_DRAIN_TIME", 0.1)
    begun.flow.hold()
    begun.read(3)
    assert f"; {describe_frames(3, 3)}, " in await begun.reloads.order(order)
    assert begun.lost == {LossReason.IN_RELOAD: 3}


async def test_boards_get_no_frame_while_they_are_programmed(begun, order):
    begun.app.before_switch = begun.read
    sentence = await begun.reloads.order(order)
    assert f"; {describe_frames(0, 1)}, " in sentence
    assert re.search(r" \d+(\.\d)? ms$", sentence)
    assert begun.app.frames == []


async def test_a_second_order_is_refused_meanwhile(begun, order):
    first = asyncio.ensure_future(begun.reloads.order(order))
    await asyncio.sleep(0)
    with pytest.raises(NotReloadedError):
        await begun.reloads.order(order)
    await first


@pytest.mark.parametrize("state", ["not begun", "not ready", "relative"])
async def test_an_order_that_can_not_be_followed_is_refused(run, built, state):
    if state != "not begun":
        run.peers.begun.set()
    run.peers.publisher.ready = state != "not ready"
    with pytest.raises(SettingsError if state == "relative" else NotReloadedError):
        await run.reloads.order(ReloadOrder("relative" if state == "relative" else str(built)))
    assert kinds(run.subscriber) == []


async def test_services_that_switched_go_back_when_the_boards_do_not(begun, order):
    def boards_fail():
        begun.read(generation=1)
        begun.read()
        begun.peers.app.answer.set_exception(NotReloadedError("pcie-app ended meanwhile"))

    begun.app.before_switch = boards_fail
    begun.app.answers = True
    with pytest.raises(NotReloadedError):
        await begun.reloads.order(order)
    switches = [each.generation for each in begun.subscriber.records if isinstance(each, Switch)]
    assert switches == [1, 0]
    assert begun.master.status().generation == 0
    assert begun.lost == {LossReason.IN_RELOAD: 1}
    assert begun.app.frames == [1]  # frames are sent to the boards again


async def test_a_reload_ends_with_its_run(begun, order):
    """No service is asked to go back: they have ended, or end now."""
    asked = asyncio.Event()
    begun.app.answers, begun.app.before_switch = True, asked.set
    begun.app.send, send = (
        (lambda record: asked.set() or True if isinstance(record, Switch) else send(record)),
        begun.app.send,
    )
    reloading = asyncio.ensure_future(begun.reloads.order(order))
    await asyncio.wait_for(asked.wait(), PATIENCE)
    begun.read(generation=1)
    reloading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asyncio.wait_for(reloading, PATIENCE)
    assert kinds(begun.subscriber) == [Prepare, Switch]
    assert kinds(begun.publisher) == [Prepare]
    assert begun.lost == {LossReason.IN_RELOAD: 1}


async def test_programming_takes_its_time_for_each_board(boat, order, monkeypatch):
    limits, wait_for = [], asyncio.wait_for

    def limited(awaitable, limit):
        limits.append(limit)
        return wait_for(awaitable, limit)

    monkeypatch.setattr(asyncio, "wait_for", limited)
    run = Run(boat, queue="all", peer_timeout=40)
    run.peers.begun.set()
    await run.reloads.order(order)
    # all prepare; then the subscriber, pcie-app with its four boards, and the publisher switch
    assert limits == [100, 100, 100, 100, 260, 100]


async def test_fields_that_flags_override_may_differ(boat):
    boards = tuple(each.model_copy(update={"endpoint": "unix:/tmp/x.sock"}) for each in boat.boards)
    given = boat.model_copy(update={"boards": boards})
    run = Run(boat)
    assert run.reloads._without_overridden(given) == given
    run = Run(boat, uri="ws://elsewhere:9090", queue="all")
    run.peers.board_endpoints = ("unix:/tmp/own.sock",)
    same = run.reloads._without_overridden(given)
    assert {each.uri for each in (*same.sources, *same.outputs)} == {"ws://elsewhere:9090"}
    assert (same.queue, len(same.sources), len(same.outputs)) == ("all", len(boat.sources), len(boat.outputs))
    assert same.boards == tuple(each.model_copy(update={"endpoint": ""}) for each in boards)


@pytest.mark.parametrize("generation", [0, 1])
async def test_children_read_a_copy_of_the_first_deployment(begun, tmp_path, generation):
    begun.reloads._keep_copy = AsyncMock(return_value=tmp_path)
    begun.peers.set_flag = Mock()
    begun.flow._in_force.generation = generation
    await begun.reloads.keep_first()
    assert begun.peers.set_flag.mock_calls == ([] if generation else [call("--deployment", str(tmp_path))])
    begun.reloads._keep_copy.side_effect = OSError("the disk is full")
    begun.reloads._log = Mock()
    await begun.reloads.keep_first()
    assert begun.reloads._log.warning.call_count == 1


@pytest.mark.parametrize("child", [None, Mock()])
async def test_only_children_need_a_copy(begun, boat, tmp_path, child):
    begun.peers._private = Mock(path=tmp_path)
    begun.peers.app.child = child
    kept = await begun.reloads._keep_copy(boat, 1)
    assert (kept.parent == tmp_path) is (child is not None)
    assert (kept == boat.directory) is (child is None)


async def test_children_prepare_a_copy_and_the_user_hears_of_the_original(begun, order):
    begun.reloads._keep_copy = AsyncMock(return_value=Path("/kept"))
    begun.peers.subscriber.child = Mock()
    answer = NotReloaded(1, 4, "/kept/boards is empty")
    begun.app.send = lambda record: begun.peers.app.answered(answer) or True
    with pytest.raises(ReportedError) as caught:
        await begun.reloads.order(order)
    assert caught.value.exit_code == 4
    assert f"{order.folder}/boards" in str(caught.value)
    folders = [each.records[0].folder for each in (begun.subscriber, begun.publisher)]
    assert folders == ["/kept", order.folder]


@pytest.mark.parametrize("asked", [Prepare, Switch])
async def test_a_service_that_does_not_answer_is_ended(boat, order, monkeypatch, asked):
    monkeypatch.setattr(reload, "ANSWER_TIME", 0.0)
    monkeypatch.setattr(reload, "_PROGRAM_TIME", 0.0)
    run = Run(boat, queue="all", peer_timeout=0.05)
    run.peers.begun.set()
    run.app.send, send = (
        (lambda record: True if isinstance(record, asked) else send(record)),
        run.app.send,
    )
    with pytest.raises(NotReloadedError) as caught:
        await asyncio.wait_for(run.reloads.order(order), PATIENCE)
    assert "pcie-app at this process" in str(caught.value)
    assert ("switch" in str(caught.value)) is (asked is Switch)
    assert run.peers.app.closed.is_set()
    assert run.peers.app.answer is None
