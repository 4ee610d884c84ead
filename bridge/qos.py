"""Quality of service of a ROS 2 topic, for the field `qos` of `advertise` and `subscribe`.

Newer ROS 2 servers read the field, and other servers silently ignore it. The server chooses a value for each omitted
setting. For a subscription, the server takes the publishers of the topic into account.
"""

import math
from dataclasses import dataclass
from typing import Any, Final, Literal

from bridge.errors import OptionError
from bridge.stamps import stamp

_CHOICES: Final = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort", "best_available"),
    "durability": ("volatile", "transient_local", "best_available"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Qos:
    """Quality of service of a topic between ROS nodes.

    Attributes:
        history: Messages that are queued for a slow reader: all (`keep_all`), or the last `depth` (`keep_last`).
        depth: Number of queued messages.
        reliability: Whether lost messages are sent again.
        durability: Whether a late subscriber gets earlier messages (`transient_local`).
        deadline: Maximum expected time between messages in seconds. Infinity means no deadline.
        lifespan: Seconds after which a message expires. Infinity means never.
    """

    history: Literal["keep_last", "keep_all"] | None = None
    depth: int | None = None
    reliability: Literal["reliable", "best_effort", "best_available"] | None = None
    durability: Literal["volatile", "transient_local", "best_available"] | None = None
    deadline: float | None = None
    lifespan: float | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value is not None and value not in choices:
                raise OptionError(f"qos {name} must be one of {', '.join(choices)}, not {value!r}")
        if self.depth is not None and (type(self.depth) is not int or self.depth < 0):
            raise OptionError(f"qos depth must be a whole number of at least 0, not {self.depth!r}")
        for name in ("deadline", "lifespan"):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not value >= 0):
                raise OptionError(f"qos {name} must be a non-negative number of seconds, not {value!r}")

    def as_operation(self) -> dict[str, Any]:
        """Return the value for the field `qos` of an operation."""
        wanted: dict[str, Any] = {
            name: value
            for name in ("history", "depth", "reliability", "durability")
            if (value := getattr(self, name)) is not None
        }
        for name in ("deadline", "lifespan"):
            seconds = getattr(self, name)
            if seconds is not None:
                wanted[name] = "infinite" if math.isinf(seconds) else stamp(round(seconds * 1e9), 1)
        return wanted
