"""A frame assembler with the clock of the event loop."""

import asyncio
import time
from collections.abc import Callable

from bridge.client import Message
from services.pipeline.frames import FrameAssembler
from services.sockets.records import Reading
from toolchain.deployment import Deployment


class TimedFrames(FrameAssembler):
    """Delivery of each reading when it is complete, or when the wait for optional topics is over."""

    def __init__(self, deployment: Deployment, deliver: Callable[[Reading], None]) -> None:
        """Start without messages; `deliver` is called with each reading."""
        super().__init__(deployment)
        self._deliver = deliver
        self._timer: asyncio.TimerHandle | None = None
        self._timer_deadline: int | None = None

    def add(self, source: int, message: Message) -> None:
        """Add a message of a source, and deliver the readings that it completes.

        Raises:
            VariableError: A variable is missing or unusable; the sentence names topic and variable.
        """
        self._deliver_all(self.take(source, message.msg, message.received_ns, message.received_monotonic_ns))

    def _wake(self) -> None:
        self._timer = self._timer_deadline = None
        self._deliver_all(self.due(time.monotonic_ns()))

    def _deliver_all(self, readings: list[Reading]) -> None:
        for reading in readings:
            self._deliver(reading)
        if self.deadline != self._timer_deadline:
            self._set_timer()

    def _set_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._timer_deadline = None, self.deadline
        if self.deadline is not None:
            delay = max(self.deadline - time.monotonic_ns(), 0) / 1e9
            self._timer = asyncio.get_running_loop().call_later(delay, self._wake)
