"""Frames: when readings from one or several topics are complete, and what waits while a frame is computed.

No socket and no clock here: messages go in, complete sets of addresses come out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from bridge.errors import BridgeError
from bridge.fields import Field
from bridge.stamps import header_stamp_ns
from services.errors import OverflowedQueueError, VariableError
from services.sockets.records import Addresses, Reading
from toolchain.deployment import Deployment, MachineSection, Variable, WrittenPrior
from toolchain.deployment.address import to_address
from toolchain.errors import ReadingError

QUEUE_ALL_DEPTH = 256
"""Frames that wait with `queue = all` before the run says which part is too slow."""

UNPAIRED_DEPTH = 64
"""Messages kept per topic while those of the other topics are awaited."""

TELLING = 8
"""Messages of every topic without a pair after which it is said how far apart they are."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class _Message:
    stamp_ns: int
    received_ns: int
    received_tick: int
    addresses: tuple[int | list[int] | None, ...]
    prior_codes: bytes


class _SourceReader:
    """Takes the variables of one topic, and the prior where it comes from there, out of its messages."""

    def __init__(
        self,
        deployment: Deployment,
        variables: Sequence[Variable],
        topic: str,
        prior: _PriorReader | None,
    ) -> None:
        self._deployment = deployment
        self._arrays = {variable.name for variable in variables if deployment.reading_shape(variable)}
        self._fields = [(variable, Field(variable.path or variable.name)) for variable in variables]
        self._prior = prior
        self._topic = topic
        self.optional = all(variable.on_missing == "missing" for variable in variables)
        self.needs_prior = prior is not None and not prior.optional

    def read(self, message: dict[str, Any]) -> tuple[int | list[int] | None, ...]:
        addresses: Addresses = []
        for variable, field in self._fields:
            try:
                present, value = field.value(message)
                if not present and variable.on_missing == "error":
                    raise field.missing(message)
                addresses.append(
                    self._several(variable, value)
                    if variable.name in self._arrays
                    else to_address(variable, value)
                )
            except (BridgeError, ReadingError) as error:
                sentence = f"{self._topic}: {error}"
                raise VariableError(sentence) from error
        return tuple(addresses)

    def _several(self, variable: Variable, value: object) -> list[int] | None:
        # Here, not above: a subscriber of numbers does without NumPy.
        from toolchain.deployment.address_array import to_addresses

        return to_addresses(self._deployment, variable, value)

    def prior(self, message: dict[str, Any]) -> bytes:
        if self._prior is None:
            return b""
        try:
            return self._prior.read(message)
        except (BridgeError, ReadingError) as error:
            sentence = f"{self._topic}: {error}"
            raise VariableError(sentence) from error


class _PriorReader:
    """Takes a written prior out of a message, as codes."""

    def __init__(self, prior: WrittenPrior, machine: MachineSection) -> None:
        self._field = Field(prior.path)
        self.optional = prior.on_missing == "model"
        self._machine = machine

    def read(self, message: dict[str, Any]) -> bytes:
        from toolchain.deployment.written_codes import written_prior

        present, value = self._field.value(message)
        if not present or value is None:
            if self.optional:
                return b""
            raise self._field.missing(message)
        codes = written_prior(
            value,
            lines=self._machine.lines,
            prob_bits=self._machine.prob_bits,
            replicas=self._machine.replicas,
        )
        return codes.astype("<u2").tobytes()


class FrameAssembler:
    """Turns the messages of a deployment's topics into complete readings.

    With one topic every message makes a frame. With several, messages are paired by stamp: a frame is
    complete when each topic that may not be missing has a fresh message within the deployment's tolerance of
    the newest arrival; a message that finds no partner is counted in `unpaired`.
    """

    def __init__(self, deployment: Deployment) -> None:
        count = len(deployment.sources)
        self._columns: list[list[int]] = [
            [at for at, variable in enumerate(deployment.variables) if variable.source == source]
            for source in range(count)
        ]
        self._readers = [
            _SourceReader(
                deployment,
                [deployment.variables[at] for at in columns],
                deployment.sources[source].topic,
                _PriorReader(deployment.prior, deployment.machine)
                if deployment.prior is not None and deployment.prior.source == source
                else None,
            )
            for source, columns in enumerate(self._columns)
        ]
        everything_optional = all(reader.optional for reader in self._readers)
        self._needed = [
            reader.needs_prior
            or (bool(columns) and (not reader.optional or (everything_optional and count == 1)))
            for columns, reader in zip(self._columns, self._readers, strict=True)
        ]
        self._width = len(deployment.variables)
        self._tolerance_ns = int(deployment.tolerance_s * 1e9)
        self._fresh: list[deque[_Message]] = [deque() for _ in range(count)]
        self._topics = [source.topic for source in deployment.sources]
        self._newest: list[tuple[int, bool]] = [(0, True)] * count  # stamp, and whether a header had it
        self._waited = [0] * count  # messages since the last pair
        self.unpaired = 0

    def take(
        self, source: int, message: dict[str, Any], received_ns: int, received_tick: int
    ) -> Reading | None:
        """One message of one source; the frame that it completes, if any.

        Args:
            source: index of the message's source in the deployment.
            message: the ROS message as it came.
            received_ns: Unix time of its receipt.
            received_tick: monotonic time of its receipt, ns.

        Raises:
            VariableError: a variable is missing or unusable; the sentence names topic and variable.
        """
        stamp = header_stamp_ns(message)
        taken = _Message(
            received_ns if stamp is None else stamp,
            received_ns,
            received_tick,
            self._readers[source].read(message),
            self._readers[source].prior(message),
        )
        if len(self._fresh) == 1:
            return Reading(
                stamp_ns=taken.stamp_ns,
                received_ns=received_ns,
                received_tick=received_tick,
                addresses=list(taken.addresses),
                prior_codes=taken.prior_codes,
            )
        self._newest[source] = taken.stamp_ns, stamp is not None
        self._waited[source] += 1
        queue = self._fresh[source]
        if len(queue) == UNPAIRED_DEPTH:
            queue.popleft()
            self.unpaired += 1
        queue.append(taken)
        return self._pair(source, taken)

    def _pair(self, newest: int, arrived: _Message) -> Reading | None:
        chosen: dict[int, _Message] = {newest: arrived}
        for source, queue in enumerate(self._fresh):
            if source == newest:
                continue
            near = min(queue, key=lambda each: abs(each.stamp_ns - arrived.stamp_ns), default=None)
            if near is not None and abs(near.stamp_ns - arrived.stamp_ns) <= self._tolerance_ns:
                chosen[source] = near
            elif self._needed[source]:
                return None
        addresses: Addresses = [None] * self._width
        prior_codes = b""
        for source, message in chosen.items():
            prior_codes = prior_codes or message.prior_codes
            for column, address in zip(self._columns[source], message.addresses, strict=True):
                addresses[column] = address
            queue = self._fresh[source]
            while queue:
                if queue.popleft() is message:
                    break
                self.unpaired += 1
        self._waited = [0] * len(self._waited)
        latest = max(chosen.values(), key=lambda each: each.stamp_ns)
        last = max(chosen.values(), key=lambda each: each.received_tick)
        return Reading(
            stamp_ns=latest.stamp_ns,
            received_ns=last.received_ns,
            received_tick=last.received_tick,
            addresses=addresses,
            prior_codes=prior_codes,
        )

    def forget(self) -> None:
        """Wait for no partners any more: messages that have none yet are counted as unpaired."""
        for queue in self._fresh:
            self.unpaired += len(queue)
            queue.clear()

    def needs(self, source: int) -> bool:
        """Whether no frame is complete without a message of this source."""
        return self._needed[source]

    def too_far_apart(self) -> str:
        """Why nothing is paired although messages come on all topics that are needed; empty where it is, or may be yet."""
        needed = [source for source, needed in enumerate(self._needed) if needed]
        if len(needed) < 2 or any(self._waited[source] < TELLING for source in needed):
            return ""
        oldest = min(needed, key=lambda source: self._newest[source][0])
        newest = max(needed, key=lambda source: self._newest[source][0])
        apart_s = (self._newest[newest][0] - self._newest[oldest][0]) / 1e9
        bare = [self._topics[source] for source in needed if not self._newest[source][1]]
        receipts = f" ({' and '.join(bare)} without a header, so by receipt)" if bare else ""
        return (
            f"messages come on all topics but make no frame: the newest of {self._topics[oldest]} is {apart_s:.3g} s older than "
            f"that of {self._topics[newest]}{receipts}, and the tolerance is {self._tolerance_ns / 1e9:g} s; "
            "set the clocks, or build with a larger --tolerance"
        )


class WaitingFrames(Generic[Item]):
    """What waits while the boards compute: the newest frame, or all in order up to a bound."""

    def __init__(self, queue: str) -> None:
        self._keep_all = queue == "all"
        self._waiting: deque[Item] = deque()
        self.passed_over = 0

    def put(self, frame: Item) -> None:
        """Add a frame.

        Raises:
            OverflowedQueueError: with `queue = all`, 256 frames wait already.
        """
        if self._keep_all:
            if len(self._waiting) >= QUEUE_ALL_DEPTH:
                msg = (
                    f"{QUEUE_ALL_DEPTH} frames wait for the boards and more come in: the boards (pcie-app) are the slow part; "
                    "publish more slowly, lower the target count, or use queue = latest"
                )
                raise OverflowedQueueError(msg)
        elif self._waiting:
            self._waiting.clear()
            self.passed_over += 1
        self._waiting.append(frame)

    def get(self) -> Item | None:
        """The next frame to compute, or None."""
        return self._waiting.popleft() if self._waiting else None

    def __len__(self) -> int:
        return len(self._waiting)
