"""What the toolchain refuses, each as one sentence for the user."""

from typing import ClassVar


class ToolchainError(Exception):
    """Root of the toolchain's errors; `str()` is one sentence that says what to do."""

    exit_code: ClassVar[int] = 2


class ModelError(ToolchainError):
    """A model that is not a BM1's: wrong shapes, names, probabilities or parameters."""


class NetworkFileError(ModelError):
    """A network's file that can't be read: damaged, hostile, or of another kind; says the file and the line."""


class MifError(ToolchainError):
    """A memory's file that can't be read: no MIF, or words that don't fit; says the file and the line."""


class BuildError(ToolchainError):
    """A build that cannot be done: options that don't fit, or a folder that can't be written."""


class DeploymentError(ToolchainError):
    """A deployment that is not there, not readable, or not consistent."""


class DeploymentVersionError(DeploymentError):
    """A deployment in a format that this version doesn't read."""


class DamagedDeploymentError(DeploymentError):
    """A file of the deployment is not the one that was built: its hash differs."""


class ReadingError(ToolchainError):
    """A reading that cannot become an address of its column."""

    exit_code: ClassVar[int] = 4


class NotANumberError(ReadingError):
    """A reading that is no number: a string, an object, a non-empty array."""


class ValueOutOfRangeError(ReadingError):
    """A number whose address the column does not serve (`on_range = error`)."""


class ReadingMissingError(ReadingError):
    """No reading where there must be one (`on_missing = error`)."""
