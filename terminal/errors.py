"""Exit codes of commands and of errors."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every command (see docs/reference/commands.md)."""

    DONE = 0
    BUG = 1
    USAGE = 2
    ROSBRIDGE = 3
    VARIABLE = 4
    BOARD = 5
    CHILD = 6
    HANGUP = 129
    INTERRUPTED = 130
    TERMINATED = 143


class StoppedError(BaseException):
    """A signal asked the process to end.

    Like KeyboardInterrupt, this class is not derived from `Exception`. The error can be raised anywhere in the main
    thread, even inside a library. Code that catches `Exception` must not swallow it.
    """

    def __init__(self, exit_code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code


class ReaderGoneError(Exception):
    """The reader of standard output, for example `head` in a pipe, has closed the pipe. This is no failure."""

    exit_code = ExitCode.DONE


class ProcessError(Exception):
    """A process that a command or a script started has failed.

    `exit_code` is the exit code of the failed process if the code is known and positive, otherwise `ExitCode.CHILD`.
    """

    exit_code: int = ExitCode.CHILD


class OutputError(Exception):
    """A command cannot write a file or folder that the user has asked for."""

    exit_code = ExitCode.USAGE


def exit_code_of(error: BaseException) -> int:
    """Return the exit code of an error, or `ExitCode.BUG` if the error has none."""
    code = getattr(error, "exit_code", ExitCode.BUG)
    return int(code) if isinstance(code, int) else int(ExitCode.BUG)
