"""The end of a command: its error is reported on standard error and becomes an exit code."""

import errno
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Final

import typer

from terminal.errors import ExitCode, ReaderGoneError, StoppedError, exit_code_of
from terminal.logs import PARENT_VARIABLE
from terminal.output import discard_output, say, say_error, say_lines
from terminal.signals import check_signals, ignore_signals, received_stop

_NO_SPACE: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
_TOO_MANY_FILES: Final = frozenset({errno.EMFILE, errno.ENFILE})


def outcome(command: Callable[[], object]) -> int:
    """Run a command, report its failure on standard error, and return its exit code.

    An unexpected exception is a bug, and its report contains a traceback. After the command, the process ignores
    signals.
    """
    try:
        try:
            code = command()
            check_signals()
            sys.stdout.flush()  # a failure at exit could no longer be reported
            result = int(code) if isinstance(code, int) else ExitCode.DONE
        finally:
            ignore_signals()
    except BaseException as error:
        ignore_signals()  # again, because the first signal may have interrupted the call above
        return report(error)
    return result


def report(error: BaseException) -> int:
    """Report, on standard error, the exception that ended a command. Return the exit code of the command."""
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else ExitCode.DONE
    if isinstance(error, typer.TyperException):
        context = getattr(error, "ctx", None)
        command = Path(sys.argv[0]).name if context is None else context.command_path
        # some of typer's messages have several lines
        message = " ".join(error.format_message().split()).replace("Value error, ", "").removesuffix(".")
        say_error(f"{message}; {command} --help says more")
        return ExitCode.USAGE
    if isinstance(error, ReaderGoneError | BrokenPipeError):
        discard_output()
        return ExitCode.DONE
    error = _signal_behind(error) or received_stop() or error  # a library may have replaced that of a signal
    if isinstance(error, KeyboardInterrupt):
        error = StoppedError(ExitCode.INTERRUPTED, "interrupted (Ctrl-C)")
    if isinstance(error, StoppedError):
        if PARENT_VARIABLE not in os.environ:
            say(str(error))
        return error.exit_code
    if isinstance(error, OSError) and (sentence := _system_sentence(error)) is not None:
        say_error(sentence)
        return ExitCode.USAGE
    if not hasattr(error, "exit_code"):
        say_lines("".join(traceback.format_exception(error)).rstrip())
        say_error("this is a bug in rosbayes; please report it with the lines above")
        return ExitCode.BUG
    say_error(str(error))
    return exit_code_of(error)


def _signal_behind(error: BaseException) -> StoppedError | None:
    """Return the StoppedError that caused an error, if any: Python 3.11 wraps one that arrives in `__set_name__`."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, StoppedError):
        cause = cause.__cause__
    return cause


def _system_sentence(error: OSError) -> str | None:
    """Return the sentence for an exceeded limit of the system or an unwritable output; None if the error is a bug."""
    if error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if error.errno in _NO_SPACE:
        discard_output()
        return f"the output cannot be written: {error.strerror}; free some space, or redirect it elsewhere"
    if error.errno in _TOO_MANY_FILES:
        return f"this process cannot open another file: {error.strerror}; raise the limit (ulimit -n), or end other programs"
    return None
