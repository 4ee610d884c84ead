"""Findings about sources: topics whose messages cannot be paired."""

from collections.abc import Iterator
from typing import Final

from toolchain.checks.finding import Check, Finding, note, warning
from toolchain.deployment import Deployment

_WITHOUT_HEADER: Final = frozenset(
    f"geometry_msgs/{name}"
    for name in (
        "Accel", "Point", "Point32", "Polygon", "Pose", "Pose2D", "PoseWithCovariance", "Quaternion", "Transform",
        "Twist", "TwistWithCovariance", "Vector3", "Wrench",
    )
)  # fmt: skip
"""Types without a header in a package whose other types have one; those of std_msgs never have one."""
_LEAST_TOLERANCE_S: Final = 0.005
"""Below this, the receipts of two messages that were sent together hardly ever pair."""


def source_findings(deployment: Deployment) -> Iterator[Finding]:
    """Find topics that are paired by receipt, because their messages have no header."""
    if len(deployment.sources) < 2:
        return
    bare = [source.topic for source in deployment.sources if not _may_have_header(source.type)]
    if not bare:
        return
    topics = " and ".join(bare)
    about = f"messages on {topics} have no header, so they are paired by time of receipt"
    if deployment.tolerance_s < _LEAST_TOLERANCE_S:
        yield warning(
            Check.PAIRING,
            topics,
            f"{about}; with a tolerance of {deployment.tolerance_s:g} s they rarely form a frame",
            "build with a --tolerance of at least the network's delay, or publish types with a header",
        )
    elif len(bare) < len(deployment.sources):
        yield note(
            Check.PAIRING,
            topics,
            f"{about}, and the other topics by the robot's clock",
            "synchronise both clocks to well within the tolerance (NTP, chrony), or publish types with a header",
        )


def _may_have_header(type_name: str) -> bool:
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    return package != "std_msgs" and f"{package}/{name}" not in _WITHOUT_HEADER
