"""Errors of the toolchain, each one sentence for the user."""

from pathlib import Path
from typing import ClassVar


class ToolchainError(Exception):
    """Root of the toolchain's errors; `str()` is one sentence that says what to do."""

    exit_code: ClassVar[int] = 2

    def __init__(
        self,
        sentence: str,
        *,
        path: Path | str = "",
        line: int | None = None,
        place: tuple[str | int, ...] = (),
    ) -> None:
        """Put file and line before the sentence; `place` is the key of a configuration file, as `("variable", 2, "bits")`."""
        where = f"{path}" + ("" if line is None else f", line {line}")
        super().__init__(f"{where}: {sentence}" if where else sentence)
        self.path = path
        self.line = line
        self.place = place


class ModelError(ToolchainError):
    """A model is not one that a BM1 computes: wrong shapes, names, probabilities or parameters."""


class NetworkFileError(ModelError):
    """A network's file can't be read: damaged, hostile, or of another kind; names the file and the line."""


class MifError(ToolchainError):
    """A memory's file can't be read: not a MIF, or words that don't fit; names the file and the line."""


class BuildError(ToolchainError):
    """A build cannot be done: options don't fit each other, or a folder can't be written."""


class DeploymentError(ToolchainError):
    """A deployment is absent, not readable, or not consistent."""


class DeploymentVersionError(DeploymentError):
    """A deployment has a format that this version doesn't read."""


class DamagedDeploymentError(DeploymentError):
    """A file of the deployment is not the one that was built: its hash differs."""


class ReadingError(ToolchainError):
    """A reading cannot become an address of its column."""

    exit_code: ClassVar[int] = 4


class NotANumberError(ReadingError):
    """A reading is not a number: a string, an object, a non-empty array."""


class ValueOutOfRangeError(ReadingError):
    """A number's address is not one that the column serves (`on_range = error`)."""


class ReadingMissingError(ReadingError):
    """A reading is missing where it must not be (`on_missing = error`)."""
