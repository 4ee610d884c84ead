"""Errors of the services, each with the exit code of its command."""

from terminal.errors import ExitCode


class StackError(Exception):
    """Root of the services' errors; its text is one sentence for the user."""

    exit_code: int = ExitCode.USAGE
    """Exit code of a command that this error ends."""


class SettingsError(StackError):
    """A flag, an environment variable or a value in the configuration is wrong."""


class InputLineError(StackError):
    """A line on standard input is malformed."""


class LocalSocketError(StackError):
    """A local socket can't be made, or bytes from it are not a record."""

    exit_code = ExitCode.CHILD


class OtherPeerError(StackError):
    """The process at the other end of a local socket has another role, version or deployment."""


class NoDataError(StackError):
    """No reading came within the timeout of the first one."""

    exit_code = ExitCode.ROSBRIDGE


class RosbridgeLostError(StackError):
    """The rosbridge server went away in a run of one frame."""

    exit_code = ExitCode.ROSBRIDGE


class VariableError(StackError):
    """A variable is missing in a message, or its value can't be used."""

    exit_code = ExitCode.VARIABLE


class BoardFailedError(StackError):
    """A board failed, or failed too often."""

    exit_code = ExitCode.BOARD


class ChildDiedError(StackError):
    """A process that the master started ended when it should not have, or too often."""

    exit_code = ExitCode.CHILD


class OverflowedQueueError(StackError):
    """With `queue = all`, frames came faster than the boards compute them."""

    exit_code = ExitCode.CHILD


class NotPreparedError(StackError):
    """A service was asked to switch to a deployment that it has not prepared."""


class ShapeError(StackError):
    """A deployment can't replace the one in force: its boards or topics differ."""


class NotReloadedError(StackError):
    """A reload could not be finished now; the run keeps the deployment that it had."""

    exit_code = ExitCode.CHILD


class ControlError(StackError):
    """A control socket got a malformed order or answer, or is not there."""


class OutdatedError(StackError):
    """A service's folder has changed since its start, and a master asks for the new deployment."""

    exit_code = ExitCode.CHILD


class ReportedError(StackError):
    """A failure in another process, with that process's own sentence and exit code."""

    def __init__(self, exit_code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code
