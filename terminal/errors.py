"""Exit codes, and how an error gets one."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every command (see docs/commands.md)."""

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
    """A signal asked the process to end; not a failure, but no success either.

    Like KeyboardInterrupt it is no `Exception`: it rises wherever the process stands, inside a library's code too,
    and whoever catches "whatever goes wrong here" must not take it for that.
    """

    def __init__(self, exit_code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code


def exit_code_of(error: BaseException) -> int:
    """The exit code of any package's error; a bug (1) for an exception that is none of ours."""
    code = getattr(error, "exit_code", ExitCode.BUG)
    return int(code) if isinstance(code, int) else int(ExitCode.BUG)
