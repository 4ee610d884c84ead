"""Models: searched and known variables, and the exact posterior (thesis 2.1.2, 3.4). A `model.py` imports from here."""

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
from toolchain.models.model import Known, Model, PriorSelect, dimension, exact_posterior

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
    "conditional_normal",
    "dimension",
    "exact_posterior",
    "function",
    "potential",
    "table",
    "uniform",
]
