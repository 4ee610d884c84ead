"""Subscriber, publisher and pcie-app inside the process of the master (`master --fused`).

Records are passed by calls instead of over local sockets. Boards remain separate processes or devices.
"""

import asyncio
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from typing import Any, TypeVar, cast

from pcie_shim.errors import BoardError, PcieShimError
from services.boards.deployed import TICK, DeployedBoards
from services.boards.frames import frame_failed, result_record
from services.master.command_lines import METRICS_PORTS
from services.pipeline.pcie_app import ROLE as PCIE_APP
from services.pipeline.pcie_app import Progress
from services.pipeline.publisher import Publisher
from services.pipeline.result_topics import ROLE as PUBLISHER
from services.pipeline.subscriber import ROLE as SUBSCRIBER
from services.pipeline.subscriber import Subscriber
from services.settings import Settings
from services.sockets.records import AnyRecord, Frame, Notice, Ready, Record, Trouble
from services.sockets.reporting import serve_status, shifted
from services.sockets.serving import Link, MakeLink, board_endpoints
from terminal.errors import exit_code_of
from toolchain.deployment import Deployment

Result = TypeVar("Result")
TakeRecord = Callable[[AnyRecord], None]


class FusedLink(Link):
    """Link of a service to the master in the same process."""

    def __init__(self, to_master: TakeRecord) -> None:
        self._to_master: TakeRecord | None = to_master

    async def __aexit__(self, *_: object) -> None:
        """Stop passing on records."""
        self._to_master = None

    @property
    def has_master(self) -> bool:
        """True while the link is open."""
        return self._to_master is not None

    def send(self, record: Record) -> bool:
        """Pass a record to the master; return whether the link is open."""
        if self._to_master is None:
            return False
        self._to_master(cast("AnyRecord", record))
        return True


class FusedEnd:
    """The master's end of a fused link, in place of a socket connection."""

    def __init__(self, role: str, to_service: TakeRecord) -> None:
        self.where = f"{role} in this process"
        self._to_service = to_service

    def send(self, record: Record) -> bool:
        """Pass a record to the service."""
        self._to_service(cast("AnyRecord", record))
        return True

    def close(self) -> None:
        """Do nothing, because the service ends when its task is cancelled."""


class FusedBoards:
    """pcie-app in an event loop: a frame is posted, and collected when the last board has answered.

    Slow work (opening boards, recovering them) runs in a thread; no frame is posted meanwhile.
    """

    def __init__(self, boards: DeployedBoards, settings: Settings, link: MakeLink) -> None:
        self._boards = boards
        self._settings = settings
        self._progress = Progress(boards, settings.log_level)
        self._link = link(self._take)
        self._number: int | None = None  # that of the posted frame
        self._next_frame: Frame | None = None  # it waits for the search of lost boards
        self._watched: int | None = None
        self._loop = asyncio.get_running_loop()
        self._looking: asyncio.Task[None] | None = None
        self._one_thread = asyncio.Lock()

    async def run(self) -> int:
        """Serve until cancelled.

        Raises:
            PcieShimError: The boards cannot be opened, or a board came back with another image.
        """
        settings, get_status = self._settings, self._progress.status
        status = serve_status(settings.run_directory, PCIE_APP, get_status, metrics=settings.metrics)
        async with self._link, status:
            try:
                self._progress.ready = Ready(await _in_thread(self._boards.open))
                self._link.keep(self._progress.ready)
                while True:
                    await asyncio.sleep(TICK)
                    if self._number is not None:
                        if self._boards.is_late:
                            self._collect()
                    elif self._looking is not None or self._one_thread.locked():
                        pass
                    elif self._boards.gone:
                        async with self._one_thread:
                            back = await _in_thread(self._boards.recover)
                        for board in back:
                            self._link.send(Notice("info", f"board {board} is back, programmed"))
            except PcieShimError as error:
                self._link.send(Trouble(exit_code_of(error), str(error)))
                raise
            finally:
                self._unwatch()
                if self._looking is not None:
                    self._looking.cancel()
                self._boards.close()

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, Frame):
            self._post(record)

    def _start_next_frame(self) -> None:
        if self._next_frame is not None:
            frame, self._next_frame = self._next_frame, None
            self._start(frame)

    def _post(self, record: Frame) -> None:
        if self._number is not None or self._looking is not None:
            self._next_frame = record
            return
        self._start(record)

    def _start(self, record: Frame) -> None:
        self._progress.asked += 1
        try:
            self._boards.post(record)
        except BoardError as error:
            self._failed(record.number, error)
        else:
            self._number = record.number
            self._watch()

    def _watch(self) -> None:
        """Wake up when the awaited board has sent bytes."""
        awaited = self._boards.awaited
        if awaited != self._watched:
            self._unwatch()
            if awaited is not None:
                self._loop.add_reader(awaited, self._collect)
                self._watched = awaited

    def _unwatch(self) -> None:
        if self._watched is not None:
            self._loop.remove_reader(self._watched)
            self._watched = None

    def _collect(self) -> None:
        number = self._number
        if (
            number is None
        ):  # a board that sends unexpected data is closing its link, which the next frame detects
            self._unwatch()
            return
        try:
            output = self._boards.collect()
        except BoardError as error:
            self._failed(number, error)
            return
        if output is None:
            self._watch()
            return
        self._number = None
        self._progress.computed(number, output)
        self._link.send(result_record(number, output))
        if self._number is None:  # sending may have brought the next frame
            self._start_next_frame()

    def _failed(self, number: int, error: BoardError) -> None:
        self._unwatch()
        self._progress.failed += 1
        self._number = None
        self._looking = self._loop.create_task(self._find_lost_boards(number, error))

    async def _find_lost_boards(self, number: int, error: BoardError) -> None:
        """Find all lost boards, and then report the frame as failed."""
        try:
            async with self._one_thread:
                await _in_thread(lambda: self._boards.find_lost_boards(error))
        finally:
            self._looking = None
        self._link.send(frame_failed(number, error))


async def _in_thread(work: Callable[[], Result]) -> Result:
    """Run slow work in a thread that does not delay the end of the run."""
    done: Future[Result] = Future()
    done.set_running_or_notify_cancel()  # from now on, cancelling the waiter does not cancel it

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return await asyncio.wrap_future(done)


def fused_services(
    settings: Settings, deployment: Deployment, to_master: Callable[[str], TakeRecord]
) -> dict[str, tuple[FusedEnd, Coroutine[Any, Any, int]]]:
    """Return the three services by role: the master's end of the link, and the coroutine of the service.

    `to_master` returns the function that receives the records of a role.

    Raises:
        SettingsError: The endpoints of the boards are invalid.
    """
    ends: dict[str, FusedEnd] = {}

    def link_of(role: str) -> MakeLink:
        def make(to_service: TakeRecord) -> Link:
            ends[role] = FusedEnd(role, to_service)
            return FusedLink(to_master(role))

        return make

    def settings_of(role: str) -> Settings:
        return settings.model_copy(update={"metrics": shifted(settings.metrics, METRICS_PORTS[role])})

    boards = DeployedBoards(settings, deployment, board_endpoints(settings, deployment))
    running = {
        SUBSCRIBER: Subscriber(settings_of(SUBSCRIBER), deployment, link_of(SUBSCRIBER)).run(),
        PUBLISHER: Publisher(settings_of(PUBLISHER), deployment, link_of(PUBLISHER)).run(),
        PCIE_APP: FusedBoards(boards, settings_of(PCIE_APP), link_of(PCIE_APP)).run(),
    }
    return {role: (ends[role], coroutine) for role, coroutine in running.items()}
