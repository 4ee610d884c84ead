"""A run: its status, its summary, what it prints, its end without data, and the watch over its children."""

import asyncio
import contextlib
import json
from contextlib import nullcontext
from types import SimpleNamespace
from unittest.mock import AsyncMock, Mock

import msgspec
import numpy as np
import pytest

from machines.bm1 import StopReason
from machines.kind import BoardResult
from services.boards.frames import encode_boards
from services.errors import NoDataError
from services.master import run
from services.master.run import ChildrenWatch
from services.sockets.records import FrameResult, LossReason, Outcome, Published, Seen
from services.sockets.reporting import STUCK_S, serve_status
from services.sockets.status import ProcessStatus
from tests.patience import PATIENCE
from tests.services.master.conftest import Run


def publish(run, number=1, seen=None):
    run.take(run.app, FrameResult(number, msgspec.Raw(b""), 0, 0, 0, 0))
    run.take(run.publisher, Published(number, Outcome.PUBLISHED, seen, 9, 0.5, 7, 3_000_000))


async def test_the_status_gives_the_reason_for_missing_results(boat, monkeypatch):
    now = [1_000_000_000_000]
    monkeypatch.setattr("time.monotonic_ns", lambda: now[0])
    run = Run(boat, ready_timeout=5)
    for peer in (run.peers.app, run.peers.publisher):
        peer.ready = False
    status = run.master.status()
    assert not status.ready
    assert "publisher and pcie-app" in status.why
    for peer in (run.peers.app, run.peers.publisher):
        peer.ready = True
    run.read()
    status = run.master.status()
    assert not status.ready
    assert "pcie-app" not in status.why
    publish(run)
    flowing = run.master.status()
    now[0] += 5_000_000_000
    assert run.master.status().ready
    assert flowing.ready
    now[0] += 1_000_000_000
    late = run.master.status()
    assert not late.ready
    assert "6 s" in late.why
    assert late.why != flowing.why != ""
    assert late.deployment == boat.hash
    assert [peer.name for peer in late.peers] == ["subscriber", "publisher", "pcie-app"]


async def test_results_and_those_that_nobody_saw_are_shown(boat, capsys):
    run = Run(boat, json=True)
    run.read(2)
    publish(run)
    out, err = capsys.readouterr()
    shown = json.loads(out)
    assert (shown["frame"], shown["cycles"], shown["ms"], err) == (1, 7, 3.0, "")
    publish(run, 2, seen=False)
    out, err = capsys.readouterr()
    assert (len(out.splitlines()), len(err.splitlines())) == (1, 1)


@pytest.mark.parametrize(("once", "lines"), [(True, 1), (False, 0)])
async def test_a_single_result_is_printed_as_a_sentence(boat, capsys, once, lines):
    run = Run(boat, once=once)
    run.read()
    publish(run)
    out, err = capsys.readouterr()
    assert (len(out.splitlines()), err) == (lines, "")
    assert run.flow.end.done() is once


async def test_the_summary_names_losses_only(run):
    publish_ = "0 results published in 0.0 s"
    assert run.master.summary() == publish_
    run.flow.losses[LossReason.FAILED] = 2
    assert run.master.summary() == f"{publish_}; not published: 2 {LossReason.FAILED}"


async def test_the_summary_says_that_nobody_saw_a_result(run):
    run.take(run.publisher, Seen(False))
    assert run.master.summary() == "0 results published in 0.0 s, but none was seen on the wire"
    run.take(run.publisher, Seen(True))
    assert run.master.summary() == "0 results published in 0.0 s"


@pytest.mark.parametrize("has_data", [True, False])
async def test_a_run_without_data_ends(boat, monkeypatch, has_data):
    monkeypatch.setattr("services.master.run._GRACE_PERIOD", 3)
    run, slept, sleep = Run(boat, first_data_timeout=40), [], asyncio.sleep
    monkeypatch.setattr(asyncio, "sleep", AsyncMock(side_effect=slept.append))
    expecting = asyncio.ensure_future(run.master._expect_data())
    await sleep(0)
    assert slept == []  # the time begins with the run
    run.peers.begun.set()
    if has_data:
        run.read()
    await expecting
    assert slept == [43]
    assert isinstance(run.error, NoDataError) is not has_data


@pytest.mark.parametrize("given", [{"json": True}, {"plot": True}, {"once": True}, {}])
async def test_progress_does_not_run_into_results(boat, given):
    assert Run(boat, **given).master._shows_progress is not bool(given)


@pytest.mark.parametrize(("count", "of"), [(9, " of 9"), (None, "")])
async def test_progress_tells_the_rate_since_the_last_time(boat, monkeypatch, count, of):
    now, shown = [100.0], []
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr("services.master.run.show_progress", shown.append)
    run = Run(boat, queue="all", count=count)

    def publish_some(numbers):
        for number in numbers:
            publish(run, number)

    seconds = iter(
        [lambda: run.read(7), lambda: publish_some(range(1, 5)), int, lambda: publish_some([5, 6])]
    )

    async def sleep(_seconds):
        now[0] += 2.0
        next(seconds)()

    monkeypatch.setattr(asyncio, "sleep", sleep)
    with pytest.raises(RuntimeError):  # there are no more seconds
        await run.master._show_progress()
    # the newest posterior follows
    assert [line.split("; frame ")[0] for line in shown] == [
        f"master: 4{of} results, 2 a second",
        f"master: 6{of} results, 1 a second",
    ]
    assert [line.split("; frame ")[1].split(":")[0] for line in shown] == ["4", "6"]


async def test_the_newest_posterior_is_drawn_once(boat):
    run, drawn = Run(boat, queue="all", plot=True), []
    boards = len(boat.boards)
    counts = np.split(np.arange(sum(board.lines for board in boat.boards), dtype="<u4"), boards)
    whole = [BoardResult(part.tobytes(), 255, StopReason.OVERFLOW) for part in counts]
    none = [BoardResult(bytes(part.nbytes), 0, StopReason.IMPOSSIBLE) for part in counts]
    run.read(2)
    for number, boards in ((1, whole), (2, none)):
        run.take(run.app, FrameResult(number, encode_boards(boards), 0, 0, 0, 0))
        for _ in range(2):
            run.master._draw(lambda posterior, axes: drawn.append((posterior, axes)))
    ((posterior, axes),) = drawn  # the second frame has none
    assert (posterior.number, posterior.cycles) == (1, 255)
    assert posterior.best() == {axis.label: axis.size - 1 for axis in axes}
    assert [axis.label for axis in axes] == ["y", "x"]


@pytest.mark.parametrize(("once", "begun", "lines"), [(True, True, 0), (False, True, 1), (False, False, 0)])
async def test_a_run_is_open_to_questions_until_its_end(
    boat, tmp_path, monkeypatch, capsys, once, begun, lines
):
    status = Mock(return_value=nullcontext())
    monkeypatch.setattr("services.master.run.serve_status", status)
    monkeypatch.setattr("services.master.run.get_logger", log := Mock())
    run = Run(boat, once=once, run_directory=tmp_path, metrics="9999", log_level="debug")
    peers = run.peers
    peers.prepare, peers.leave, peers.end = Mock(), AsyncMock(), AsyncMock()
    started = asyncio.Event()
    peers.start = AsyncMock(side_effect=lambda _: started.set())
    running = asyncio.ensure_future(run.master.run())
    await asyncio.wait_for(started.wait(), PATIENCE)
    assert not running.done()
    assert status.call_args.args == (tmp_path, "master", run.master.status)
    given = status.call_args.kwargs
    assert given["metrics"] == run.master._settings.metrics
    assert given["stages"]() == []
    if begun:
        peers.begun.set()
    run.flow.end.set_result(None)
    assert await running == 0
    assert peers.start.await_args.args == (run.flow,)
    assert (peers.leave.await_count, peers.end.await_count) == (1, 1)
    assert len(capsys.readouterr().err.splitlines()) == lines  # only a run that has begun has a summary
    assert log.call_args.args == ("master", "debug")


# --- the watch over the children ---


class Peers(list):
    """Peers that count how often they are looked through."""

    rounds = 0

    def __iter__(self):
        self.rounds += 1
        return super().__iter__()


async def test_a_child_that_does_not_answer_is_noticed(tmp_path, monkeypatch):
    now, well = [0.0], [True]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(run, "ASK_EVERY", 0.0)
    monkeypatch.setattr(run, "_ANSWER_TIME", PATIENCE)
    process = SimpleNamespace(is_running=True)
    peers = Peers(
        [
            SimpleNamespace(role="subscriber", child=process, ready=True),
            SimpleNamespace(role="publisher", child=None, ready=True),
        ]
    )
    watch = ChildrenWatch(peers, tmp_path)

    async def another_round():
        begun = peers.rounds
        async with asyncio.timeout(PATIENCE):
            while peers.rounds < begun + 2:
                await asyncio.sleep(0)

    async def is_alive():
        """Return whether the child counts as alive after a long silence."""
        await another_round()  # one that has begun may still succeed
        now[0] += STUCK_S
        await another_round()
        return watch.is_alive()

    status = ProcessStatus(ready=True, why="")
    async with serve_status(tmp_path, "subscriber", lambda: status, is_alive=lambda: well[0]):
        asking = asyncio.ensure_future(watch.run())
        assert await is_alive()
        well[0] = False
        now[0] += STUCK_S - 1
        assert watch.is_alive()  # not yet
        assert not await is_alive()
        process.is_running = False  # the master restarts it
        assert await is_alive()
        process.is_running = True
        assert not await is_alive()
        well[0] = True
        assert await is_alive()
    assert not await is_alive()  # nothing listens
    asking.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asking
