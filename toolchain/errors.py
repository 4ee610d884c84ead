"""Errors of the toolchain. The text of each error is one sentence for the user."""

from pathlib import Path
from typing import ClassVar


class ToolchainError(Exception):
    """Base class of the toolchain's errors. The text of an error is one sentence that tells the user what to do."""

    exit_code: ClassVar[int] = 2

    def __init__(
        self,
        sentence: str,
        *,
        path: Path | str = "",
        line: int | None = None,
        place: tuple[str | int, ...] = (),
    ) -> None:
        """Prefix the sentence with path and line. `place` locates a wrong value, such as `("variable", 2, "bits")`."""
        where = f"{path}" + ("" if line is None else f", line {line}")
        super().__init__(f"{where}: {sentence}" if where else sentence)
        self.path = path
        self.line = line
        self.place = place


class ModelError(ToolchainError):
    """A machine cannot compute a model, because its shapes, names, probabilities or parameters are wrong."""


class NotFusionError(ModelError):
    """A BM1 cannot answer a question, because two known symbols are not independent given the searched symbols."""

    def __init__(self, why: str, advice: str) -> None:
        """Join `why` and `advice` into one sentence. `why` names the two symbols and the path between them."""
        super().__init__(f"{why}; {advice}")
        self.why = why


class NetworkFileError(ModelError):
    """A network file is missing, damaged or too large, or is not a network. The error names the file and the line."""


class MifError(ToolchainError):
    """A memory file is not a MIF, or its words do not fit the memory. The error names the file and the line."""


class BuildError(ToolchainError):
    """A build is impossible: options contradict each other, or a folder cannot be written."""


class DeploymentError(ToolchainError):
    """A deployment is missing, unreadable, or inconsistent."""


class DeploymentVersionError(DeploymentError):
    """A deployment has a format that this version does not support."""


class DamagedDeploymentError(DeploymentError):
    """A file of the deployment has changed since the build: the hash of the file differs from the recorded hash."""


class ReadingError(ToolchainError):
    """A reading cannot be converted to an address of its sensor column."""

    exit_code: ClassVar[int] = 4


class NotANumberError(ReadingError):
    """A reading is a string, an object or a non-empty array instead of a number."""


class ValueOutOfRangeError(ReadingError):
    """A reading is outside the range of its variable, and the variable has `on_range = error`."""


class ReadingMissingError(ReadingError):
    """A reading is missing, and its variable has `on_missing = error`."""


def counted(number: int, noun: str) -> str:
    """Return a number and its noun for a sentence: `1 bit`, `2 bits`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
