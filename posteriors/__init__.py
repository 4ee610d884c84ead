"""Posteriors as ROS messages: writing, reading, receiving, and pairing with the reports of their frames."""

from posteriors.emulation import posterior
from posteriors.errors import BadResultError, LabelError, NoResultError, PosteriorError
from posteriors.frame_report import BoardReport, FrameReport, StageTimes, VariableReading
from posteriors.listening import Posteriors, listen, posteriors
from posteriors.posterior import Posterior

__all__ = [
    "BadResultError",
    "BoardReport",
    "FrameReport",
    "LabelError",
    "NoResultError",
    "Posterior",
    "PosteriorError",
    "Posteriors",
    "StageTimes",
    "VariableReading",
    "listen",
    "posterior",
    "posteriors",
]
