"""One round of a campaign: faults are injected into one stack one after the other, and it is judged after each.

    start ─▶ recover ─▶ settle ─▶ calm ─┬▶ inject a step's faults ─▶ recover ─▶ settle ─▶ calm ─┐
                                        └──────────────────────────────────────────────────────┘

`recover` waits for the result of a reading that is published after the fault. `settle` waits until nothing is in
flight, and then judges the counters. `calm` requires results while there is no fault, and then settles in a way that
excuses no loss.
"""

import asyncio
import contextlib
import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

from scripts.campaigning.accounts import ROSBRIDGE_AWAY, Counters, Excuses, judge
from scripts.campaigning.connections import TOPIC, TYPE
from scripts.campaigning.expected import POOL, Addresses, Outcome, addresses_of
from scripts.campaigning.faults import Kind, Step, excuses_of
from scripts.campaigning.injection import Injector
from scripts.campaigning.observer import Finding, Flaw, Observer
from scripts.campaigning.stack import NotThereError, Stack, Topology
from scripts.running.patience import FACTOR
from scripts.running.plain_client import REPORTS, PlainClient

_ANSWER = 0.1 * FACTOR
"""Seconds to wait for a result during a fault before the next reading is published."""
_ANSWER_LIMIT = 10.0 * FACTOR
"""Seconds to wait for a result without a fault, when only one reading is in flight."""
_RECOVERY_LIMIT = 180.0 * FACTOR
"""Timeout in seconds for new results after a fault. The timeout is long, because it is not a test of speed."""
_CALM_LIMIT = 5.0 * FACTOR
"""Seconds allowed for each result of the frames after a fault, in addition to `_RECOVERY_LIMIT`."""
_SETTLE_LIMIT = 30.0 * FACTOR
"""Timeout in seconds until nothing is in flight, sufficient even if a board does not answer or the machine is busy."""
_QUIET = 0.6 * FACTOR
"""Seconds without a change after which nothing is in flight any more."""
_stamps = count(time.time_ns() // 10**9 * 10**9, 1_000_000)
now = time.monotonic
"""The campaign's clock, in seconds."""


@dataclass(slots=True)
class RoundResult:
    """The findings and measurements of a round."""

    findings: list[Finding] = field(default_factory=list)
    frames: int = 0
    steps: int = 0
    """Number of steps that were taken; the last one led to the findings, if any."""
    losses: Counter[str] = field(default_factory=Counter)
    recoveries: list[tuple[float, str]] = field(default_factory=list)
    """Seconds from a step's end to the next result, and the step; they are only reported."""
    resources: dict[tuple[str, int], list[tuple[int, int]]] = field(default_factory=dict)
    """Resident KiB and number of descriptors after each step, by role and process id."""
    words: str = ""


class Round:
    """Runner of steps against one stack."""

    def __init__(
        self,
        folder: Path,
        topology: Topology,
        deployment: Path,
        expected: Callable[[Addresses, int], Outcome],
        rng: random.Random,
        *,
        calm_frames: int,
    ) -> None:
        """Prepare a stack in the empty `folder`. The stack computes `calm_frames` frames between two steps."""
        self._rng, self._topology, self._calm_frames = rng, topology, calm_frames
        self.stack = Stack(folder, topology, deployment, rng)
        self.observer = Observer(expected)
        self._injector = Injector(self.stack, topology, folder / "clock", self._special)
        self._client = PlainClient(self.stack.hub_port, (TOPIC, TYPE), self._take, self.observer.reconnected)
        self._result = RoundResult()
        # The master's counters when they were last judged.
        self._base = Counters()
        # Set by each message to the observer, which came at this time.
        self._news, self._arrived = asyncio.Event(), now()
        # While it is True, `_drive` does not publish.
        self._paused = False
        self._last: Addresses = ()

    # --- readings and results ------------------------------------------------------------------

    def _take(self, topic: str, message: Any) -> None:
        self._arrived = now()
        (self.observer.report if topic == REPORTS else self.observer.result)(message)
        self._news.set()

    async def _publish(self, values: dict[str, object], stamp: int) -> None:
        self.observer.published(stamp, addresses_of(values), now())
        secs, nsecs = divmod(stamp, 10**9)
        header = {"stamp": {"secs": secs, "nsecs": nsecs}, "frame_id": ""}
        await self._client.publish({"header": header, **values})

    def _reading(self) -> dict[str, object]:
        self._last = self._rng.choice([each for each in POOL if each != self._last])
        return dict(zip(("near", "far"), self._last, strict=True))

    async def _drive(self) -> None:
        """Publish readings, each when the result of the previous one has arrived or is late."""
        while True:
            if self._paused or not self._client.connected.is_set():
                await asyncio.sleep(0.01)
                continue
            stamp, published = next(_stamps), now()
            await self._publish(self._reading(), stamp)
            while not self.observer.seen(stamp):
                if now() - published > (_ANSWER if self.observer.in_fault else _ANSWER_LIMIT):
                    break
                await self._some_news()

    async def _some_news(self) -> None:
        """Wait a moment for a message to the observer."""
        self._news.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_ANSWER):
                await self._news.wait()

    async def _special(self, what: str, number: int) -> None:
        """Publish abnormal readings: nan, huge or unusable values, stamps in disorder, or a burst without pauses."""
        stamps = [next(_stamps) for _ in range(number)]
        if what == "disorder":
            self._rng.shuffle(stamps)
        near: dict[str, tuple[object, ...]] = {
            "nan": (float("nan"),),
            "huge": (1e308, -1e308, 10**30, 7.5, -(10**30)),
            "unusable": ("five", [1, 2], {"x": 1}),
        }
        for stamp in stamps:
            values = self._reading()
            if what in near:
                values["near"] = self._rng.choice(near[what])
            await self._publish(values, stamp)
            if what != "burst":
                await asyncio.sleep(0.005)

    # --- a round -------------------------------------------------------------------------------

    async def run(self, steps: list[Step]) -> RoundResult:
        """Run the steps, up to the first one with findings."""
        result, observer = self._result, self.observer
        if any(fault.kind is Kind.CLOCK for step in steps for fault in step):
            self.stack.environment |= self._injector.steppable_clock()
        driver = asyncio.create_task(self._drive())
        try:
            await self.stack.start(observer.forwarded)
            await self._client.start()
            observer.fault()
            until = await self._recover("start")
            await self._settle(Excuses(frozenset({ROSBRIDGE_AWAY}), readings=True, results=True, until=until))
            await self._calm()
            for step in steps:
                if observer.findings:
                    break
                result.steps += 1
                await self._take_step(step)
        except NotThereError as error:
            observer.find(Flaw.ENDED, str(error))
        finally:
            driver.cancel()
            await asyncio.gather(driver, return_exceptions=True)
            await self._client.end()
            if observer.findings:
                result.words = self.stack.last_words()
            await self.stack.end()
        result.findings, result.frames = observer.findings, observer.results
        return result

    async def _take_step(self, step: Step) -> None:
        name = " + ".join(map(str, step))
        self.observer.fault()
        for error in await asyncio.gather(*map(self._injector.inject, step), return_exceptions=True):
            if error is not None:
                raise error
        if "master" in await self._injector.restart():
            self._base = Counters()
            self.observer.master_started()
        begun = now()
        until = await self._recover(name)
        self._result.recoveries.append((now() - begun, name))
        self.observer.calm()
        await self._settle(excuses_of(step, self._topology, until))
        await self._calm()

    async def _recover(self, name: str) -> float:
        """Wait for the result of a reading that is published from now on, and return the time of its publication."""
        begun, first = now(), self.observer.readings
        while (reading := self.observer.newest_since(first)) is None:
            if now() - begun > _RECOVERY_LIMIT:
                self.observer.find(Flaw.SILENT, f"no result {_RECOVERY_LIMIT:.0f} s after: {name}")
                return now()
            if self.stack.is_over("master"):
                words = await self.stack.wait("master")
                self.observer.find(Flaw.ENDED, f"the master ended after: {name}: {words}")
                return now()
            await self._some_news()
        return reading.published

    async def _settle(self, excuses: Excuses) -> None:
        """Stop publishing until nothing is in flight, and compare the counters with the published readings."""
        self._paused = True
        strict = replace(excuses, readings=False, results=False)
        deadline, changed, last = now() + _SETTLE_LIMIT + _QUIET, now(), None
        while True:
            counters, readings = await self.stack.counters(), self.observer.pending_readings()
            state = counters, self.observer.results, sum(each.forwarded for each in readings)
            if state != last:
                last, changed = state, now()
            if counters is not None:
                added = counters.since(self._base)
                findings = judge(added, readings, excuses)
                is_quiet = not findings and now() - changed > _QUIET
                if is_quiet or now() > deadline or not judge(added, readings, strict):
                    self.observer.findings += findings
                    self._base = counters
                    self.observer.settle()
                    self._result.losses.update(added.lost)
                    break
            elif now() > deadline:
                break  # the master has ended, which is a separate finding
            await asyncio.sleep(0.02)
        self._paused = False

    async def _calm(self) -> None:
        """Compute frames without faults, check that no loss occurs that only a fault explains, and sample resources."""
        observer = self.observer
        observer.calm()
        wanted = observer.results + self._calm_frames
        deadline = now() + _RECOVERY_LIMIT + self._calm_frames * _CALM_LIMIT
        while observer.results < wanted and now() < deadline and not observer.findings:
            await self._some_news()
        if observer.results < wanted and not observer.findings:
            observer.find(
                Flaw.SILENT,
                f"{wanted - observer.results} of {self._calm_frames} results are missing without a fault, the last one "
                f"came {now() - self._arrived:.1f} s ago; counted: {await self.stack.counters()}",
            )
        await self._settle(Excuses())
        for process, used in (await self.stack.resources()).items():
            self._result.resources.setdefault(process, []).append(used)
