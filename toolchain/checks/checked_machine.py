"""A whole machine to check, from a model or from a deployment's boards."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters
from toolchain.deployment import Deployment, Variable
from toolchain.models.model import Model


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
        """Return the rows of a column (from 0) that readings, and permitted missing readings, address."""
        return _addressable(self.deployment.sensors[column], self.tables[column])

    def prior_rows(self) -> NDArray[np.uint16]:
        """Return the rows of the prior that can be selected."""
        select = self.deployment.prior_select
        return self.prior if select is None else _addressable(select, self.prior)


def _addressable(variable: Variable, rows: NDArray[np.uint16]) -> NDArray[np.uint16]:
    served = rows[: variable.values]
    return np.vstack([served, rows[-1:]]) if variable.on_missing == "missing" else served
