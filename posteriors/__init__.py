"""Posteriors as ROS messages: written, read, paired with their frames, and listened to."""

from posteriors.listening import (
    BadResultError,
    FrameReport,
    LabelError,
    NoResultError,
    Posterior,
    Posteriors,
    StageTimes,
    listen,
    posteriors,
)

__all__ = [
    "BadResultError",
    "FrameReport",
    "LabelError",
    "NoResultError",
    "Posterior",
    "Posteriors",
    "StageTimes",
    "listen",
    "posteriors",
]
