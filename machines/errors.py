"""What can be wrong with a machine, or with what is asked of one: one sentence each, for the user."""

from typing import ClassVar


class MachineError(Exception):
    """A machine can't be built, or can't do what it is asked to do; `str()` is one sentence for the user."""

    exit_code: ClassVar[int] = 2


class ParameterError(MachineError):
    """Parameters, tables or codes describe no machine that could be built."""


class StartError(MachineError):
    """A start, or a resume, asks for what this machine does not have or can't do now."""


class NoPosteriorError(MachineError):
    """The readings leave every line without a count, so that there is nothing to normalise."""

    exit_code: ClassVar[int] = 4
