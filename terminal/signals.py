"""Signals that end a process. They raise an exception in blocking code, and cancel a coroutine."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import Coroutine
from types import TracebackType
from typing import Any, Final

import uvloop

from terminal.errors import ExitCode, StoppedError

_ENDS = {
    signal.SIGINT: (ExitCode.INTERRUPTED, "interrupted (Ctrl-C)"),
    signal.SIGTERM: (ExitCode.TERMINATED, "terminated (SIGTERM)"),
    signal.SIGHUP: (ExitCode.HANGUP, "the terminal was closed (SIGHUP)"),
}

ENDING_SIGNALS: Final = frozenset(_ENDS)
"""The signals that end a process."""

_received: list[int] = []


def stopped_error(number: int) -> StoppedError:
    """Return the error, with exit code and sentence, for a signal that ends a process."""
    return StoppedError(*_ENDS[signal.Signals(number)])


def raise_on_signals() -> None:
    """Make SIGINT, SIGTERM and SIGHUP raise `StoppedError` in the main thread.

    A second signal is ignored, because the clean-up after the first signal always ends within a limited time.

    Code must call `check_signals` before it blocks, as `run_async` does, because the exception can be lost. Python
    drops the exception while the thread runs a callback from C code, forks, or runs a finaliser. C code may print the
    exception and raise another exception, as numba does while it is imported.
    """
    sys.unraisablehook = _report_dropped
    sys.excepthook = _report_printed
    for number in _ENDS:
        signal.signal(number, _stop)


def _stop(number: int, _frame: object) -> None:
    _received.append(number)
    if len(_received) == 1:
        raise stopped_error(number)


def _report_dropped(dropped: sys.UnraisableHookArgs) -> None:
    """Report an exception that Python drops, but not a `StoppedError`, which `check_signals` raises again."""
    if not isinstance(dropped.exc_value, StoppedError):
        sys.__unraisablehook__(dropped)


def _report_printed(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    """Print an exception that ends the program; exceptions of signals are left to `terminal.ending`."""
    if not isinstance(error, StoppedError):
        sys.__excepthook__(kind, error, traceback)


def received_stop() -> StoppedError | None:
    """Return the error for the first signal that interrupted blocking code, or None if no signal did."""
    return stopped_error(_received[0]) if _received else None


def check_signals() -> None:
    """Raise a StoppedError if a signal has arrived.

    Call this before blocking, because the exception that the signal raised may have been lost.
    """
    if stop := received_stop():
        raise stop


def ignore_signals() -> None:
    """Ignore the signals that end a process. Call this once the process has finished its work."""
    for number in _ENDS:
        signal.signal(number, signal.SIG_IGN)


async def until_one_ends(*work: Coroutine[Any, Any, object]) -> None:
    """Run coroutines until the first coroutine ends, and cancel the remaining coroutines.

    If the coroutine that ended first has raised an error, this function raises the error.
    """
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in ended:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def run_async(main: Coroutine[Any, Any, int | None]) -> int:
    """Run a coroutine on uvloop, and return the coroutine's exit code.

    If a signal arrives, the coroutine is cancelled and a StoppedError is raised. The coroutine's `finally` clauses
    always run before this function ends.
    """

    async def guarded() -> int:
        received: list[signal.Signals] = []

        def stop(number: signal.Signals) -> None:
            if not received:
                received.append(number)
                task.cancel()

        loop = asyncio.get_running_loop()
        for number in _ENDS:
            loop.add_signal_handler(number, stop, number)
        # the exception of an earlier signal may have been lost, for example during an import
        check_signals()
        task = asyncio.ensure_future(main)
        try:
            code = await task
        except asyncio.CancelledError:
            if not received:
                raise
        else:
            if not received:
                return int(code or 0)
        raise stopped_error(received[0])

    handlers = {number: signal.getsignal(number) for number in _ENDS}
    try:
        with contextlib.closing(main), asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            return runner.run(guarded())
    finally:  # closing the loop has restored the default handlers
        for number, handler in handlers.items():
            signal.signal(number, handler)
