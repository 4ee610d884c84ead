"""The clock for stamps and ages of readings.

With `use_sim_time`, it is a simulation's clock on `/clock`, otherwise this computer's clock.
"""

import time
from collections.abc import Callable
from typing import Final

from bridge.client import Ros
from bridge.stamps import stamp_ns

CLOCK_TOPIC: Final = "/clock"
_CLOCK_TYPE: Final = "rosgraph_msgs/Clock"
_INTERVAL_MS: Final = 10
"""Minimum time in ms between two messages from the server, because simulators publish a thousand a second."""
_MOST_NS: Final = 3600 * 10**9
"""Maximum advance of the ticks by one message, so that a jump of the time never makes the ticks exceed 64 bits."""


class Clock:
    """A clock that gives two numbers: a time to compare with stamps, and a tick to measure ages.

    The clock of a simulation may run at any rate, and may pause. If the simulation restarts, the time goes back, but
    the tick does not.
    """

    def __init__(self, *, simulated: bool) -> None:
        self.simulated = simulated
        # The last time on /clock, and by how much it has advanced in all, both in ns.
        self._time: int | None = None
        self._tick = 0
        self.heard = time.monotonic()
        """Time of the last message on /clock, before the first the creation of this object (monotonic seconds)."""

    def time_ns(self) -> int:
        """Return the current time in ns. In a simulation, return 0 until the first message on `/clock` arrives."""
        return (self._time or 0) if self.simulated else time.time_ns()

    def tick(self) -> int:
        """Return the nanoseconds since an arbitrary origin. This number never decreases."""
        return self._tick if self.simulated else time.monotonic_ns()

    async def follow(self, ros: Ros, moved: Callable[[], None] | None = None) -> None:
        """Take the time from `/clock` until cancelled, and call `moved` after each message."""
        messages = ros.subscribe(
            CLOCK_TOPIC, _CLOCK_TYPE, throttle_rate=_INTERVAL_MS, queue_length=1, queue_size=1
        )
        async for message in messages:
            if (now := stamp_ns(message.msg.get("clock"))) is None:
                continue
            self._tick += min(max(now - (now if self._time is None else self._time), 0), _MOST_NS)
            self._time, self.heard = now, time.monotonic()
            if moved is not None:
                moved()
