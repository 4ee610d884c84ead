"""Emulated boards as processes: one alone, or a mini-cluster forked from one that has loaded the kernels."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from pcie_shim.board.emulated_board import EmulatedBoard
from pcie_shim.board.misbehaviour import Misbehaviour
from pcie_shim.board.server import StopSignal, serve_board
from pcie_shim.endpoint import Endpoint
from services.commands import flags as options
from services.errors import BoardFailedError, SettingsError
from services.settings import endpoint_in, load_settings
from services.sockets.serving import endpoint_from
from services.sockets.status import BoardStatus, ProcessStatus, status_thread
from services.supervision.child import RESTARTS, RESTARTS_WITHIN, how_it_ended
from services.supervision.parent import end_with_parent, leave_private_directory
from services.supervision.private_directory import remove_stale_sockets
from terminal.command_line import CommandLine
from terminal.ending import PARENT_VARIABLE
from terminal.errors import StoppedError, exit_code_of
from terminal.output import say
from terminal.signals import check_signals, stopped_by


def serve_one(
    endpoint: Endpoint,
    index: int,
    misbehave: Misbehaviour | None,
    directory: Path | None,
    *,
    restarts: int = 0,
    on_ready: Callable[[], None],
) -> int:
    """Serve one board in this process until a signal; gives the signal's number.

    Args:
        endpoint: where its registers are.
        index: the board's number.
        misbehave: what it does wrong, for tests.
        directory: where its status socket goes, if anywhere.
        restarts: how often it was started again before.
        on_ready: is called once both its sockets listen.
    """
    stop = StopSignal()
    ended_by: list[int] = []

    def end(number: int, _frame: object) -> None:
        ended_by.append(number)
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    listening: list[EmulatedBoard] = []

    def tell() -> ProcessStatus:
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

    with status_thread(directory, f"board{index}", tell):
        serve_board(endpoint, index=index, stop=stop, misbehave=misbehave, on_ready=ready)
    return ended_by[0] if ended_by else 0


def _say_if_alone(sentence: str) -> None:
    """Say what a person who started the boards wants to know; a master has its own ways to find out."""
    if PARENT_VARIABLE not in os.environ:
        say(sentence)


class _Arrivals:
    """Finds the last of several processes to arrive: all take from a pipe, and only the last finds it empty."""

    def __init__(self, count: int) -> None:
        self._left, write = os.pipe()
        os.set_blocking(self._left, False)
        os.write(write, bytes(count - 1))
        self._kept_open = write  # else an empty pipe would be an ended one

    def is_last(self) -> bool:
        """Arrive; True in the last process, and in any that arrives again after it."""
        try:
            os.read(self._left, 1)
        except BlockingIOError:
            return True
        return False


def _check_free(endpoint: Endpoint) -> None:
    """Refuse a place where others' boards are: from here on, what lies there counts as our own."""
    for each in (endpoint, endpoint.programming):
        with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
            probe.settimeout(1)
            probe.connect(each.path)
            msg = f"another process listens at {each}; end it, or give --directory another folder"
            raise SettingsError(msg)


class BoardProcesses:
    """Boards 0 to n-1, each a process forked from this one."""

    def __init__(self, directory: Path, count: int, restarts: int, run_directory: Path | None) -> None:
        self._endpoints = [endpoint_in(directory, f"board{at}") for at in range(count)]
        self._restarts = restarts
        self._run_directory = run_directory
        self._told = PARENT_VARIABLE not in os.environ
        self._arrivals = _Arrivals(count)
        self._started: dict[int, int] = {}
        self._starts = [0] * count
        self._ends: list[float] = []

    def run(self) -> NoReturn:
        """Keep the boards running until a signal raises here.

        Raises:
            BoardFailedError: a board ended and may not be restarted any more.
        """
        from machines.kernel import warm_up

        # the children share these pages: four imports of numba would take 1.6 s
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
            end_with_parent()
            ended_by = serve_one(
                self._endpoints[at],
                at,
                None,
                self._run_directory,
                restarts=self._starts[at] - 1,
                on_ready=lambda: self._ready(at),
            )
            code = 128 + ended_by if ended_by else 0
        except StoppedError as stopped:
            code = stopped.exit_code
        except BaseException as error:  # the fork must never run on in its parent's code
            code = exit_code_of(error)
            say(f"error: board {at}: {error}")
        finally:
            with contextlib.suppress(Exception):
                sys.stderr.flush()
            os._exit(code)

    def _ready(self, at: int) -> None:
        """In a board's own process: say when all are there, and when one is back."""
        if not self._arrivals.is_last() or not self._told:
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
                f", {len(self._ends)} ends of boards within {RESTARTS_WITHIN:.0f} s" if self._restarts else ""
            )
            msg = f"board {at} {how_it_ended(code)}{often}"
            raise BoardFailedError(msg)
        say(f"board {at} {how_it_ended(code)}; restarting it")
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
                os.waitpid(pid, 0)  # while it is not gone, its sockets answer
        for at in range(len(self._endpoints)):
            self._forget(self._endpoints[at])
        if self._run_directory is not None:
            remove_stale_sockets(self._run_directory)

    def _forget(self, endpoint: Endpoint) -> None:
        # a board that was killed could not take its sockets away
        for each in (endpoint, endpoint.programming):
            with contextlib.suppress(OSError):
                Path(each.path).unlink()


app = CommandLine(
    help="Emulate boards of the mini-cluster. They start blank; pcie-app or the loader programs them.\n\n"
    "`board --listen unix:/tmp/b/board0.sock` is one board; `board --boards 4 --directory /tmp/b` is four, "
    "each a process of its own."
)


@app.command(help=app.info.help)
def board(
    listen: options.Listen = None,
    index: Annotated[int, typer.Option(min=0, help="The board's number, for its messages.")] = 0,
    boards: Annotated[int | None, typer.Option(min=1, max=64, help="Start this many boards.")] = None,
    directory: Annotated[
        Path | None, typer.Option(help="Where their sockets go: board0.sock, board1.sock, ...")
    ] = None,
    restarts: Annotated[
        int, typer.Option(min=0, help="Restarts of boards within 60 s before it gives up.")
    ] = RESTARTS,
    misbehave: Annotated[
        str, typer.Option(help="For tests: one of the misbehaviours listed in docs/reference/boards.md.")
    ] = "",
) -> int:
    """Emulate boards of the mini-cluster."""
    end_with_parent()
    run_directory = load_settings().run_directory
    if (listen is None) == (boards is None):
        msg = "give either --listen ENDPOINT for one board, or --boards N --directory DIR for several"
        raise SettingsError(msg)
    if boards is not None:
        if misbehave:
            msg = "--misbehave belongs to a single board: start it with --listen ENDPOINT"
            raise SettingsError(msg)
        if directory is None:
            msg = "--boards needs --directory DIR, a folder for the boards' sockets"
            raise SettingsError(msg)
        if not directory.is_dir():
            msg = f"--directory {directory} is no folder; name one for the boards' sockets"
            raise SettingsError(msg)
        BoardProcesses(directory, boards, restarts, run_directory).run()
    wrong = Misbehaviour.parse(misbehave) if misbehave else None
    from machines.kernel import warm_up

    warm_up()
    check_signals()
    endpoint = endpoint_from(listen or "", "--listen")
    ended_by = serve_one(
        endpoint,
        index,
        wrong,
        run_directory,
        on_ready=lambda: _say_if_alone(f"board {index} listens at {endpoint}"),
    )
    if ended_by:
        raise stopped_by(ended_by)
    return 0


def main() -> None:
    """Entry point of the command `board`."""
    try:
        app()
    except SystemExit as end:
        # nothing is open any more; to take the compiled kernels down in order would take half a second
        leave_private_directory()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(end.code if isinstance(end.code, int) else int(end.code is not None))
