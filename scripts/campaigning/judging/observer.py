"""The observer, which judges each result of the stack without code of the services, sockets or clocks.

It is informed of the published readings, of those that reached the stack, of faults, and of
messages on `/bm/frame` and `/BMresults`. It reports everything wrong; counters are judged when nothing is in
flight (`accounts.py`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from scripts.campaigning.judging.expected import BANKS, BOARDS, LINES, Addresses, Outcome

REMEMBERED = 20_000
"""Readings by which a repeated result is recognised."""
LAYOUT = {"dim": [{"label": "x", "size": LINES, "stride": LINES}], "data_offset": 0}


class Flaw(StrEnum):
    """A kind of wrong behaviour."""

    MALFORMED = "malformed"
    """The message does not have the form that the page about topics describes."""
    WRONG = "wrong"
    """The posterior is not the correct one for its reading, or the report describes another frame."""
    UNKNOWN = "unknown reading"
    """The report names a reading that was not published."""
    DUPLICATE = "duplicate"
    OUT_OF_ORDER = "out of order"
    UNREPORTED = "without a report"
    """A result that no report announced."""
    WITHOUT_RESULT = "announced only"
    """A report that announced a result which did not follow, although nothing cut the connection."""
    UNCOUNTED = "lost without being counted"
    MISCOUNTED = "counted, but not lost"
    SILENT = "no results"
    """No result came within a generous limit."""
    ENDED = "ended"
    """A process ended unexpectedly."""
    GROWTH = "growth"
    """A process uses an increasing amount of memory or descriptors."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A flaw that was found, and its time (seconds of the campaign's clock)."""

    flaw: Flaw
    sentence: str
    at: float


@dataclass(slots=True)
class Reading:
    """A published reading: its index, its addresses, its time of publication, and its result's arrival."""

    index: int
    addresses: Addresses | None
    published: float
    forwarded: bool = False
    arrived: float | None = None
    settled: bool = False


@dataclass(frozen=True, slots=True)
class _Announced:
    """The contents of a report about the result that follows it."""

    stamp: int
    number: int
    outcome: Outcome | None
    reading: Reading | None


class Observer:
    """Judges results in the order of their arrival.

    Attributes:
        findings: Everything wrong so far.
        in_fault: Whether a fault has begun and not ended.
        tally: Numbers of readings, results and unusable readings.
    """

    def __init__(self, expected: Callable[[str, Addresses, int], Outcome], deployment: str) -> None:
        """Store the function from deployment, addresses and bank to the correct outcome, and the deployment."""
        self._expected = expected
        self._deployment = deployment
        self._readings: dict[int, Reading] = {}
        self._announced: _Announced | None = None
        self._last_number = 0
        self._last_index = -1
        self.in_fault = False
        self._undisturbed = True
        self.findings: list[Finding] = []
        self.tally: Counter[str] = Counter()

    # --- called by the campaign ----------------------------------------------------------------

    def published(self, stamp: int, addresses: Addresses | None, now: float) -> None:
        """Record a published reading with its stamp in ns; `addresses` is None for an unusable one."""
        assert stamp not in self._readings
        self._readings[stamp] = Reading(self.tally["readings"], addresses, now)
        self.tally["readings"] += 1

    def forwarded(self, stamp: int) -> None:
        """Record that all bytes of a reading have been sent to the stack."""
        if (reading := self._readings.get(stamp)) is not None:
            reading.forwarded = True

    def master_started(self, deployment: str) -> None:
        """Record a new master, whose frame numbers begin again."""
        self._deployment = deployment
        self._last_number = 0
        self._announced = None
        for reading in self.pending_readings():  # the former master counted them, and its counters are gone
            reading.settled = reading.arrived is not None

    def fault(self) -> None:
        """Record the beginning of a fault."""
        self.in_fault = True
        self._undisturbed = False

    def calm(self) -> None:
        """Record the end of a fault; what it has disturbed may still be in flight until `settle`."""
        self.in_fault = False

    def reconnected(self) -> None:
        """Record that messages to the observer itself may have been lost."""
        self._announced = None

    def seen(self, stamp: int) -> bool:
        """Return whether the result of a reading has arrived."""
        return stamp in self._readings and self._readings[stamp].arrived is not None

    def has_result_since(self, index: int) -> bool:
        """Return whether a result has arrived of a reading with this index or a later one."""
        return self._last_index >= index

    @property
    def given(self) -> int:
        """Return the unsettled readings that were sent to the stack."""
        return sum(each.forwarded for each in self.pending_readings())

    def pending_readings(self) -> list[Reading]:
        """Return the readings since the last `settle`, and older ones that had not reached the stack then."""
        return [each for each in self._readings.values() if not each.settled]

    def settle(self) -> None:
        """Record that nothing is in flight, and remove old readings."""
        self._undisturbed = not self.in_fault
        for reading in self.pending_readings():
            reading.settled = reading.forwarded
        newest = self.tally["readings"] - REMEMBERED
        self._readings = {stamp: each for stamp, each in self._readings.items() if each.index >= newest}

    # --- received messages ---------------------------------------------------------------------

    def report(self, message: Any, now: float) -> None:
        """Judge a message of `/bm/frame`."""
        if self._announced is not None and self._undisturbed:
            self._find(Flaw.WITHOUT_RESULT, f"frame {self._announced.number} has no result", now)
        self._announced = None
        try:
            self._announced = self._read_report(message, now)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            self._find(Flaw.MALFORMED, f"/bm/frame: {error!r}", now)

    def result(self, message: Any, now: float) -> None:
        """Judge a message of `/BMresults`, which belongs to the report before it."""
        self.tally["results"] += 1
        announced, self._announced = self._announced, None
        if announced is None:
            self._find(Flaw.UNREPORTED, "a result without a report", now)
            return
        try:
            data = self._data(message)
        except (KeyError, TypeError, ValueError) as error:
            self._find(Flaw.MALFORMED, f"/BMresults of frame {announced.number}: {error!r}", now)
            return
        if announced.outcome is not None and data != announced.outcome.posterior:
            self._find(Flaw.WRONG, f"posterior of frame {announced.number}: {data}", now)
        if announced.reading is not None:
            self._arrived(announced, announced.reading, now)

    def _find(self, flaw: Flaw, sentence: str, now: float) -> None:
        self.findings.append(Finding(flaw, sentence, now))

    def _arrived(self, announced: _Announced, reading: Reading, now: float) -> None:
        if reading.arrived is not None:
            self._find(Flaw.DUPLICATE, f"frame {announced.number}: reading {reading.index} again", now)
            return
        reading.arrived = now
        if reading.index <= self._last_index:
            sentence = f"frame {announced.number}: reading {reading.index} after {self._last_index}"
            self._find(Flaw.OUT_OF_ORDER, sentence, now)
        self._last_index = max(self._last_index, reading.index)

    def _data(self, message: Any) -> tuple[float, ...]:
        layout = message["layout"]
        if layout != LAYOUT:
            raise ValueError(f"the layout is {layout}")
        data = message["data"]
        if len(data) != LINES or not all(type(each) in {float, int} for each in data):
            raise ValueError(f"the data are {data}")
        if not all(0.0 <= each <= 1.0 for each in data) or not math.isclose(math.fsum(data), 1.0):
            raise ValueError(f"these are not probabilities: {data}")
        return tuple(data)

    def _read_report(self, message: Any, now: float) -> _Announced | None:
        stamp = message["header"]["stamp"]
        stamp_ns = (stamp.get("secs", 0) or stamp.get("sec", 0)) * 10**9
        stamp_ns += stamp.get("nsecs", 0) or stamp.get("nanosec", 0)
        first, *others = message["status"]
        values = {pair["key"]: pair["value"] for pair in first["values"]}
        number = int(values["number"])
        if number <= self._last_number:
            flaw = Flaw.DUPLICATE if number == self._last_number else Flaw.OUT_OF_ORDER
            self._find(flaw, f"frame {number} after frame {self._last_number}", now)
        self._last_number = max(number, self._last_number)
        reading = self._readings.get(stamp_ns)
        if reading is None or reading.addresses is None:
            self._find(Flaw.UNKNOWN, f"frame {number} names a reading of {stamp_ns} ns", now)
            return _Announced(stamp_ns, number, None, None)
        if (said := first["hardware_id"]) != self._deployment:
            self._find(Flaw.WRONG, f"frame {number}: {said}, expected {self._deployment}", now)
        outcome = self._expected(self._deployment, reading.addresses, number % BANKS)
        if values["published"] != "true" or first["level"] != 0:
            self._find(Flaw.WRONG, f"frame {number} is said to have no posterior", now)
            return None
        boards = [self._board(each) for each in others]
        right = [(f"board{at}", b.cycles, b.total, b.reason) for at, b in enumerate(outcome.boards)]
        whole = (max(b.cycles for b in outcome.boards), sum(b.total for b in outcome.boards))
        if boards != right or len(boards) != BOARDS:
            self._find(Flaw.WRONG, f"frame {number}: boards {boards}, expected {right}", now)
        if (int(values["cycles"]), int(values["counts_total"])) != whole:
            self._find(Flaw.WRONG, f"frame {number}: its sums are not those of its boards", now)
        return _Announced(stamp_ns, number, outcome, reading)

    @staticmethod
    def _board(status: Any) -> tuple[str, int, int, str]:
        values = {pair["key"]: pair["value"] for pair in status["values"]}
        if values["reason"] != status["message"]:
            raise ValueError(f"reason {values['reason']} and message {status['message']}")
        return status["hardware_id"], int(values["cycles"]), int(values["counts_total"]), values["reason"]
