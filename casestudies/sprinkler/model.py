"""The sprinkler case study: the network P(R) P(S | R) P(G | S, R), the question P(R | G) and a topic (thesis 2.1.3.1).

R is 1 if it has rained, S is 1 if the sprinkler was on, and G is 1 if the grass is wet.
"""

from functools import cache
from typing import Final

from toolchain.models import JointDistribution, LabelType, Question, Symbol, table

RAIN: Final = 0.2
"""P(R = 1)."""
ON: Final = (0.4, 0.01)
"""P(S = 1 | R), for R = 0 and 1."""
WET: Final = ((0.0, 0.8), (0.9, 0.99))
"""P(G = 1 | S, R). The rows are for S = 0 and 1, the columns for R = 0 and 1."""

GRASS_TOPIC: Final = "/sprinkler/grass"
"""Topic of G, the reading."""
TYPE: Final = "std_msgs/UInt8"
"""Message type of `GRASS_TOPIC`. Every ROS server has this type installed."""


def model() -> Question:
    """Return the question P(R | G)."""
    rained = Symbol("R", LabelType("no", "yes"))
    sprinkler = Symbol("S", LabelType("off", "on"))
    grass = Symbol("G", LabelType("dry", "wet"), path="data")
    joint = JointDistribution(
        "sprinkler",
        (
            table(rained, [1 - RAIN, RAIN]),
            table(sprinkler, [[1 - p for p in ON], ON], given=[rained]),
            table(grass, [[[1 - p for p in row] for row in WET], WET], given=[sprinkler, rained]),
        ),
    )
    return joint.ask(searched=[rained], known=[grass])


@cache
def exact_rain(grass: int) -> float:
    """Return P(R = 1 | G = grass) by exact inference. For wet grass, it is 0.3577."""
    return float(model().network().exact((grass,))[1])
