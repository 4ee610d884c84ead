"""pcie-app, the only service that drives boards (thesis 3.2, figure 3.3).

    master ──FrameRequest──▶ posted ──the last board is done──────▶ FrameResult ──▶ master
                        └──a board fails──▶ lost boards are found ──▶ FrameFailed ──▶ master

At most one frame is on the boards at a time. Slow work (opening, searching and recovering boards) runs in a thread.
During slow work, no frame is posted.
"""

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from pcie_shim.errors import BoardError, PcieShimError
from pcie_shim.host.mini_cluster import FrameOutput
from services.boards.deployed import TICK, DeployedBoards
from services.boards.frames import frame_failed, result_record
from services.settings import Settings
from services.sockets.records import AnyRecord, FrameRequest, LossReason, Notice, Ready, Record
from services.sockets.serving import MakeLink, RunService
from services.sockets.status import FrameCounts, ProcessStatus

ROLE = "pcie-app"
Result = TypeVar("Result")


class PcieApp(RunService):
    """The service that computes a master's frames on the boards."""

    role = ROLE

    def __init__(self, settings: Settings, boards: DeployedBoards, link: MakeLink) -> None:
        super().__init__(settings, link)
        self._boards = boards
        # Numbers of the frame on the boards and of the master that sent it: a later master must not get the result.
        self._posted: tuple[int, int] | None = None
        # A frame that came while the boards were busy. A master waits for each result before it sends another frame,
        # so the boards still compute a frame of a former master, or are being searched.
        self._next: FrameRequest | None = None
        # The search for lost boards after a failure, while it runs. It and `DeployedBoards.recover` never run together.
        self._searching: asyncio.Task[None] | None = None
        # The descriptor on whose bytes `_collect` is called: that of the last board that is still running.
        self._watched: int | None = None
        # The error of a callback, which ends the service at the next tick.
        self._error: PcieShimError | None = None
        # For the status: the sentence once the boards are open, counts of frames, and the last computed one with its time.
        self._opened = ""
        self._asked = self._computed = self._failed = 0
        self._last: tuple[int, int, FrameOutput] | None = None

    async def _serve(self) -> None:
        """Keep the boards open, or raise a PcieShimError if one cannot be opened or comes back with another image."""
        try:
            self._opened = await _in_thread(self._boards.open)
            self._link.keep(Ready(self._opened))
            while True:
                await asyncio.sleep(TICK)
                if self._error is not None:
                    raise self._error
                if self._posted is not None and self._boards.is_late:
                    self._collect()
                elif self._boards.gone and self._searching is None:
                    for board in await _in_thread(self._boards.recover):
                        self._link.send(Notice("info", f"board {board} is back, programmed"))
        finally:
            self._unwatch()
            if self._searching is not None:
                self._searching.cancel()
            self._boards.close()

    def status(self) -> ProcessStatus:
        """Return the status of this process."""
        number, tick, output = self._last or (0, 0, None)
        gone = next(iter(dict(self._boards.gone).values()), "")  # the sentence names the board
        return ProcessStatus(
            ready=bool(self._opened) and not gone,
            why=gone or self._opened or "waiting for the boards to be opened and programmed",
            deployment=self._boards.deployment.hash,
            boards=self._boards.status(output),
            frames=FrameCounts.of(
                self._asked, self._computed, {LossReason.FAILED: self._failed}, (number, tick)
            ),
        )

    # --- a frame -------------------------------------------------------------------------------

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, FrameRequest):  # other records do not concern boards
            self._next = record
            self._post_next()

    def _post_next(self) -> None:
        frame = self._next
        if frame is None or self._posted is not None or self._searching is not None:
            return
        self._next = None
        self._posted = frame.number, self._link.masters
        self._asked += 1
        try:
            self._boards.post(frame)
        except BoardError as error:
            self._fail(error)
        except PcieShimError as error:
            self._error = error
        else:
            self._watch()

    def _watch(self) -> None:
        """Have `_collect` called when the awaited board has sent bytes."""
        awaited = self._boards.awaited
        if awaited != self._watched:
            self._unwatch()
            if awaited is not None:
                asyncio.get_running_loop().add_reader(awaited, self._collect)
                self._watched = awaited

    def _unwatch(self) -> None:
        if self._watched is not None:
            asyncio.get_running_loop().remove_reader(self._watched)
            self._watched = None

    def _collect(self) -> None:
        if self._posted is None:
            # a board that sends unexpected data is closing its link, which the next frame detects
            self._unwatch()
            return
        try:
            output = self._boards.collect()
        except BoardError as error:
            self._fail(error)
            return
        if output is None:
            self._watch()
            return
        (number, master), self._posted = self._posted, None
        self._computed += 1
        self._last = (number, time.monotonic_ns(), output)
        if self._logs_frames:
            cycles = max(board.cycles for board in output.boards)
            self._log.debug("computed", frame=number, cycles=cycles, compute_us=output.compute_ns // 1000)
        self._answer(master, result_record(number, output))
        self._post_next()

    def _fail(self, error: BoardError) -> None:
        """Find all lost boards, then report the error.

        The search comes first so that only one frame fails if several boards die together.
        """
        if self._posted is None:
            return
        (number, master), self._posted = self._posted, None
        self._failed += 1
        self._unwatch()

        async def search() -> None:
            try:
                await _in_thread(lambda: self._boards.find_lost_boards(error))
            finally:
                self._searching = None
            self._answer(master, frame_failed(number, error))
            self._post_next()

        self._searching = asyncio.ensure_future(search())

    def _answer(self, master: int, record: Record) -> None:
        """Send the result of a frame, unless the master that requested the frame is gone.

        A later master also numbers its frames from 1, and would take the result for the result of its own frame.
        """
        if master == self._link.masters:
            self._link.send(record)


async def _in_thread(work: Callable[[], Result]) -> Result:
    """Run slow work in a thread that does not delay the end of the process."""
    done: Future[Result] = Future()
    done.set_running_or_notify_cancel()  # from now on, cancelling the waiter does not cancel it

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return await asyncio.wrap_future(done)
