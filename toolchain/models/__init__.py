"""Models: searched and known variables, and the exact posterior (thesis 2.1.2, 3.4).

The names for a `model.py` can be imported from here; each is loaded on first use, so that `--help` does not
need NumPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from toolchain.models.conditional import normal, wrapped_normal
    from toolchain.models.distribution import conditional_normal, function, potential, table, uniform
    from toolchain.models.joint import JointDistribution, Question
    from toolchain.models.model import (
        Known,
        Model,
        PriorSelect,
        cell_centres,
        dimension,
        exact_posterior,
        interval,
    )
    from toolchain.models.symbol import IntegerType, IntervalType, LabelType, Symbol

__all__ = [
    "IntegerType",
    "IntervalType",
    "JointDistribution",
    "Known",
    "LabelType",
    "Model",
    "PriorSelect",
    "Question",
    "Symbol",
    "cell_centres",
    "conditional_normal",
    "dimension",
    "exact_posterior",
    "function",
    "interval",
    "normal",
    "potential",
    "table",
    "uniform",
    "wrapped_normal",
]

_HOMES: Final = {
    "conditional": ("normal", "wrapped_normal"),
    "distribution": ("conditional_normal", "function", "potential", "table", "uniform"),
    "joint": ("JointDistribution", "Question"),
    "model": ("Known", "Model", "PriorSelect", "cell_centres", "dimension", "exact_posterior", "interval"),
    "symbol": ("IntegerType", "IntervalType", "LabelType", "Symbol"),
}
_HOME_OF: Final = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    """Return a name from one of the modules of this package (PEP 562)."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, for completion in a notebook."""
    return sorted(__all__)
