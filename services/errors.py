"""Errors of the services, each with the exit code of its command."""

from terminal.errors import ExitCode


class StackError(Exception):
    """Base class of the services' errors; the text is one sentence for the user."""

    exit_code: int = ExitCode.USAGE
    """Exit code of a command that ends with this error."""


class SettingsError(StackError):
    """A flag, an environment variable or a value in the configuration is wrong."""


class InputLineError(StackError):
    """A line on standard input is malformed."""


class LocalSocketError(StackError):
    """A local socket cannot be created, or bytes from it are not a record."""

    exit_code = ExitCode.CHILD


class OtherPeerError(StackError):
    """The process at the other end of a local socket has another role, version or deployment."""


class NoDataError(StackError):
    """The first reading did not arrive in time after the start of the run."""

    exit_code = ExitCode.ROSBRIDGE


class RosbridgeLostError(StackError):
    """The rosbridge server was lost in a run with `--once`."""

    exit_code = ExitCode.ROSBRIDGE


class VariableError(StackError):
    """A variable is missing in a message, or its value is unusable."""

    exit_code = ExitCode.VARIABLE


class BoardFailedError(StackError):
    """A board failed, or failed too often."""

    exit_code = ExitCode.BOARD


class ChildDiedError(StackError):
    """A process that the master started exited unexpectedly, or too often."""

    exit_code = ExitCode.CHILD


class OverflowedQueueError(StackError):
    """With `queue = all`, readings arrived faster than the boards compute frames."""

    exit_code = ExitCode.CHILD


class OutdatedError(StackError):
    """A service's deployment folder has changed since its start, and the master requires the new deployment."""

    exit_code = ExitCode.CHILD


class ReportedError(StackError):
    """A failure in another process, with the sentence and the exit code of that process."""

    def __init__(self, exit_code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code
