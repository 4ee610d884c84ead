"""pcie-app between a master and boards that the test controls.

link.take(FrameRequest) ──▶ PcieApp ──▶ Boards.post;  Boards.finish() ──▶ PcieApp ──▶ link.sent
"""

import asyncio
import os
from types import SimpleNamespace

import pytest

from pcie_shim.errors import BoardError, FrameInputError
from services.boards.frames import BoardAwayError
from services.pipeline import pcie_app
from services.pipeline.pcie_app import PcieApp
from services.settings import Settings
from services.sockets import records
from tests.patience import PATIENCE

OUTPUT = SimpleNamespace(boards=[], compute_ns=2)


class Boards:
    """Boards whose frames end when the test says so."""

    def __init__(self):
        self.deployment = SimpleNamespace(hash="abc")
        self.gone, self.frames, self.recovers = {}, [], []
        self.output = self.refusal = None
        self.is_late = False
        self.awaited, self._write = os.pipe()

    def open(self):
        return "open"

    def post(self, frame):
        if self.refusal is not None:
            raise self.refusal
        if self.gone:
            raise BoardAwayError("board 2 is not back yet", board=2)
        self.frames.append(frame.number)

    def collect(self):
        os.read(self.awaited, 1)
        if isinstance(self.output, Exception):
            raise self.output
        return self.output

    def finish(self, output=OUTPUT):
        self.output = output
        os.write(self._write, b"x")

    def find_lost_boards(self, error):
        if not isinstance(error, BoardAwayError):
            self.gone[error.board] = str(error)

    def recover(self):
        result = self.recovers.pop(0) if self.recovers else []
        if isinstance(result, Exception):
            raise result
        for board in result:
            del self.gone[board]
        return result

    def status(self, output):
        return []

    def close(self):
        os.close(self.awaited)
        os.close(self._write)


class Stage:
    """A running service, its boards, and the master's end of its link."""

    def __init__(self, link):
        self.boards, self.link = Boards(), link
        self.app = PcieApp(Settings(), self.boards, link.make)
        self.task = asyncio.ensure_future(self.app.run())

    async def sent(self, kind, count=1):
        """The records of a kind, once there are `count`."""
        await self.link.until(lambda: len(self.link.of(kind)) >= count)
        assert len(self.link.of(kind)) == count
        return self.link.of(kind)


@pytest.fixture
async def stage(link, monkeypatch):
    monkeypatch.setattr(pcie_app, "TICK", 0.005)
    monkeypatch.setattr(
        pcie_app, "result_record", lambda number, _: records.FrameResult(number, None, 1, 2, 3, 4)
    )
    link.masters = 1
    stage = Stage(link)
    assert not stage.app.status().ready
    await stage.sent(records.Ready)
    yield stage
    stage.task.cancel()
    await asyncio.wait([stage.task])


def frame(number):
    return records.FrameRequest(number, [1], 0)


async def test_a_frame_is_computed(stage):
    for number in (1, 2):
        stage.link.take(frame(number))
        stage.boards.finish(None)  # one board of several
        stage.boards.finish()
        assert (await stage.sent(records.FrameResult, number))[-1].number == number
    status = stage.app.status()
    assert (status.ready, status.frames.received, status.frames.completed) == (True, 2, 2)
    assert (status.frames.last_number, status.frames.lost) == (2, {})


async def test_a_master_gets_no_result_of_a_former_one(stage):
    """Both number their frames from 1."""
    stage.link.take(frame(1))
    stage.link.masters = 2
    stage.link.take(frame(1))
    assert stage.boards.frames == [1]  # the boards are busy
    stage.boards.finish()
    await stage.link.until(lambda: stage.boards.frames == [1, 1])
    assert not stage.link.of(records.FrameResult)
    stage.boards.finish()
    await stage.sent(records.FrameResult)


async def test_a_board_that_fails_is_recovered(stage):
    stage.link.take(frame(1))
    stage.boards.finish(BoardError("board 2 died", board=2))
    (failed,) = await stage.sent(records.FrameFailed)
    assert (failed.number, failed.board, failed.reason) == (1, 2, records.FailureReason.FAILED)
    assert stage.app.status().why == "board 2 died"
    stage.link.take(frame(2))
    assert (await stage.sent(records.FrameFailed, 2))[1].reason is records.FailureReason.AWAY
    assert stage.app.status().frames.lost == {"failed on a board": 2}
    stage.boards.recovers = [[2]]
    await stage.sent(records.Notice)
    stage.link.take(frame(3))
    stage.boards.finish()
    assert (await stage.sent(records.FrameResult))[0].number == 3


async def test_a_board_that_is_late_fails_its_frame(stage):
    stage.link.take(frame(1))
    stage.boards.output = BoardError("board 2 is late", board=2)
    os.write(stage.boards._write, b"xx")
    stage.app._unwatch()  # nothing arrives from the board
    stage.boards.is_late = True
    await stage.sent(records.FrameFailed)


@pytest.mark.parametrize(
    "error", [FrameInputError("too many addresses"), BoardError("another image", board=2, exit_code=2)]
)
async def test_an_error_that_no_wait_can_mend_ends_the_service(stage, error):
    if isinstance(error, FrameInputError):
        stage.boards.refusal = error
        stage.link.take(frame(1))
    else:
        stage.boards.gone[2] = "gone"
        stage.boards.recovers = [error]
    with pytest.raises(type(error)):
        await asyncio.wait_for(stage.task, PATIENCE)
    assert (await stage.sent(records.Trouble))[0].exit_code == error.exit_code
