"""One round of a campaign: a stack that is subjected to one fault after the other, and judged after each."""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

from scripts.campaigning.containers import ContainerStack, EngineError
from scripts.campaigning.faults import Kind, Step, excuses_of
from scripts.campaigning.injection import Injector, steppable_clock
from scripts.campaigning.judging.accounts import Counters, Excuses, Overdue, in_transit, judge
from scripts.campaigning.judging.expected import Addresses, Outcome, UnusableError, addresses_of
from scripts.campaigning.judging.measures import Recovery, RoundResult
from scripts.campaigning.judging.observer import Finding, Flaw, Observer
from scripts.campaigning.stack import NotThereError, Stack, Topology
from scripts.campaigning.wire import REPORTS, Client, now
from scripts.running.patience import FACTOR

POOL = (
    *((0, 0), (2, 1), (3, 2), (5, 3), (6, 4), (3, None), (None, 2), (None, None)),
    *((4, 1), (5, 1), (6, 1), (0, 3)),  # sensors that contradict each other need several slices
)
"""Number of different readings in a campaign; few, because the reference kernel is slow."""
_ANSWER = 0.1 * FACTOR
"""Seconds to wait for a result during a fault before the next reading is published."""
_ANSWER_LIMIT = 10.0 * FACTOR
"""The same without a fault, when only one reading is in flight."""
_RECOVERY_LIMIT = 180.0 * FACTOR
"""Seconds within which results must come again; generous, and no measure of the stack."""
_CALM_LIMIT = 5.0 * FACTOR
"""Seconds within which a further result must come, on average."""
_SETTLE_LIMIT = 30.0 * FACTOR
"""Seconds until nothing is in flight, even if a board does not answer or the machine is busy."""
_QUIET = 0.6 * FACTOR
"""Seconds without a change after which nothing is in flight any more."""
_stamps = count(time.time_ns() // 10**9 * 10**9, 1_000_000)


class Round:
    """Runner of steps against one stack."""

    def __init__(
        self,
        folder: Path,
        topology: Topology,
        deployments: list[Path],
        expected: Callable[[str, Addresses, int], Outcome],
        seed: int,
        *,
        calm_frames: int,
    ) -> None:
        """Store an empty folder, and the number of frames to compute between two steps."""
        rng = random.Random(seed)
        self._rng = rng
        self._folder = folder
        self._calm_frames = calm_frames
        self.stack = (
            ContainerStack(folder, deployments[0], rng)
            if topology is Topology.CONTAINERS
            else Stack(folder, topology, deployments[0], rng)
        )
        self.observer = Observer(expected, deployments[0].name)
        self._injector = Injector(self.stack, folder, publish=self._special)
        self._client = Client(self.stack.hub_port, self._take, self.observer.reconnected)
        self._result = RoundResult()
        self._base = Counters()
        self._arrived = now()
        self._master = 0
        self._news = asyncio.Event()
        self._paused = False
        self._driving = True
        self._last: Addresses = ()
        self._overdue = Overdue()

    # --- readings and results ------------------------------------------------------------------

    def _take(self, topic: str, message: Any) -> None:
        self._arrived = now()
        (self.observer.report if topic == REPORTS else self.observer.result)(message, now())
        self._news.set()

    async def _publish(self, values: dict[str, object], stamp: int) -> bool:
        try:
            addresses = addresses_of(values)
        except UnusableError:
            addresses = None
        self.observer.published(stamp, addresses, now())
        return await self._client.publish(stamp, values)

    def _reading(self) -> dict[str, object]:
        while (near_far := self._rng.choice(POOL)) == self._last:
            pass
        self._last = near_far
        return dict(zip(("near", "far"), near_far, strict=True))

    async def _drive(self) -> None:
        """Publish readings, each after the result of the previous one has arrived or is late."""
        while self._driving:
            if self._paused or not self._client.connected.is_set():
                await asyncio.sleep(0.01)
                continue
            stamp = next(_stamps)
            await self._publish(self._reading(), stamp)
            published = now()
            while not self.observer.seen(stamp):
                if now() - published > (_ANSWER if self.observer.in_fault else _ANSWER_LIMIT):
                    break
                await self._some_news()

    async def _some_news(self, seconds: float = _ANSWER) -> None:
        """Wait some seconds for a message to the observer."""
        self._news.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._news.wait()

    async def _special(self, what: str, number: int) -> None:
        """Publish special readings."""
        stamps = [next(_stamps) for _ in range(number)]
        if what == "disorder":
            self._rng.shuffle(stamps)
        for stamp in stamps:
            values = self._reading()
            if what == "nan":
                values["near"] = float("nan")
            elif what == "huge":
                values["near"] = self._rng.choice([1e308, -1e308, 10**30, 7.5, -(10**30)])
            elif what == "unusable":
                values["near"] = self._rng.choice(["five", [1, 2], {"x": 1}])
            await self._publish(values, stamp)
            if what != "burst":
                await asyncio.sleep(0.005)

    # --- a round -------------------------------------------------------------------------------

    async def run(self, steps: list[Step]) -> RoundResult:
        """Run all steps, or up to the first one with findings."""
        result, observer = self._result, self.observer
        if any(fault.kind == Kind.CLOCK for step in steps for fault in step):
            self.stack.environment |= steppable_clock(self._folder)
        driver = None
        try:
            await self.stack.start(observer.forwarded)
            await self._client.start()
            driver = asyncio.create_task(self._drive())
            observer.fault()
            await self._recover("start", noted=False)
            await self._settle(Excuses(readings=True, results=True, until=now()))
            await self._calm()
            steps = [] if observer.findings else steps
            for number, step in enumerate(steps):
                await self._take_step(step)
                if observer.findings:
                    result.failed_step = number
                    break
        except (NotThereError, EngineError) as error:
            observer.findings.append(Finding(Flaw.ENDED, str(error), now()))
        finally:
            self._driving = False
            if driver is not None:
                driver.cancel()
                await asyncio.gather(driver, return_exceptions=True)
            await self._client.end()
            if observer.findings:
                result.words = self.stack.last_words()
            await self.stack.end()
        result.findings = observer.findings
        result.frames, result.readings = observer.tally["results"], observer.tally["readings"]
        return result

    async def _take_step(self, step: Step) -> None:
        name = " + ".join(map(str, step))
        self.observer.fault()
        results = await asyncio.gather(
            *(self._injector.inject(fault) for fault in step), return_exceptions=True
        )
        for error in results:
            if isinstance(error, BaseException):
                raise error
        if "master" in await self._injector.restart():
            self._begin_master()
        await self._recover(name, noted=True)
        excuses = replace(excuses_of(step, self.stack.topology), until=now())
        self.observer.calm()
        await self._settle(excuses)
        await self._calm()

    def _begin_master(self) -> None:
        self._base = Counters()
        self.observer.master_started(self.stack.deployment.name)

    async def _recover(self, name: str, *, noted: bool) -> None:
        """Wait for the result of a reading that is published from now on."""
        begun = now()
        first = self.observer.tally["readings"]
        while not self.observer.has_result_since(first):
            if now() - begun > _RECOVERY_LIMIT:
                self._find(Flaw.SILENT, f"no result {_RECOVERY_LIMIT:.0f} s after: {name}")
                return
            if self.stack.is_over("master"):
                words = await self.stack.wait("master")
                self._find(Flaw.ENDED, f"the master ended after: {name}: {words}")
                return
            await self._some_news()
        if noted:
            self._result.recoveries.append(Recovery(name, now() - begun))

    def _find(self, flaw: Flaw, sentence: str) -> None:
        self.observer.findings.append(Finding(flaw, sentence, now()))

    async def _settle(self, excuses: Excuses) -> None:
        """Stop publishing until nothing is in flight, and compare the counters with the published readings."""
        self._paused = True
        strict = Excuses(overdue=self._overdue)
        excuses = replace(excuses, overdue=self._overdue)
        try:
            deadline, changed = now() + _SETTLE_LIMIT + _QUIET, now()
            last: object = None
            while True:
                counters = await self.stack.counters()
                state = counters, self.observer.tally["results"], self.observer.given
                if state != last:
                    last, changed = state, now()
                if counters is not None:
                    added = counters.since(self._base)
                    readings = self.observer.pending_readings()
                    findings = judge(added, readings, excuses, now())
                    if not judge(added, readings, strict, now()):
                        break
                    if (not findings and now() - changed > _QUIET) or now() > deadline:
                        break
                elif now() > deadline:
                    return  # the master has ended, which is a separate finding
                await asyncio.sleep(0.02)
            self.observer.findings += findings
            self._overdue = cut = in_transit(added, readings, self._overdue)
            self._result.transit = (
                self._result.transit[0] + cut.uncounted,
                self._result.transit[1] + cut.astray,
            )
            self.observer.settle()
            self._base = counters
            for reason, number in added.lost.items():
                self._result.losses[reason] = self._result.losses.get(reason, 0) + number
        finally:
            self._paused = False

    async def _calm(self) -> None:
        """Compute frames without faults, and then settle strictly."""
        self.observer.calm()
        wanted = self.observer.tally["results"] + self._calm_frames
        deadline = now() + _RECOVERY_LIMIT + self._calm_frames * _CALM_LIMIT
        while self.observer.tally["results"] < wanted and now() < deadline and not self.observer.findings:
            await self._some_news()
        if self.observer.tally["results"] < wanted and not self.observer.findings:
            done = self._calm_frames - wanted + self.observer.tally["results"]
            last = now() - self._arrived
            self._find(
                Flaw.SILENT,
                f"{done} of {self._calm_frames} results without a fault, the last one {last:.1f} s ago; "
                f"counted: {await self.stack.counters()}",
            )
        await self._settle(Excuses())
        await self._sample()

    async def _sample(self) -> None:
        for role in self.stack.roles:
            pid = await self.stack.pid(role)
            if pid and (used := self.stack.resources(pid)):
                samples = self._result.resources.setdefault((role, pid), [])
                samples.append((self.observer.tally["results"], *used))
