"""Errors of the services, each with the exit code of its command."""

from terminal.errors import ExitCode


class StackError(Exception):
    """Base class of the services' errors. The text of an error is one sentence for the user."""

    exit_code: int = ExitCode.USAGE
    """Exit code of a command that ends with this error."""


class SettingsError(StackError):
    """A flag, an environment variable or a value in the configuration is wrong."""


class InputLineError(StackError):
    """A line on standard input is malformed."""


class LocalSocketError(StackError):
    """A local socket cannot be created, or received bytes are not a record."""

    exit_code = ExitCode.CHILD


class OtherPeerError(StackError):
    """The process at the other end of a local socket has an unexpected role, version or deployment."""


class NoDataError(StackError):
    """The first reading of the run did not arrive within the time limit."""

    exit_code = ExitCode.ROSBRIDGE


class RosbridgeLostError(StackError):
    """The rosbridge server was lost in a run with `--once`."""

    exit_code = ExitCode.ROSBRIDGE


class VariableError(StackError):
    """A variable is missing in a message, or its value is unusable."""

    exit_code = ExitCode.VARIABLE


class BoardFailedError(StackError):
    """A board failed for good, or frames failed on boards too often for the run to go on."""

    exit_code = ExitCode.BOARD


class ChildDiedError(StackError):
    """A process of the run exited unexpectedly or too often, or did not answer in time."""

    exit_code = ExitCode.CHILD


class OverflowedQueueError(StackError):
    """With `queue = all`, readings arrived faster than the boards compute frames."""

    exit_code = ExitCode.CHILD


class OutdatedError(StackError):
    """A service still uses an old version of its deployment folder, and the master requires the new version."""

    exit_code = ExitCode.CHILD


class ReportedError(StackError):
    """A failure that another process has reported, with the reported sentence and exit code."""

    def __init__(self, exit_code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code
