"""Processes of emulated boards: a single one, or a mini-cluster forked from a process with loaded kernels."""

import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NoReturn

from pcie_shim.board.rtl_board import RtlBoard
from pcie_shim.board.server import Board, StopSignal, serve_board
from pcie_shim.endpoint import Endpoint, is_served
from services.boards.hardware import SimulatedHardware
from services.errors import BoardFailedError, SettingsError
from services.settings import Settings, endpoint_in
from services.sockets.reporting import STUCK_S, serve_status_in_thread, shifted
from services.sockets.status import BoardStatus, ProcessStatus
from services.supervision.child import describe_exit
from services.supervision.parent import end_with_parent, outlive_parent
from services.supervision.service_manager import ServiceManager
from terminal.errors import StoppedError, exit_code_of
from terminal.logs import PARENT_VARIABLE, name_process
from terminal.output import say, say_error
from terminal.private_directory import remove_stale_sockets
from terminal.signals import check_signals

_ENDING_TIME: Final = 5.0
"""Seconds in which boards of a killed process of the same master end, even if they are stopped for a moment."""
_LISTENS: Final = 128
"""Added to the number of a board whose sign says that it listens; otherwise it only lives."""


def serve_one(
    endpoint: Endpoint,
    index: int,
    directory: Path | None,
    *,
    board: RtlBoard | None = None,
    metrics: str = "",
    restarts: int = 0,
    on_ready: Callable[[], None],
    on_alive: Callable[[], None] = lambda: None,
) -> int:
    """Serve one board in this process until a signal, and return the signal's number.

    `board` is None for an emulated one, and is closed at the end; `directory` is the folder of its status socket,
    if any; `on_ready` is called when both its sockets are listening, and `on_alive` every second while the board
    is not stuck.
    """
    stop = StopSignal()
    ended_by: list[int] = []

    def end(number: int, _frame: object) -> None:
        ended_by.append(number)
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    listening: list[Board] = []

    def status() -> ProcessStatus:
        image = listening[0].image_hash if listening else ""
        blank = not image.strip("0")
        state = "starting" if not listening else "blank" if blank else "programmed"
        board = BoardStatus(
            index=index, endpoint=str(endpoint), state=state, image="" if blank else image, restarts=restarts
        )
        where = f"listening at {endpoint}, {state}" if listening else f"starting at {endpoint}"
        return ProcessStatus(ready=bool(listening), why=where, boards=[board])

    def ready(board: Board) -> None:
        listening.append(board)
        on_ready()

    def is_alive() -> bool:
        turned = listening[0].turned if listening else 0.0
        is_alive = not turned or time.monotonic() - turned < STUCK_S
        if is_alive:
            on_alive()
        return is_alive

    name = f"board{index}"
    try:
        with serve_status_in_thread(directory, name, status, metrics=metrics, is_alive=is_alive):
            serve_board(endpoint, index=index, stop=stop, board=board, on_ready=ready)
    finally:
        if board is not None:
            board.close()
    return ended_by[0] if ended_by else 0


def _await_free(endpoint: Endpoint, limit: float) -> None:
    """Wait until no other process listens at an endpoint, or raise an error; later, a socket there counts as ours."""
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
    """Boards 0 to n-1, each in a process forked from this one."""

    def __init__(
        self,
        directory: Path,
        count: int,
        restarts: int,
        settings: Settings,
        hardware: SimulatedHardware | None = None,
    ) -> None:
        self._endpoints = [endpoint_in(directory, f"board{at}") for at in range(count)]
        self._restarts = restarts
        self._restart_window = settings.restart_window
        self._run_directory = settings.run_directory
        self._metrics = settings.metrics
        self._hardware = hardware
        self._reports = PARENT_VARIABLE not in os.environ  # a master monitors its boards itself
        self._manager = ServiceManager()  # here, because a service manager hears only its own child
        self._signs, self._write_sign = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._heard = [0.0] * count
        self._listening: set[int] = set()
        self._announced = False
        self._started: dict[int, int] = {}
        self._starts = [0] * count
        self._ends: list[float] = []

    def run(self) -> NoReturn:
        """Keep the boards running until a signal raises here, or boards exit too often (BoardFailedError)."""
        from machines import warm_up

        # children share these pages, because four imports of numba would take 1.6 s
        warm_up()
        for endpoint in self._endpoints:
            _await_free(endpoint, 0.0 if self._reports else _ENDING_TIME)
        try:
            for at in range(len(self._endpoints)):
                self._fork(at)
            while True:
                check_signals()
                self._wait()
                self._report()
        finally:
            self._manager.stopping()
            self._end_all()

    def _wait(self) -> None:
        """Handle signs and exits of boards, for at most a second."""
        poll = select.poll()
        poll.register(self._signs, select.POLLIN)
        with contextlib.ExitStack() as descriptors:
            for pid in self._started:
                descriptor = os.pidfd_open(pid)
                descriptors.callback(os.close, descriptor)
                poll.register(descriptor, select.POLLIN)
            poll.poll(1000)
        with contextlib.suppress(BlockingIOError):
            for sign in os.read(self._signs, 1 << 12):
                self._hear(sign % _LISTENS, listens=sign >= _LISTENS)
        for pid in list(self._started):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                self._ended(self._started.pop(pid), os.waitstatus_to_exitcode(status))

    def _report(self) -> None:
        """Tell the service manager how many boards listen, and that none of them is stuck."""
        count, now = len(self._endpoints), time.monotonic()
        self._manager.report(
            f"{len(self._listening)} of {count} boards listen",
            ready=len(self._listening) == count,
            alive=all(now - heard < STUCK_S for heard in self._heard),
        )

    def _tell(self, sign: int) -> None:
        """Write a sign of a board, in its process; the parent reads them all the time."""
        with contextlib.suppress(OSError):
            os.write(self._write_sign, bytes([sign]))

    def _fork(self, at: int) -> None:
        parent = os.getpid()
        self._starts[at] += 1
        self._heard[at] = time.monotonic()
        pid = os.fork()
        if pid:
            self._started[pid] = at
            return
        code = 1
        try:
            os.environ[PARENT_VARIABLE] = str(parent)
            name_process(f"board{at}")
            end_with_parent()
            ended_by = serve_one(
                self._endpoints[at],
                at,
                self._run_directory,
                board=None if self._hardware is None else self._hardware.board(at),
                metrics=shifted(self._metrics, at),
                restarts=self._starts[at] - 1,
                on_ready=lambda: self._tell(_LISTENS + at),
                on_alive=lambda: self._tell(at),
            )
            code = 128 + ended_by if ended_by else 0
        except StoppedError as stopped:
            code = stopped.exit_code
        except BaseException as error:  # the child must never continue in the code of its parent
            code = exit_code_of(error)
            say_error(f"board {at}: {error}")
        finally:
            with contextlib.suppress(Exception):
                sys.stderr.flush()
            os._exit(code)

    def _hear(self, at: int, *, listens: bool) -> None:
        """Take a sign of a board, and print that all boards are ready, or that one is back."""
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
        elif len(self._endpoints) == 1:
            say(f"board 0 listens at {self._endpoints[0]}")
        else:
            say(f"{len(self._endpoints)} boards listen at {self._endpoints[0]} ... {self._endpoints[-1]}")

    def _ended(self, at: int, code: int) -> None:
        self._listening.discard(at)
        now = time.monotonic()
        self._ends = [each for each in self._ends if now - each <= self._restart_window] + [now]
        if len(self._ends) > self._restarts:
            often = (
                f", {len(self._ends)} exits of boards within {self._restart_window:g} s"
                if self._restarts
                else ""
            )
            raise BoardFailedError(f"board {at} {describe_exit(code)}{often}")
        say(f"board {at} {describe_exit(code)}; restarting it")
        self._fork(at)

    def _end_all(self) -> None:
        for pid in self._started:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
        deadline = time.monotonic() + 2
        while self._started and time.monotonic() < deadline:
            with contextlib.suppress(ChildProcessError):
                pid, _ = os.waitpid(-1, os.WNOHANG)
                self._started.pop(pid, None)
                if not pid:
                    time.sleep(0.005)
                continue
            break
        for pid in self._started:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)  # its sockets accept connections until it has exited
        for at in range(len(self._endpoints)):
            self._remove_sockets(self._endpoints[at])
        if self._run_directory is not None:
            outlive_parent()
            remove_stale_sockets(self._run_directory)

    def _remove_sockets(self, endpoint: Endpoint) -> None:
        # a killed board leaves its socket files behind
        for each in (endpoint, endpoint.programming):
            with contextlib.suppress(OSError):
                Path(each.path).unlink()
