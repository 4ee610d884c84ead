"""How every command starts and ends: signals, one sentence for an error, the exit code."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import os
import signal
import sys
import traceback
from typing import TYPE_CHECKING, Any, NoReturn, ParamSpec

import typer
import uvloop

from services.errors import ReportedError
from services.supervision.parent import PARENT_VARIABLE, leave_private_directory
from terminal.command_line import UNWRITABLE, CommandLine, drop_output, output_unwritable
from terminal.errors import ExitCode, StoppedError, exit_code_of
from terminal.logs import log_by_lines, say, say_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

Parameters = ParamSpec("Parameters")

_SIGNALS = {
    signal.SIGINT: (ExitCode.INTERRUPTED, "interrupted (Ctrl-C)"),
    signal.SIGTERM: (ExitCode.TERMINATED, "asked to end (SIGTERM)"),
    signal.SIGHUP: (ExitCode.HANGUP, "the terminal was closed (SIGHUP)"),
}

_TOO_MANY = frozenset({errno.EMFILE, errno.ENFILE})

_MOMENT = 0.002
"""Seconds until a signal's exception that was dropped is raised again."""


def make_app(help_text: str) -> CommandLine:
    """A command's typer application."""
    return CommandLine(help=help_text)


def ends_well(command: Callable[Parameters, int | None]) -> Callable[Parameters, None]:
    """Wrap a command so that errors become one sentence and an exit code.

    Only an exception that is none of ours (a bug) shows a traceback; it exits 1.
    """

    @functools.wraps(command)
    def run(*args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        _open_standard_streams()
        log_by_lines()
        try:
            code = _outcome(functools.partial(command, *args, **kwargs))
        except StoppedError as stopped:  # a signal came while another end was being told
            code = stopped.exit_code
        raise typer.Exit(code)

    return run


def _open_standard_streams() -> None:
    """Put /dev/null where a standard stream was closed (`>&-`): an event loop would take its number."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def _outcome(command: Callable[[], int | None]) -> int:
    """Run a command, tell its failure, and give its exit code; from then on signals are ignored."""
    try:
        code = int(command() or ExitCode.DONE)
        sys.stdout.flush()  # at its own end Python could only complain
    except KeyboardInterrupt:
        code = ExitCode.INTERRUPTED
        say("interrupted (Ctrl-C)")
    except BrokenPipeError:
        # whoever read our output has what it wanted (as `| head` does)
        code = ExitCode.DONE
        drop_output()
    except StoppedError as stopped:
        code = stopped.exit_code
        if PARENT_VARIABLE not in os.environ:
            # a child ends because its parent says so, which is no news
            say(str(stopped))
    except Exception as error:
        code = exit_code_of(error)
        # where the operating system has no more of something, it is no bug of ours
        if isinstance(error, OSError) and error.errno in UNWRITABLE:
            code = ExitCode.USAGE
            say(f"error: {output_unwritable(error)}")
            drop_output()
        elif isinstance(error, OSError) and error.errno in _TOO_MANY:
            code = ExitCode.USAGE
            say(
                f"error: this process can't open what it needs: {error.strerror}; allow more (ulimit -n), or end what holds them"
            )
        elif code == ExitCode.BUG and not isinstance(error, ReportedError):
            say_lines(traceback.format_exc().rstrip())
            say("error: this is a bug in rosbayes; please report it with the lines above")
        else:
            say(f"error: {error}")
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    leave_private_directory()  # also where it ended before it had anything open
    return code


def run_async(main: Coroutine[Any, Any, int | None]) -> int:
    """Run a service's coroutine on uvloop until it ends or a signal asks it to.

    A signal cancels the coroutine, which then has its `finally` clauses to clean up.

    Returns:
        The coroutine's exit code.

    Raises:
        StoppedError: a signal ended it.
    """

    async def guarded() -> int:
        task = asyncio.ensure_future(main)
        stopped: list[signal.Signals] = []

        def stop(number: signal.Signals) -> None:
            if not stopped:
                stopped.append(number)
                task.cancel()

        loop = asyncio.get_running_loop()
        for number in _SIGNALS:
            loop.add_signal_handler(number, stop, number)
        try:
            code = await task
        except asyncio.CancelledError:
            if not stopped:
                raise
        else:
            if not stopped:
                return int(code or 0)
        raise stopped_by(stopped[0])

    with contextlib.closing(main), asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(guarded())


def stopped_by(number: int) -> StoppedError:
    """The end that a signal asks for, as an error with its exit code and its words."""
    return StoppedError(*_SIGNALS[signal.Signals(number)])


def _pass_over(_number: int, _frame: object) -> None:
    """Ignore a signal; with SIG_IGN, Python would print a traceback for one that had arrived but was not handled yet."""


def raise_on_signals() -> None:
    """For a process with one blocking thread: a signal raises StoppedError where the thread stands.

    A second signal while the first is being handled is ignored: cleaning up is bounded anyway. Where the thread
    stands in a function that C code calls back, or in a finaliser, Python drops what is raised; so it is raised again,
    until it reaches code that can end.
    """

    def stop(number: int, _frame: object) -> NoReturn:
        for each in _SIGNALS:
            signal.signal(each, _pass_over)
        raise stopped_by(number)

    for number in _SIGNALS:
        signal.signal(number, stop)
    sys.unraisablehook = _raise_again


def _raise_again(dropped: sys.UnraisableHookArgs) -> None:
    """Python's hook for an exception that it had to drop: a signal's is raised again a moment later."""
    stopped = dropped.exc_value
    if not isinstance(stopped, StoppedError):
        sys.__unraisablehook__(dropped)
        return

    def stop(_number: int, _frame: object) -> NoReturn:
        raise stopped

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, _MOMENT)
