"""The axes of a posterior, with their units and states. An axis formats cells and sampled states as text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from toolchain.deployment import Deployment, Dimension

_LABEL: Final = 24


@dataclass(frozen=True, slots=True)
class Axis:
    """A dimension of a posterior. `dimension` has the values of the indices, or is None without a deployment."""

    label: str
    size: int
    dimension: "Dimension | None" = None

    @property
    def unit(self) -> str:
        """The unit of the axis's values, or an empty string."""
        return "" if self.dimension is None else self.dimension.unit

    @property
    def has_states(self) -> bool:
        """True if the values are names of states instead of numbers."""
        return self.dimension is not None and bool(self.dimension.states)

    def value(self, index: float) -> float | str:
        """Return the value at an index: a number or the name of a state. Without `dimension`, return the index."""
        if self.dimension is None:
            return index
        # a mean over names has no meaning, so indices of states are whole
        if self.dimension.states:
            return self.dimension.states[round(index)]
        return self.dimension.value(index)

    def shown(self, index: float) -> str:
        """Return the value at an index as text for a terminal."""
        value = self.value(index)
        if isinstance(value, str):
            return printable(value)
        return f"{value:.6g} {self.unit}".rstrip()


def deployment_axes(deployment: "Deployment") -> list[Axis]:
    """Return the axes of a deployment's posteriors, in the order of the posterior's dimensions."""
    return [Axis(dimension.label, dimension.size, dimension) for dimension in deployment.result_dimensions]


def reading_order(labels: Sequence[str]) -> list[int]:
    """Return the indices of labels, with x before y, and y before z. All other labels keep their places."""
    coordinates = [at for at, label in enumerate(labels) if label.lower() in {"x", "y", "z"}]
    moved = dict(zip(coordinates, sorted(coordinates, key=lambda at: labels[at].lower()), strict=True))
    return [moved.get(at, at) for at in range(len(labels))]


def in_words(axes: Sequence[Axis], indices: Mapping[str, float]) -> str:
    """Return a cell or a mean as text: `x -0.5 m, y 2.5 m`.

    If no axis has a `dimension`, the text shows indices: `cell x 2, y 1`.
    """
    ordered = [axes[at] for at in reading_order([axis.label for axis in axes])]
    words = ", ".join(f"{printable(axis.label)} {axis.shown(indices[axis.label])}" for axis in ordered)
    return words if any(axis.dimension for axis in axes) else f"cell {words}"


def state_in_words(dimensions: "Sequence[Dimension]", codes: Sequence[int]) -> str:
    """Return a sampled state as text: `rain=yes  grass=wet`.

    Without dimensions, `codes` are the 32-bit words of the state, and the text is hexadecimal.
    """
    if not dimensions:
        return " ".join(f"{word:08x}" for word in reversed(codes))
    axes = [Axis(each.label, each.size, each) for each in dimensions]
    pairs = zip(axes, codes, strict=True)
    shown = ((axis, axis.shown(code) if code < axis.size else f"code {code}") for axis, code in pairs)
    return "  ".join(f"{printable(axis.label)}={value}" for axis, value in shown)


def printable(text: str) -> str:
    """Return received text shortened and without control characters."""
    # labels come over the wire: they must not fill the screen, nor control it
    text = text if len(text) <= _LABEL else text[: _LABEL - 3] + "..."
    return text if text.isprintable() else repr(text)
