"""One way to start and end a case study's process: event loop, signals, exit codes, errors in a sentence."""

import asyncio
import logging
import signal
import sys
from collections.abc import Callable, Coroutine
from types import FrameType
from typing import Any, NoReturn

import typer
import uvloop

from bridge.errors import BridgeError
from casestudies.errors import CaseStudyError
from terminal.command_line import CommandLine

_ENDING_SIGNALS = {
    signal.SIGINT: "interrupted (Ctrl-C)",
    signal.SIGTERM: "asked to end (SIGTERM)",
    signal.SIGHUP: "the terminal was closed (SIGHUP)",
}


def say(sentence: str) -> None:
    """One line for the person at the terminal; results alone go to stdout."""
    print(sentence, file=sys.stderr, flush=True)


def command(app: CommandLine) -> None:
    """Run a command line as a process of its own: what `main()` of each case study's module does.

    SIGINT ends it with 130, SIGTERM with 143 and a closed terminal with 129, whatever it is doing.
    """
    _end_at_signals()
    try:
        app()
    except BrokenPipeError:  # whoever read our lines has gone: nothing is wrong here
        sys.stderr.close()
        raise SystemExit(128 + signal.SIGPIPE) from None


def fail(error: BridgeError | CaseStudyError) -> NoReturn:
    """One sentence on stderr, and the error's own exit code."""
    say(f"error: {error}")
    raise typer.Exit(error.exit_code) from None


def run(body: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine on uvloop until it ends or a signal ends it.

    Args:
        body: makes the coroutine. On SIGINT or SIGTERM it is cancelled, so that its `finally` blocks close
            what they opened.

    Raises:
        typer.Exit: with 128 and the signal's number, or the error's own exit code after one sentence
            on stderr.
    """
    # what the client warns of, `connection.told` says in words; only its errors are news
    logging.basicConfig(level=logging.ERROR, stream=sys.stderr, format="%(name)s: %(message)s")
    try:
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            received = runner.run(_until_signal(body))
    except (BridgeError, CaseStudyError) as error:
        fail(error)
    finally:
        _end_at_signals()  # closing the loop has put the system's own handlers back
    if received is not None:
        say(_ENDING_SIGNALS[received])
        raise typer.Exit(128 + received)


async def _until_signal(body: Callable[[], Coroutine[Any, Any, None]]) -> signal.Signals | None:
    """The signal that ended the coroutine, or None when it ended by itself."""
    loop = asyncio.get_running_loop()
    task = asyncio.ensure_future(body())
    received: signal.Signals | None = None

    def end(number: signal.Signals) -> None:
        nonlocal received
        received = number
        task.cancel()

    for number in _ENDING_SIGNALS:
        loop.add_signal_handler(number, end, number)
    try:
        await task
    except (Exception, asyncio.CancelledError):
        if received is None:  # otherwise it is what the cancelling tore down
            raise
    return received


def _end_at_signals() -> None:
    for number in _ENDING_SIGNALS:
        signal.signal(number, _exit)


def _exit(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(128 + number)
