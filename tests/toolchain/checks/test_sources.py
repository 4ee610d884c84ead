"""Findings of `toolchain check` about topics whose messages must be paired."""

import pytest

from tests.toolchain.deployments import boat
from toolchain.checks.check import source_findings
from toolchain.checks.finding import Check, Severity
from toolchain.deployment import Source, Variable


def deployment(*types, tolerance_s):
    return boat(
        sources=tuple(Source(uri="ws://a:1", topic=f"/t{at}", type=each) for at, each in enumerate(types)),
        variables=tuple(Variable(name=f"D{at}", source=at, bits=7, values=101) for at in range(len(types))),
        tolerance_s=tolerance_s,
    )


@pytest.mark.parametrize(
    ("types", "tolerance_s", "severity"),
    [
        (["std_msgs/msg/Float64"], 0.0, None),
        (["sensor_msgs/Imu", "sensor_msgs/LaserScan"], 0.0, None),
        (["std_msgs/msg/Float64", "sensor_msgs/msg/Imu"], 0.05, Severity.NOTE),
        (["geometry_msgs/Twist", "sensor_msgs/Imu"], 0.05, Severity.NOTE),
        (["geometry_msgs/TwistStamped", "sensor_msgs/Imu"], 0.05, None),
        (["std_msgs/Float64", "std_msgs/Float64"], 0.05, None),
        (["std_msgs/Float64", "std_msgs/Float64"], 0.001, Severity.WARNING),
    ],
)
def test_topics_that_pair_by_receipt(types, tolerance_s, severity):
    findings = list(source_findings(deployment(*types, tolerance_s=tolerance_s)))
    assert [(each.check, each.severity) for each in findings] == (
        [(Check.PAIRING, severity)] if severity else []
    )
