"""Models: searched and known variables, and the exact posterior (thesis 2.1.2, 3.4).

The names for a `model.py` can be imported from here; each is loaded on first use, so that `--help` does not
need NumPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from toolchain.models.conditional import normal, wrapped_normal
    from toolchain.models.distribution import (
        IntegerType,
        IntervalType,
        LabelType,
        Symbol,
        conditional_normal,
        function,
        potential,
        table,
        uniform,
    )
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

_MODULES: Final = ("model", "conditional", "distribution", "joint")


def __getattr__(name: str) -> object:
    """Return a name from one of the modules of this package (PEP 562)."""
    if name in __all__:
        for module in _MODULES:
            if hasattr(found := import_module(f"{__name__}.{module}"), name):
                return getattr(found, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names, for completion in a notebook."""
    return sorted(__all__)
