"""Processes of boards: one process for a single board, or a process that loads the kernels and forks several boards."""

import asyncio
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Final, NoReturn

from pcie_shim.board.emulated_board import EmulatedBoard
from pcie_shim.board.server import Board, StopSignal, serve_board
from pcie_shim.endpoint import Endpoint, is_served
from pcie_shim.link_rate import LinkModel, link_model
from services.boards.hardware import SimulatedHardware
from services.child import ForkedChild, end_all
from services.errors import BoardFailedError, SettingsError
from services.settings import Settings, endpoint_in
from services.sockets.reporting import STUCK_S, ServiceManager, serve_status_in_thread, shifted
from services.sockets.status import BoardStatus, ProcessStatus
from terminal.logs import PARENT_VARIABLE, name_process
from terminal.output import say
from terminal.run_directory import remove_stale_sockets
from terminal.signals import ENDING_SIGNALS, check_signals, run_async, stopped_error

_ENDING_TIME: Final = 5.0
"""Seconds to wait at the start until the boards of an earlier, killed process have exited."""
_STOPPING_S: Final = 2.0
"""Seconds after which a board that does not end is killed."""
_LISTENS: Final = 128
"""Added to a board's number in the sign of life that tells the parent process that the board listens."""


def blank_board(index: int, settings: Settings, hardware: SimulatedHardware | None) -> Board:
    """Return a blank board. If `hardware` is None, the board is emulated; otherwise its hardware is simulated."""
    return (
        EmulatedBoard(sends_results=not settings.read_results) if hardware is None else hardware.board(index)
    )


def serve_one(
    endpoint: Endpoint,
    index: int,
    directory: Path | None,
    *,
    board: Board,
    link: LinkModel | None,
    metrics: str = "",
    restarts: int = 0,
    on_ready: Callable[[], None],
    on_alive: Callable[[], None] = lambda: None,
) -> NoReturn:
    """Serve one board in this process until a signal, then close the board and raise a StoppedError.

    `directory` is the folder of the process's status socket, or None for no status socket. `on_ready` is called when
    the board's two sockets listen. `on_alive` is called every second while the board is not stuck.
    """
    stop = StopSignal()
    ended_by: list[int] = []
    listening = threading.Event()

    def end(number: int, _frame: object) -> None:
        ended_by.append(number)
        stop.set()

    # in this thread, which serves; the status is answered in another one
    for number in ENDING_SIGNALS:
        signal.signal(number, end)
    check_signals()

    def status() -> ProcessStatus:
        image = board.image_hash if board.image_hash.strip("0") else ""
        state = "starting" if not listening.is_set() else "programmed" if image else "blank"
        where = f"listening at {endpoint}, {state}" if listening.is_set() else f"starting at {endpoint}"
        own = BoardStatus(index=index, endpoint=str(endpoint), state=state, image=image, restarts=restarts)
        return ProcessStatus(ready=listening.is_set(), why=where, boards=[own])

    def ready(_board: Board) -> None:
        listening.set()
        on_ready()

    def is_alive() -> bool:
        # `turned` is 0 before the board serves, and its start has limits of its own
        is_alive = not board.turned or time.monotonic() - board.turned < STUCK_S
        if is_alive:
            on_alive()
        return is_alive

    name = f"board{index}"
    with closing(board), serve_status_in_thread(directory, name, status, metrics=metrics, is_alive=is_alive):
        serve_board(endpoint, index=index, stop=stop, board=board, link=link, on_ready=ready)
    raise stopped_error(ended_by[0])


def _await_free(endpoint: Endpoint, limit: float) -> None:
    """Wait until no other process listens at an endpoint, or raise a SettingsError after `limit` seconds.

    After this call, a process that listens at the endpoint counts as one of our own boards.
    """
    deadline = time.monotonic() + limit
    for each in (endpoint, endpoint.programming):
        while is_served(each.path):
            if time.monotonic() >= deadline:
                raise SettingsError(
                    f"another process listens at {each}; stop it, or give another --directory"
                )
            check_signals()
            time.sleep(0.01)


class BoardProcesses:
    """Boards from 0 to `count` - 1, each in a fork of this process. All forks share the kernels loaded here."""

    def __init__(
        self,
        directory: Path,
        count: int,
        restarts: int,
        settings: Settings,
        hardware: SimulatedHardware | None = None,
    ) -> None:
        """Put sockets of boards into `directory`. At most `restarts` restarts may happen within `restart_window`."""
        self._endpoints = [endpoint_in(directory, f"board{at}") for at in range(count)]
        self._settings = settings
        self._hardware = hardware

        # before the forks, because a cable is shared by all boards
        self._link = link_model(settings.link_rate)

        # one for all boards: the limit of restarts concerns them together
        self._ends: deque[float] = deque(maxlen=restarts + 1)
        self._children = [
            ForkedChild(f"board {at}", partial(self._serve, at), ends=self._ends) for at in range(count)
        ]

        # False under a master, which watches its boards itself
        self._reports = PARENT_VARIABLE not in os.environ

        # in the parent, because a service manager accepts messages only from its own child
        self._manager = ServiceManager()

        # Boards write their number into this pipe: plus _LISTENS when their sockets listen, and every second while they
        # are not stuck. `_heard` has the monotonic time of the last sign of each.
        self._signs, self._write_sign = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._heard = [0.0] * count
        self._listening: set[int] = set()

        # True once all boards have listened at the same time, which is reported once
        self._announced = False

    def run(self) -> NoReturn:
        """Keep the boards running until a signal ends this process. If they exit too often, raise BoardFailedError."""
        from machines import warm_up

        # children share these pages, because four imports of numba would take 1.6 s
        warm_up()
        for endpoint in self._endpoints:
            _await_free(endpoint, 0.0 if self._reports else _ENDING_TIME)
        run_async(self._run())
        raise AssertionError("boards run until a signal or an error")

    async def _run(self) -> None:
        asyncio.get_running_loop().add_reader(self._signs, self._take_signs)
        keepers = [asyncio.create_task(self._keep(at)) for at in range(len(self._children))]
        try:
            while True:
                ended, _ = await asyncio.wait(keepers, timeout=1, return_when=asyncio.FIRST_COMPLETED)
                for keeper in ended:
                    keeper.result()
                self._report()
        finally:
            self._manager.stopping()
            for keeper in keepers:
                keeper.cancel()
            await end_all(self._children, _STOPPING_S)
            self._remove_sockets()

    async def _keep(self, at: int) -> None:
        """Start a board, and restart it until the boards have exited too often."""
        child = self._children[at]
        while True:
            self._heard[at] = time.monotonic()
            await child.start()
            await child.wait()
            self._listening.discard(at)
            window = self._settings.restart_window
            if not child.may_restart(window):
                ends = len(self._ends)
                often = f", {ends} exits of boards within {window:g} s" if ends > 1 else ""
                raise BoardFailedError(f"{child.failure()}{often}")
            say(f"{child.failure()}; restarting it")

    def _serve(self, at: int) -> NoReturn:
        """Serve a board in its process."""
        name_process(f"board{at}")
        serve_one(
            self._endpoints[at],
            at,
            self._settings.run_directory,
            board=blank_board(at, self._settings, self._hardware),
            link=self._link,
            metrics=shifted(self._settings.metrics, at),
            restarts=self._children[at].restarts,
            on_ready=lambda: self._sign(_LISTENS + at),
            on_alive=lambda: self._sign(at),
        )

    def _sign(self, sign: int) -> None:
        """In a board's process, write a byte to the parent: that the board lives, or that it listens."""
        with suppress(OSError):
            os.write(self._write_sign, bytes([sign]))

    def _take_signs(self) -> None:
        for sign in os.read(self._signs, 1 << 12):
            self._hear(sign % _LISTENS, listens=sign >= _LISTENS)
        self._report()

    def _hear(self, at: int, *, listens: bool) -> None:
        """Handle the sign of board `at` that the board lives or, with `listens`, that the board listens.

        Print a line when all boards listen. From then on, print a line for each board that listens again.
        """
        self._heard[at] = time.monotonic()
        if not listens:
            return
        self._listening.add(at)
        is_back = self._announced
        self._announced = is_back or len(self._listening) == len(self._endpoints)
        if not self._reports or not self._announced:
            return
        if is_back:
            say(f"board {at} listens again at {self._endpoints[at]}")
            return
        first, last, count = self._endpoints[0], self._endpoints[-1], len(self._endpoints)
        say(f"board 0 listens at {first}" if count == 1 else f"{count} boards listen at {first} ... {last}")

    def _report(self) -> None:
        """Tell the service manager how many boards listen, and whether all of them make progress."""
        # a board without a sign so far counts from its start
        count, now = len(self._endpoints), time.monotonic()
        self._manager.report(
            f"{len(self._listening)} of {count} boards listen",
            ready=len(self._listening) == count,
            alive=all(now - heard < STUCK_S for heard in self._heard),
        )

    def _remove_sockets(self) -> None:
        """Remove the sockets that killed boards have left behind."""
        for path in [each.path for one in self._endpoints for each in (one, one.programming)]:
            with suppress(OSError):
                Path(path).unlink()
        if self._settings.run_directory is not None:
            remove_stale_sockets(self._settings.run_directory)
