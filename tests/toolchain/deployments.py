"""Deployments that are made without a model."""

from toolchain.deployment import BoardSection, Deployment, Dimension, MachineSection, Source, Variable

BOAT = {
    "name": "boat",
    "sources": (Source(uri="ws://a:9090", topic="/boat/sensors", type="boat_msgs/Sensors"),),
    "variables": (
        Variable(name="D1", bits=7, values=101, on_range="clamp"),
        Variable(name="B1", bits=9, values=360, period=360, path="bearings[0]"),
    ),
    "searched": (Dimension(label="y", size=4, offset=-3.0, step=2.0), Dimension(label="x", size=3)),
    "machine": MachineSection(lines=12),
    "boards": tuple(
        BoardSection(image=f"boards/board{at}.bm", image_hash=str(at) * 64, line_offset=6 * at, lines=6)
        for at in (0, 1)
    ),
}


def boat(**fields):
    """Make a deployment of two variables and twelve lines on two boards, but for some fields."""
    return Deployment(**(BOAT | fields))
