"""Assembly of complete readings from the messages of one or several topics.

The module has no sockets. It takes messages, and returns complete readings.
"""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

from bridge.errors import BridgeError
from bridge.fields import Field, all_missing
from bridge.stamps import header_stamp_ns
from services.errors import VariableError
from services.pipeline.clock import Clock
from services.pipeline.synchroniser import Synchroniser
from services.sockets.records import Addresses, Reading, Values
from toolchain.deployment import Deployment, Variable
from toolchain.deployment.address import to_address
from toolchain.errors import ReadingError, ReadingMissingError

UNPAIRED_WARNING = 8
"""If no frame forms after this many messages of every needed topic, the gap between the topics' stamps is reported."""


class _SourceReader:
    """Reader of the variables, and possibly the prior, in the messages of one topic."""

    def __init__(self, deployment: Deployment, source: int) -> None:
        self._deployment = deployment
        # Indices of this topic's variables in the deployment, which are the positions of their addresses in a reading.
        self.columns = [at for at, each in enumerate(deployment.variables) if each.source == source]
        variables = [deployment.variables[at] for at in self.columns]
        self._fields = [(each, Field(each.path or each.name)) for each in variables]
        self._arrays = {each.name for each in variables if deployment.reading_shape(each)}
        prior = deployment.prior
        self._prior = None if prior is None or prior.source != source else Field(prior.path)
        self._prior_optional = prior is None or prior.on_missing == "model"
        self.topic = deployment.sources[source].topic
        # With a single topic every message is a frame, even if all of its variables may be missing.
        optional = len(deployment.sources) > 1 and all(each.on_missing == "missing" for each in variables)
        self.needed = bool(variables and not optional) or (
            self._prior is not None and not self._prior_optional
        )

    def read(self, message: dict[str, Any]) -> tuple[Addresses, Values, bytes]:
        """Return a message's addresses, values and prior codes; raise a VariableError if a variable is unusable."""
        addresses: Addresses = []
        values: Values = []
        try:
            for variable, field in self._fields:
                address, value = self._address(variable, field, message)
                addresses.append(address)
                values.append(None if address is None else _plain(value))
            return addresses, values, self._prior_codes(message)
        except (BridgeError, ReadingError) as error:
            raise VariableError(f"{self.topic}: {error}") from error

    def _address(
        self, variable: Variable, field: Field, message: dict[str, Any]
    ) -> tuple[int | list[int] | None, object]:
        """Return the address of a variable, and its value as received."""
        value = field.value(message)[1]
        if value is None and variable.on_missing == "error":
            self._require_all(message)
        if variable.name not in self._arrays:
            return to_address(variable, value), value
        # imported here, because a subscriber of single numbers does not need NumPy
        from toolchain.deployment.address_array import to_addresses

        return to_addresses(self._deployment, variable, value), None

    def _require_all(self, message: dict[str, Any]) -> None:
        """Raise an error that names all missing readings of a message, unless there is only one and it is null."""
        # often several are missing, such as all of one sensor
        needed = [field for variable, field in self._fields if variable.on_missing == "error"]
        if self._prior is not None and not self._prior_optional:
            needed.append(self._prior)
        found = [(field, *field.value(message)) for field in needed]
        missing = {field: present for field, present, value in found if value is None}
        if not any(missing.values()):
            raise all_missing(list(missing), message)
        if len(missing) > 1:
            names = ", ".join(field.name for field in missing)
            raise ReadingMissingError(
                f"{names} are absent or null (NaN is null in JSON), and this deployment needs them (on_missing = error)"
            )

    def _prior_codes(self, message: dict[str, Any]) -> bytes:
        if self._prior is None:
            return b""
        present, value = self._prior.value(message)
        if not present or value is None:
            if self._prior_optional:
                return b""
            self._require_all(message)
            raise self._prior.missing(message)
        from toolchain.deployment.address_array import written_prior

        machine = self._deployment.machine
        codes = written_prior(
            value, lines=machine.lines, prob_bits=machine.prob_bits, replicas=machine.replicas
        )
        return codes.astype("<u2").tobytes()


def _plain(value: object) -> float | str | None:
    """Return a number as a float, a text unchanged, and None for any other value, which a record cannot hold."""
    if isinstance(value, int | float):
        try:
            return float(value)
        except OverflowError:  # an integer that was clamped
            return math.inf if value > 0 else -math.inf
    return value if isinstance(value, str) else None


@dataclass(frozen=True, slots=True)
class StampGap:
    """A gap between the stamps of two topics. The gap exceeds the tolerance, so no frame is formed."""

    oldest: str
    """The topic whose last message has the oldest stamp."""
    newest: str
    apart_s: float
    tolerance_s: float
    without_header: tuple[str, ...]
    """Topics whose messages have no header. For these topics, the time of receipt replaces the stamp."""

    def __str__(self) -> str:
        bare = " and ".join(self.without_header)
        receipts = f" ({bare} without a header, so by time of receipt)" if bare else ""
        simulated = "pass --use-sim-time if a simulation stamps them, " if bare else ""
        return (
            f"messages come on all topics but make no frame: the newest of {self.oldest} is {self.apart_s:.3g} s older than "
            f"that of {self.newest}{receipts}, and the tolerance is {self.tolerance_s:g} s; "
            f"set the clocks, {simulated}or build with a larger --tolerance"
        )


class FrameAssembler:
    """Assembly of complete readings from the messages of a deployment's topics.

    With one topic, every message is a frame. With several topics, messages are paired by their stamps (see
    `Synchroniser`). If the clock is simulated, the simulated time is used instead of the times of receipt.
    """

    def __init__(self, deployment: Deployment, clock: Clock | None = None) -> None:
        self._clock = clock if clock is not None and clock.simulated else None
        count = len(deployment.sources)
        self._readers = [_SourceReader(deployment, source) for source in range(count)]
        self._width = len(deployment.variables)
        self._tolerance_ns = int(deployment.tolerance_s * 1e9)
        self._synchroniser: Synchroniser[Reading] = Synchroniser(
            [reader.needed for reader in self._readers], self._tolerance_ns
        )
        # For each topic: the newest stamp and whether a header had it, and the messages since the last frame. They
        # show when messages arrive on all topics, but their stamps never match.
        self._newest: list[tuple[int, bool]] = [(0, True)] * count
        self._since_pair = [0] * count
        self.absent: Counter[str] = Counter()
        """Number of frames that lack a topic although it was alive, by topic."""

    @property
    def unpaired(self) -> int:
        """Number of messages that remained unpaired."""
        return self._synchroniser.unpaired

    @property
    def deadline(self) -> int | None:
        """Tick (ns) at which the caller must call `due`, or None if no message waits for another topic."""
        return self._synchroniser.deadline

    def take(
        self, source: int, message: dict[str, Any], received_ns: int, received_tick: int
    ) -> list[Reading]:
        """Add a message of a source, and return the readings that are now complete.

        Args:
            source: Index of the source.
            message: The message's fields.
            received_ns: Time of the message's receipt, in ns of Unix time.
            received_tick: Time of the message's receipt, in ns of the monotonic clock.

        Raises:
            VariableError: A variable is missing or unusable. The error names the topic and the variable.
        """
        stamp_ns = header_stamp_ns(message)
        now_ns, tick = received_ns, received_tick
        if self._clock is not None:
            now_ns, tick = self._clock.time_ns(), self._clock.tick()
        addresses, values, prior_codes = self._readers[source].read(message)
        taken = Reading(
            stamp_ns=now_ns if stamp_ns is None else stamp_ns,
            received_ns=received_ns,
            received_tick=received_tick,
            addresses=addresses,
            prior_codes=prior_codes,
            values=values,
        )
        # without other topics, no stamp can be wrong
        if len(self._readers) == 1:
            return [taken]
        self._newest[source] = taken.stamp_ns, stamp_ns is not None
        self._since_pair[source] += 1
        self._synchroniser.add(source, taken.stamp_ns, tick, taken)
        return self.due(tick)

    def due(self, tick: int) -> list[Reading]:
        """Return the readings that are complete at this tick (ns)."""
        readings = []
        while (chosen := self._synchroniser.take_set(tick)) is not None:
            readings.append(self._joined(chosen))
            self.absent.update(self._readers[source].topic for source in self._synchroniser.absent)
        return readings

    def _joined(self, chosen: dict[int, Reading]) -> Reading:
        addresses: Addresses = [None] * self._width
        values: Values = [None] * self._width
        ticks = [0] * self._width
        prior_codes = b""
        # the latency of a frame counts from the message that completed it
        last = max(chosen.values(), key=lambda each: each.received_tick)
        newest_ns = max(each.stamp_ns for each in chosen.values())
        for source, reading in chosen.items():
            prior_codes = prior_codes or reading.prior_codes
            for at, column in enumerate(self._readers[source].columns):
                addresses[column], values[column] = reading.addresses[at], reading.values[at]
                ticks[column] = reading.received_tick
                if self._clock is not None:  # older by simulated time than the newest one
                    ticks[column] = last.received_tick - (newest_ns - reading.stamp_ns)
        self._since_pair = [0] * len(self._since_pair)
        return Reading(
            stamp_ns=newest_ns,
            received_ns=last.received_ns,
            received_tick=last.received_tick,
            addresses=addresses,
            prior_codes=prior_codes,
            values=values,
            ticks=ticks,
        )

    def needs(self, source: int) -> bool:
        """Return whether each frame must have a message of this source (an index)."""
        return self._readers[source].needed

    def stamp_gap(self) -> StampGap | None:
        """Return the gap between stamps if all needed topics have messages but no frame is formed, otherwise None."""
        needed = [source for source, reader in enumerate(self._readers) if reader.needed]
        if len(needed) < 2 or any(self._since_pair[source] < UNPAIRED_WARNING for source in needed):
            return None
        oldest = min(needed, key=lambda source: self._newest[source][0])
        newest = max(needed, key=lambda source: self._newest[source][0])
        return StampGap(
            self._readers[oldest].topic,
            self._readers[newest].topic,
            (self._newest[newest][0] - self._newest[oldest][0]) / 1e9,
            self._tolerance_ns / 1e9,
            tuple(self._readers[source].topic for source in needed if not self._newest[source][1]),
        )
