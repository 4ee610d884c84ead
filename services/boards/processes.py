"""Processes of emulated boards: a single one, or a mini-cluster forked from a process with loaded kernels."""

import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from pcie_shim.board.emulated_board import EmulatedBoard
from pcie_shim.board.misbehaviour import Misbehaviour
from pcie_shim.board.server import StopSignal, serve_board
from pcie_shim.endpoint import Endpoint
from services.errors import BoardFailedError, SettingsError
from services.settings import endpoint_in
from services.sockets.reporting import STUCK_S, serve_status_in_thread, shifted
from services.sockets.status import BoardStatus, ProcessStatus
from services.supervision.child import RESTARTS_WITHIN, describe_exit
from services.supervision.parent import end_with_parent
from terminal.errors import StoppedError, exit_code_of
from terminal.log_line import PARENT_VARIABLE, name_process
from terminal.output import say
from terminal.private_directory import remove_stale_sockets
from terminal.signals import check_signals


def serve_one(
    endpoint: Endpoint,
    index: int,
    misbehave: Misbehaviour | None,
    directory: Path | None,
    *,
    metrics: str = "",
    restarts: int = 0,
    on_ready: Callable[[], None],
) -> int:
    """Serve one board in this process until a signal, and return the signal's number.

    `directory` is the folder of its status socket, if any; `on_ready` is called when both its sockets are
    listening.
    """
    stop = StopSignal()
    ended_by: list[int] = []

    def end(number: int, _frame: object) -> None:
        ended_by.append(number)
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    listening: list[EmulatedBoard] = []

    def status() -> ProcessStatus:
        image = listening[0].image_hash if listening else ""
        blank = not image.strip("0")
        state = "starting" if not listening else "blank" if blank else "programmed"
        board = BoardStatus(
            index=index, endpoint=str(endpoint), state=state, image="" if blank else image, restarts=restarts
        )
        where = f"listening at {endpoint}, {state}" if listening else f"starting at {endpoint}"
        return ProcessStatus(ready=bool(listening), why=where, boards=[board])

    def ready(board: EmulatedBoard) -> None:
        listening.append(board)
        on_ready()

    def is_alive() -> bool:
        turned = listening[0].turned if listening else 0.0
        return not turned or time.monotonic() - turned < STUCK_S

    name = f"board{index}"
    with serve_status_in_thread(directory, name, status, metrics=metrics, is_alive=is_alive):
        serve_board(endpoint, index=index, stop=stop, misbehave=misbehave, on_ready=ready)
    return ended_by[0] if ended_by else 0


class _Arrivals:
    """Detection of the last of several processes: each takes a byte from a pipe, and the last empties it."""

    def __init__(self, count: int) -> None:
        self._left, write = os.pipe()
        os.set_blocking(self._left, False)
        os.write(write, bytes(count - 1))
        self._kept_open = write  # otherwise reading an empty pipe would return end of file

    def is_last(self) -> bool:
        """Arrive, and return whether this is the last process, or a later one."""
        try:
            os.read(self._left, 1)
        except BlockingIOError:
            return True
        return False


def _check_free(endpoint: Endpoint) -> None:
    """Raise an error if another process listens at an endpoint; later, a socket there counts as ours."""
    for each in (endpoint, endpoint.programming):
        with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
            probe.settimeout(1)
            probe.connect(each.path)
            raise SettingsError(f"another process listens at {each}; stop it, or give another --directory")


class BoardProcesses:
    """Boards 0 to n-1, each in a process forked from this one."""

    def __init__(
        self, directory: Path, count: int, restarts: int, run_directory: Path | None, metrics: str = ""
    ) -> None:
        self._endpoints = [endpoint_in(directory, f"board{at}") for at in range(count)]
        self._restarts = restarts
        self._run_directory = run_directory
        self._metrics = metrics
        self._reports = PARENT_VARIABLE not in os.environ  # a master monitors its boards itself
        self._arrivals = _Arrivals(count)
        self._started: dict[int, int] = {}
        self._starts = [0] * count
        self._ends: list[float] = []

    def run(self) -> NoReturn:
        """Keep the boards running until a signal raises here, or boards exit too often (BoardFailedError)."""
        from machines.kernel import warm_up

        # children share these pages, because four imports of numba would take 1.6 s
        warm_up()
        for endpoint in self._endpoints:
            _check_free(endpoint)
        try:
            for at in range(len(self._endpoints)):
                self._fork(at)
            while True:
                check_signals()
                pid, status = os.wait()
                at = self._started.pop(pid, -1)
                if at >= 0:
                    self._ended(at, os.waitstatus_to_exitcode(status))
        finally:
            self._end_all()

    def _fork(self, at: int) -> None:
        parent = os.getpid()
        self._starts[at] += 1
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
                None,
                self._run_directory,
                metrics=shifted(self._metrics, at),
                restarts=self._starts[at] - 1,
                on_ready=lambda: self._ready(at),
            )
            code = 128 + ended_by if ended_by else 0
        except StoppedError as stopped:
            code = stopped.exit_code
        except BaseException as error:  # the child must never continue in the code of its parent
            code = exit_code_of(error)
            say(f"error: board {at}: {error}")
        finally:
            with contextlib.suppress(Exception):
                sys.stderr.flush()
            os._exit(code)

    def _ready(self, at: int) -> None:
        """Print that all boards are ready, or that one is back; runs in the process of a board."""
        if not self._arrivals.is_last() or not self._reports:
            return
        if self._starts[at] > 1:
            say(f"board {at} listens again at {self._endpoints[at]}")
        elif len(self._endpoints) == 1:
            say(f"board 0 listens at {self._endpoints[0]}")
        else:
            say(f"{len(self._endpoints)} boards listen at {self._endpoints[0]} ... {self._endpoints[-1]}")

    def _ended(self, at: int, code: int) -> None:
        now = time.monotonic()
        self._ends = [each for each in self._ends if now - each <= RESTARTS_WITHIN] + [now]
        if len(self._ends) > self._restarts:
            often = (
                f", {len(self._ends)} exits of boards within {RESTARTS_WITHIN:.0f} s"
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
            remove_stale_sockets(self._run_directory)

    def _remove_sockets(self, endpoint: Endpoint) -> None:
        # a killed board leaves its socket files behind
        for each in (endpoint, endpoint.programming):
            with contextlib.suppress(OSError):
                Path(each.path).unlink()
