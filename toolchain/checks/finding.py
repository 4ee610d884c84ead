"""Findings of a check, and the whole machine that is checked."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters
from toolchain.deployment import Deployment, Variable
from toolchain.models.model import Model


class Severity(StrEnum):
    """The severity of a finding."""

    ERROR = "error"
    """The model cannot be built, or computes wrong results."""
    WARNING = "warning"
    """Some readings get no posterior or a wrong one, or resources are wasted."""
    NOTE = "note"
    """This may be intended."""


class Check(StrEnum):
    """The checks, as `toolchain check --json` names them; docs/reference/toolchain.md describes each."""

    CANNOT_BE_BUILT = "cannot-be-built"
    DEAD_LINES = "dead-lines"
    DEAD_BOARD = "dead-board"
    IMPOSSIBLE_READINGS = "impossible-readings"
    COLUMN_WITHOUT_EFFECT = "column-without-effect"
    SAME_READING = "same-reading"
    ADDRESS_BITS = "address-bits"
    RANGE = "range"
    PAIRING = "pairing"
    STOPPING = "stopping"
    VANISHED_FLOOR = "vanished-floor"
    LOST_MASS = "lost-mass"
    FILES = "files"
    RNG = "rng"
    RNG_BANKS = "rng-banks"
    RNG_STEPS = "rng-steps"
    RNG_PERIOD = "rng-period"
    RNG_RELATION = "rng-relation"
    RNG_TABLE = "rng-table"


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding of a check; `advice` suggests a change, and is empty if none is needed."""

    severity: Severity
    check: Check
    about: str
    what: str
    advice: str = ""

    @property
    def sentence(self) -> str:
        """The finding as one line for a user."""
        return f"{self.severity}: {self.about}: {self.what}{f'; {self.advice}' if self.advice else ''}"

    def as_dict(self) -> dict[str, str]:
        """Return the fields by name, for JSON."""
        return {key: str(value) for key, value in asdict(self).items()}


error: Final = partial(Finding, Severity.ERROR)
warning: Final = partial(Finding, Severity.WARNING)
note: Final = partial(Finding, Severity.NOTE)


@dataclass(frozen=True, slots=True, eq=False)
class CheckedMachine:
    """A whole machine to check, regardless of its partition.

    Attributes:
        deployment: Its variables, lines and limits.
        board: The machine of the first board: parameters and random numbers are the same on all boards.
        prior: uint16[rows, lines], over all boards.
        tables: One uint16[2**bits, lines] per column, over all boards.
        model: The probabilities, if known.
    """

    deployment: Deployment
    board: BM1Machine
    prior: NDArray[np.uint16]
    tables: tuple[NDArray[np.uint16], ...]
    model: Model | None

    @property
    def parameters(self) -> BM1Parameters:
        """The parameters of the first board; only the lines differ between boards."""
        return self.board.parameters

    @property
    def names(self) -> list[str]:
        """The columns' names, the prior first."""
        return ["the prior", *(variable.name for variable in self.deployment.sensors)]

    def addressable_rows(self, column: int) -> NDArray[np.uint16]:
        """Return the rows of a column (from 0) that readings can address, including permitted missing ones."""
        return _addressable(self.deployment.sensors[column], self.tables[column])

    def prior_rows(self) -> NDArray[np.uint16]:
        """Return the rows of the prior that can be selected."""
        select = self.deployment.prior_select
        return self.prior if select is None else _addressable(select, self.prior)


def _addressable(variable: Variable, rows: NDArray[np.uint16]) -> NDArray[np.uint16]:
    served = rows[: variable.values]
    return np.vstack([served, rows[-1:]]) if variable.on_missing == "missing" else served
