"""Errors of received posteriors. They are `BridgeError`s with an exit code, like all errors of a connection."""

from bridge.errors import BridgeError, NoMessageError


class PosteriorError(BridgeError):
    """Base class of the errors of `posteriors`."""

    exit_code = 2


class NoResultError(PosteriorError, NoMessageError):
    """Raised when no posterior arrived in time."""

    exit_code = NoMessageError.exit_code


class BadResultError(PosteriorError):
    """Raised when a message on a result topic does not have the form of a master's messages."""


class LabelError(PosteriorError):
    """Raised when a label, cell or unit does not fit a posterior. The message says what the posterior has."""
