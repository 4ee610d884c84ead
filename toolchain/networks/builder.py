"""A builder of joint distributions, which checks what the readers of network files pass to it."""

import math
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import ModelError, NetworkFileError
from toolchain.models.distribution import Factor, IntegerType, LabelType, Symbol, potential, table
from toolchain.models.joint import JointDistribution
from toolchain.models.model import MAX_ENTRIES

MAX_VARIABLES: Final = 20_000
MAX_STATES: Final = 65_535
"""Maximum number of states of a variable, because a column of a machine can have at most 2^16 - 1 values."""
MAX_PARENTS: Final = 30
"""Maximum number of parents, well below NumPy's limit of 64 axes. `MAX_ENTRIES` also limits the size of a table."""
MAX_TOTAL: Final = 2 * MAX_ENTRIES
"""Maximum number of entries of all tables together."""
MAX_NAME: Final = 200

ROUNDING: Final = 0.02
"""Maximum difference between the sum of a distribution and 1, because networks are published with rounded numbers."""


class Place(Protocol):
    """A reader's current position in its file, for error messages."""

    def error(self, sentence: str) -> NetworkFileError:
        """Return an error whose message contains the file, the line and `sentence`."""


class NetworkBuilder:
    """A builder of a joint distribution from the parts of a network file.

    The methods raise a NetworkFileError if a part is wrong or too large.
    """

    def __init__(self, path: Path, *, on_missing: Literal["error", "missing"] = "error") -> None:
        self.path = path
        self._on_missing = on_missing
        self._name = ""
        self._symbols: dict[str, Symbol] = {}
        self._factors: list[Factor] = []
        self._children: set[str] = set()
        self._entries = 0

    def name(self, name: str) -> None:
        """Set the name of the network. Instead of a placeholder such as `unknown`, the file's name is used."""
        if name.lower() not in {"unknown", "network", "unnamed", "default", ""}:
            self._name = "".join(each for each in name if each.isprintable())[:MAX_NAME]

    def size(self, name: str, place: Place) -> int:
        """Return the number of states of a variable."""
        if name not in self._symbols:
            raise place.error(f"there is no variable {name[:MAX_NAME]!r} before this line")
        return self._symbols[name].size

    def state(self, name: str, label: str, place: Place) -> int:
        """Return the index of the state `label` of the variable `name`."""
        self.size(name, place)
        try:
            return self._symbols[name].index(label)
        except ModelError as reason:
            raise place.error(str(reason)) from None

    def variable(self, name: str, states: Sequence[str] | int, place: Place) -> None:
        """Add a variable. `states` are the names of its states, or their number."""
        if not 0 < len(name) <= MAX_NAME:
            raise place.error(f"a variable's name has {len(name)} characters, expected 1 to {MAX_NAME}")
        if not name.isprintable():
            raise place.error(f"the variable {name!r} has a character in its name that cannot be printed")
        if name in self._symbols:
            raise place.error(f"the variable {name!r} is defined twice")
        if len(self._symbols) == MAX_VARIABLES:
            raise place.error(f"more than {MAX_VARIABLES} variables")
        count = states if isinstance(states, int) else len(states)
        if not 0 < count <= MAX_STATES:
            raise place.error(f"{name} has {count} states, expected 1 to {MAX_STATES}")
        try:
            kind = IntegerType(0, count - 1) if isinstance(states, int) else LabelType(*states)
            if any(len(label) > MAX_NAME for label in kind.labels):
                raise place.error(f"a state of {name} has more than {MAX_NAME} characters")
            if wrong := next((label for label in kind.labels if not label.isprintable()), None):
                raise place.error(f"the state {wrong!r} of {name} has a character that cannot be printed")
            self._symbols[name] = Symbol(name, kind, on_missing=self._on_missing)
        except ModelError as reason:
            raise place.error(f"variable {name}: {reason}") from None

    def shape(self, scope: Sequence[str], place: Place) -> tuple[int, ...]:
        """Return the shape of a table over the variables in `scope`, after checking the limits."""
        if len(scope) > MAX_PARENTS + 1:
            raise place.error(f"a table of {len(scope)} variables; the maximum is {MAX_PARENTS + 1}")
        if len(set(scope)) < len(scope):
            raise place.error(f"the table of {', '.join(scope)} names a variable twice")
        shape = tuple(self.size(name, place) for name in scope)
        entries = math.prod(shape)
        self._entries += entries
        if entries > MAX_ENTRIES or self._entries > MAX_TOTAL:
            raise place.error(
                f"a table of {entries} entries makes {self._entries}; the most is {MAX_ENTRIES} in one table and "
                f"{MAX_TOTAL} in all"
            )
        return shape

    def distribution(
        self, child: str, parents: Sequence[str], values: NDArray[np.float64], place: Place
    ) -> None:
        """Add P(child | parents), float64[child's size, parents' sizes]. Sums within `ROUNDING` of 1 are normalised."""
        if child in self._children:
            raise place.error(f"{child} has two tables")
        self._children.add(child)
        symbols = [self._symbols[name] for name in (child, *parents)]
        if not np.all(np.isfinite(values)) or np.any(values < 0):
            raise place.error(f"the table of {child} holds a number that is not a probability")
        sums = values.sum(axis=0)
        wrong = np.argwhere(np.abs(sums - 1) > ROUNDING)
        if len(wrong):
            at = tuple(wrong[0])
            where = ", ".join(
                f"{symbol.name} = {symbol.type.labels[state] if symbol.type.labels else state}"
                for symbol, state in zip(symbols[1:], at, strict=True)
            )
            raise place.error(
                f"the probabilities of {child} sum to {float(sums[at]):.6g}"
                + (f" for {where}" if where else "")
            )
        try:
            self._factors.append(table(symbols[0], values / sums, given=symbols[1:]))
        except ModelError as reason:
            raise place.error(str(reason)) from None

    def potential(self, scope: Sequence[str], values: NDArray[np.float64], place: Place) -> None:
        """Add a potential, float64[states of each variable]."""
        try:
            self._factors.append(potential([self._symbols[name] for name in scope], values))
        except ModelError as reason:
            raise place.error(str(reason)) from None

    def joint(self) -> JointDistribution:
        """Return the joint distribution. Raises a ModelError if a variable has no table."""
        if not self._symbols:
            raise ModelError("the file has no variables")
        used = {symbol.name for symbol in chain.from_iterable(factor.scope for factor in self._factors)}
        for name in self._symbols:
            if name not in used:
                raise ModelError(f"{name} has no table")
        path = self.path.with_suffix("") if self.path.suffix.lower() == ".gz" else self.path
        return JointDistribution(self._name or path.stem, tuple(self._factors))
