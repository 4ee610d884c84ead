"""The observer, which judges each result of the stack. It uses no sockets, no clocks and no code of the services.

The campaign reports to the observer the published readings, the readings that reached the stack, and the faults. It
also reports the messages on `/bm/frame` and `/BMresults`. The observer records everything that is wrong. It judges
counters when no reading is in flight (`accounts.py`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from scripts.campaigning.expected import BANKS, BOARDS, LINES, Addresses, Outcome

REMEMBERED = 20_000
"""Number of readings that are stored to recognise a repeated result."""
DEPLOYMENT = "campaign"
LAYOUT = {"dim": [{"label": "x", "size": LINES, "stride": LINES}], "data_offset": 0}


class Flaw(StrEnum):
    """A kind of wrong behaviour."""

    MALFORMED = "malformed"
    """The message does not have the form that docs/reference/topics.md describes."""
    WRONG = "wrong"
    """The posterior is not the correct one for its reading, or the report describes another frame."""
    UNKNOWN = "unknown reading"
    """The report names a reading that was not published."""
    DUPLICATE = "duplicate"
    OUT_OF_ORDER = "out of order"
    UNREPORTED = "without a report"
    """A result arrived that no report had announced."""
    WITHOUT_RESULT = "announced only"
    """A report announced a result that did not follow, although nothing cut the connection."""
    UNCOUNTED = "lost without being counted"
    MISCOUNTED = "counted, but not lost"
    UNEXPLAINED = "lost without a cause"
    """A loss was counted under a reason that no current fault explains."""
    SILENT = "no results"
    """No result came within a generous limit."""
    ENDED = "ended"
    """A process ended unexpectedly."""
    GROWTH = "growth"
    """A process uses an increasing amount of memory or descriptors."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A flaw that was found."""

    flaw: Flaw
    sentence: str


@dataclass(slots=True)
class Reading:
    """A published reading.

    Attributes:
        index: Index among all readings, from 0.
        addresses: Addresses of the reading, or None if the reading is unusable.
        published: Time of publication, in seconds of the campaign's clock.
        crowded: Whether the previous reading had no result at this time. The stack may then drop the older reading.
        forwarded: Whether all bytes of the reading have been sent to the stack.
        arrived: Whether the result of the reading has arrived.
        settled: Whether the campaign has already judged counters that include this reading.
    """

    index: int
    addresses: Addresses | None
    published: float
    crowded: bool = False
    forwarded: bool = False
    arrived: bool = False
    settled: bool = False


@dataclass(frozen=True, slots=True)
class _Announced:
    """The contents of a report on `/bm/frame`, until its result arrives on `/BMresults`."""

    number: int
    outcome: Outcome | None
    reading: Reading | None


class Observer:
    """Judges results in the order of their arrival."""

    def __init__(self, expected: Callable[[Addresses, int], Outcome]) -> None:
        """Store the function that returns the correct outcome for addresses and a bank."""
        self._expected = expected
        # All readings by stamp, except the oldest settled ones.
        self._readings: dict[int, Reading] = {}
        # The reading published last; None after `settle`, when no reading is in flight.
        self._previous: Reading | None = None
        # The report without its result so far. A connection that was restored forgets it.
        self._announced: _Announced | None = None
        # The number of the last frame of the current master, which begins with 1, and the newest reading with a result.
        self._last_number = 0
        self._newest: Reading | None = None
        # False from the beginning of a fault until the counters were judged after its end.
        self._undisturbed = True
        self.in_fault = False
        self.findings: list[Finding] = []
        self.readings = self.results = 0

    # --- called by the campaign ----------------------------------------------------------------

    def published(self, stamp: int, addresses: Addresses | None, now: float) -> None:
        """Record a published reading with its stamp in ns. If the reading is unusable, `addresses` is None."""
        assert stamp not in self._readings
        crowded = self._previous is not None and not self._previous.arrived
        self._previous = self._readings[stamp] = Reading(self.readings, addresses, now, crowded)
        self.readings += 1

    def forwarded(self, stamp: int) -> None:
        """Record that all bytes of a reading have been sent to the stack."""
        if (reading := self._readings.get(stamp)) is not None:
            reading.forwarded = True

    def master_started(self) -> None:
        """Record a new master, whose frame numbers begin again."""
        self._last_number = 0
        self._announced = None
        for reading in self.pending_readings():  # the former master counted them, and its counters are gone
            reading.settled = reading.arrived

    def fault(self) -> None:
        """Record the beginning of a fault."""
        self.in_fault = True
        self._undisturbed = False

    def calm(self) -> None:
        """Record the end of a fault; disturbed frames may still be in flight until `settle`."""
        self.in_fault = False

    def reconnected(self) -> None:
        """Record that messages to the observer itself may have been lost."""
        self._announced = None

    def seen(self, stamp: int) -> bool:
        """Return whether the result of a reading has arrived."""
        return stamp in self._readings and self._readings[stamp].arrived

    def newest_since(self, index: int) -> Reading | None:
        """Return the newest reading with a result; None if its index is below `index`."""
        return self._newest if self._newest is not None and self._newest.index >= index else None

    def pending_readings(self) -> list[Reading]:
        """Return the readings since the last `settle`, and older ones that had not reached the stack by then."""
        return [each for each in self._readings.values() if not each.settled]

    def settle(self) -> None:
        """Record that nothing is in flight, and remove old readings."""
        self._undisturbed = not self.in_fault
        self._previous = None
        for reading in self.pending_readings():
            reading.settled = reading.forwarded
        newest = self.readings - REMEMBERED
        self._readings = {stamp: each for stamp, each in self._readings.items() if each.index >= newest}

    def find(self, flaw: Flaw, sentence: str) -> None:
        """Record a flaw."""
        self.findings.append(Finding(flaw, sentence))

    # --- received messages ---------------------------------------------------------------------

    def report(self, message: Any) -> None:
        """Judge a message of `/bm/frame`."""
        if self._announced is not None and self._undisturbed:
            self.find(Flaw.WITHOUT_RESULT, f"frame {self._announced.number} has no result")
        self._announced = None
        try:
            self._announced = self._read_report(message)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            self.find(Flaw.MALFORMED, f"/bm/frame: {error!r}")

    def result(self, message: Any) -> None:
        """Judge a message of `/BMresults`, which belongs to the report before it."""
        self.results += 1
        announced, self._announced = self._announced, None
        if announced is None:
            self.find(Flaw.UNREPORTED, "a result without a report")
            return
        try:
            data = _posterior(message)
        except (KeyError, TypeError, ValueError) as error:
            self.find(Flaw.MALFORMED, f"/BMresults of frame {announced.number}: {error!r}")
            return
        if announced.outcome is not None and data != announced.outcome.posterior:
            self.find(Flaw.WRONG, f"posterior of frame {announced.number}: {data}")
        if (reading := announced.reading) is None:
            return
        if reading.arrived:
            self.find(Flaw.DUPLICATE, f"frame {announced.number}: reading {reading.index} again")
            return
        reading.arrived = True
        if newer := self.newest_since(reading.index):
            sentence = f"frame {announced.number}: reading {reading.index} after {newer.index}"
            self.find(Flaw.OUT_OF_ORDER, sentence)
            return
        self._newest = reading

    def _read_report(self, message: Any) -> _Announced | None:
        stamp = message["header"]["stamp"]
        stamp_ns = stamp["secs"] * 10**9 + stamp["nsecs"]  # the stack runs as with ROS 1
        first, *others = message["status"]
        values = {pair["key"]: pair["value"] for pair in first["values"]}
        number = int(values["number"])
        if number <= self._last_number:
            flaw = Flaw.DUPLICATE if number == self._last_number else Flaw.OUT_OF_ORDER
            self.find(flaw, f"frame {number} after frame {self._last_number}")
        self._last_number = max(number, self._last_number)
        if first["hardware_id"] != DEPLOYMENT:
            self.find(Flaw.WRONG, f"frame {number} names the deployment {first['hardware_id']}")
        reading = self._readings.get(stamp_ns)
        if reading is None or reading.addresses is None:
            self.find(Flaw.UNKNOWN, f"frame {number} names a reading of {stamp_ns} ns")
            return _Announced(number, None, None)
        outcome = self._expected(reading.addresses, number % BANKS)
        if values["published"] != "true" or first["level"] != 0:
            self.find(Flaw.WRONG, f"frame {number} is said to have no posterior")
            return None
        said = [_board(each) for each in others]
        right = [(f"board{at}", b.cycles, b.total, b.reason) for at, b in enumerate(outcome.boards)]
        whole = (max(b.cycles for b in outcome.boards), sum(b.total for b in outcome.boards))
        if said != right or len(said) != BOARDS:
            self.find(Flaw.WRONG, f"frame {number}: boards {said}, expected {right}")
        if (int(values["cycles"]), int(values["counts_total"])) != whole:
            self.find(Flaw.WRONG, f"frame {number}: its sums are not those of its boards")
        return _Announced(number, outcome, reading)


def _board(status: Any) -> tuple[str, int, int, str]:
    values = {pair["key"]: pair["value"] for pair in status["values"]}
    if values["reason"] != status["message"]:
        raise ValueError(f"reason {values['reason']} and message {status['message']}")
    return status["hardware_id"], int(values["cycles"]), int(values["counts_total"]), values["reason"]


def _posterior(message: Any) -> tuple[float, ...]:
    layout, data = message["layout"], message["data"]
    if layout != LAYOUT:
        raise ValueError(f"the layout is {layout}")
    if len(data) != LINES or not all(type(each) in {float, int} for each in data):
        raise ValueError(f"the data are {data}")
    if not all(0.0 <= each <= 1.0 for each in data) or not math.isclose(math.fsum(data), 1.0):
        raise ValueError(f"these are not probabilities: {data}")
    return tuple(data)
