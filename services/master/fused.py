"""Subscriber, publisher and PCIe application inside the master's process (`master --fused`): fewer hops, same code.

Their records go from call to call instead of over local sockets, and nothing is written or read in between.
Boards stay processes, or devices, of their own.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Self, TypeVar, cast

from pcie_shim.errors import BoardError, PcieShimError
from services.pipeline.deployed_boards import TICK, DeployedBoards
from services.pipeline.driver_frames import frame_failed, result_record
from services.pipeline.pcie_app import ROLE as PCIE_APP
from services.pipeline.pcie_app import Progress
from services.pipeline.publisher import Publisher
from services.pipeline.result_topics import ROLE as PUBLISHER
from services.pipeline.subscriber import ROLE as SUBSCRIBER
from services.pipeline.subscriber import Subscriber
from services.settings import Settings
from services.sockets.records import AnyRecord, Frame, Notice, Prepare, Ready, Record, Switch, Trouble
from services.sockets.serving import Link, MakeLink, board_endpoints
from services.sockets.status import status_served
from terminal.errors import exit_code_of
from toolchain.deployment import Deployment

Result = TypeVar("Result")
Hear = Callable[[AnyRecord], None]


class FusedLink:
    """A service's link to the master that it lives in."""

    def __init__(self, to_master: Hear) -> None:
        self._to_master: Hear | None = to_master

    async def __aenter__(self) -> Self:
        """There is nothing to listen on."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Say no more."""
        self._to_master = None

    @property
    def has_master(self) -> bool:
        """The master is there until the link is closed."""
        return self._to_master is not None

    @property
    def backlog(self) -> int:
        """Nothing ever waits."""
        return 0

    def send(self, record: Record) -> bool:
        """Hand a record to the master."""
        if self._to_master is None:
            return False
        self._to_master(cast("AnyRecord", record))
        return True

    def keep(self, record: Record) -> None:
        """Hand a record to the master: there will be no other one."""
        self.send(record)

    def notice(self, level: str, sentence: str) -> None:
        """Tell the master something that ends nothing."""
        self.send(Notice(level, sentence))

    def serve(self, deployment: Deployment) -> None:
        """There is no other master to greet."""


class FusedEnd:
    """The master's end of such a link: what a local socket's connection is to it otherwise."""

    def __init__(self, role: str, to_service: Hear) -> None:
        self.where = f"{role} in this process"
        self._to_service = to_service

    def send(self, record: Record) -> bool:
        """Hand a record to the service."""
        self._to_service(cast("AnyRecord", record))
        return True

    def close(self) -> None:
        """The service ends when what runs it is cancelled."""


class FusedBoards:
    """The PCIe application in an event loop: a frame is posted, and collected when the last board's answer is there.

    What takes long, opening boards, looking for those that are gone, and reloading, is done by a thread; meanwhile no frame is posted.
    """

    def __init__(self, boards: DeployedBoards, settings: Settings, link: MakeLink) -> None:
        self._boards = boards
        self._run_directory = settings.run_directory
        self._progress = Progress(boards, settings.log_level)
        self._link = link(self._take)
        self._number: int | None = None
        self._watched: int | None = None
        self._loop = asyncio.get_running_loop()
        self._looking: asyncio.Task[None] | None = None
        self._one_thread = asyncio.Lock()
        self._reloading: asyncio.Task[None] | None = None

    async def run(self) -> int:
        """Serve until cancelled.

        Raises:
            PcieShimError: the boards can't be opened, or one came back as another.
        """
        async with self._link, status_served(self._run_directory, PCIE_APP, self._progress.status):
            try:
                self._progress.ready = Ready(await _in_thread(self._boards.open))
                self._link.keep(self._progress.ready)
                while True:
                    await asyncio.sleep(TICK)
                    if self._number is not None:
                        if self._boards.is_late:
                            self._collect()
                    elif self._boards.gone and self._looking is None:
                        async with self._one_thread:
                            back = await _in_thread(self._boards.recover)
                        for board in back:
                            self._link.send(Notice("info", f"board {board} is back, programmed"))
            except PcieShimError as error:
                self._link.send(Trouble(exit_code_of(error), str(error)))
                raise
            finally:
                self._unwatch()
                for task in (self._looking, self._reloading):
                    if task is not None:
                        task.cancel()
                self._boards.close()

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, Frame):
            self._post(record)
        elif isinstance(record, Prepare | Switch):
            self._reloading = self._loop.create_task(self._reload(record))

    async def _reload(self, record: Prepare | Switch) -> None:
        """Read images, or program boards: the master posts no frame meanwhile."""
        boards = self._boards
        answer: Record
        if isinstance(record, Prepare):
            answer = await _in_thread(lambda: boards.generations.prepare(record))
        else:
            self._unwatch()  # its link is closed, and the next one may have its descriptor
            async with self._one_thread:
                answer = await _in_thread(lambda: boards.switch(record))
        self._link.send(answer)

    def _post(self, record: Frame) -> None:
        self._progress.asked += 1
        try:
            self._boards.post(record)
        except BoardError as error:
            self._failed(record.number, error)
        else:
            self._number = record.number
            self._watch()

    def _watch(self) -> None:
        """Wake when the awaited board has said something."""
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
        if number is None:  # a board that speaks unasked is leaving: the next frame finds out
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

    def _failed(self, number: int, error: BoardError) -> None:
        self._unwatch()
        self._progress.failed += 1
        self._number = None
        self._looking = self._loop.create_task(self._look(number, error))

    async def _look(self, number: int, error: BoardError) -> None:
        try:
            async with self._one_thread:
                await _in_thread(lambda: self._boards.find_gone(error))
        finally:
            self._looking = None
        self._link.send(frame_failed(number, error))


async def _in_thread(work: Callable[[], Result]) -> Result:
    """What takes long, in a thread that nobody waits for when the run ends meanwhile."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[Result] = loop.create_future()

    def tell(result: Result | None, error: BaseException | None) -> None:
        if future.done():
            return
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(cast("Result", result))

    def run() -> None:
        result: Result | None = None
        failure: BaseException | None = None
        try:
            result = work()
        except BaseException as error:
            failure = error
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits any more
            loop.call_soon_threadsafe(tell, result, failure)

    threading.Thread(target=run, daemon=True).start()
    return await future


def fused_services(
    settings: Settings, deployment: Deployment, to_master: Callable[[str], Hear]
) -> dict[str, tuple[FusedEnd, Coroutine[Any, Any, int]]]:
    """The three services by role: the master's end of each one's link, and what runs it.

    Args:
        settings: the master's, with the boards' endpoints filled in.
        deployment: the deployment.
        to_master: gives what hears the records of a role.

    Raises:
        SettingsError: the boards' endpoints are wrong.
    """
    ends: dict[str, FusedEnd] = {}

    def link_of(role: str) -> MakeLink:
        def make(to_service: Hear) -> Link:
            ends[role] = FusedEnd(role, to_service)
            return FusedLink(to_master(role))

        return make

    boards = DeployedBoards(settings, deployment, board_endpoints(settings, deployment))
    running = {
        SUBSCRIBER: Subscriber(settings, deployment, link_of(SUBSCRIBER)).run(),
        PUBLISHER: Publisher(settings, deployment, link_of(PUBLISHER)).run(),
        PCIE_APP: FusedBoards(boards, settings, link_of(PCIE_APP)).run(),
    }
    return {role: (ends[role], coroutine) for role, coroutine in running.items()}
