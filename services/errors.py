"""Errors of the services, each with the exit code of its command."""

from __future__ import annotations

from terminal.errors import ExitCode


class StackError(Exception):
    """Root of the services' errors; its text is one sentence for the user.

    Attributes:
        exit_code: what the command exits with when this error ends it.
    """

    exit_code: int = ExitCode.USAGE


class SettingsError(StackError):
    """A flag, an environment variable or a value in the configuration is wrong."""


class InputLineError(StackError):
    """A line on standard input is not what the command reads."""


class LocalSocketError(StackError):
    """A local socket can't be made, or what came over it is no message of ours."""

    exit_code = ExitCode.CHILD


class OtherPeerError(StackError):
    """The process at the other end of a local socket is not the one that belongs there."""


class NoDataError(StackError):
    """No reading came within the time that the first one may take."""

    exit_code = ExitCode.ROSBRIDGE


class RosbridgeLostError(StackError):
    """The rosbridge server went away in a run that does not wait for it."""

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
    """With `queue = all`, frames came in faster than they could be computed."""

    exit_code = ExitCode.CHILD


class NotPreparedError(StackError):
    """A service was asked to switch to a deployment that it does not have, or could not have."""


class ShapeError(StackError):
    """A deployment can't take the place of the one in force: boards or topics were made for another."""


class NotReloadedError(StackError):
    """A reload that could not be finished now; the run goes on with the deployment that it had."""

    exit_code = ExitCode.CHILD


class ControlError(StackError):
    """What came over a control socket is no order, or the answer is none."""


class OutdatedError(StackError):
    """A master asks for what a service's folder holds by now, and the service has what was there before."""

    exit_code = ExitCode.CHILD


class ReportedError(StackError):
    """A failure that another process put into words; it keeps that process's exit code."""

    def __init__(self, exit_code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code
