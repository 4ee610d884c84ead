"""Errors of this package. The text of each error is one sentence for the user."""

from typing import ClassVar


class MachineError(Exception):
    """Base class of this package's errors."""

    exit_code: ClassVar[int] = 2


class ParameterError(MachineError):
    """Raised for parameters, tables or codes from which no machine can be built."""


class StartError(MachineError):
    """Raised for a start or a resume that does not fit the machine or its state."""


class NoPosteriorError(MachineError):
    """Raised if all counts are 0 for the readings, so that the counts cannot be normalised."""

    exit_code: ClassVar[int] = 4
