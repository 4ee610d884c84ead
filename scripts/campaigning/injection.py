"""Injection of faults into a stack, each of which begins, lasts and is undone."""

from __future__ import annotations

import asyncio
import os
import resource
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path

from scripts.campaigning.containers import ContainerStack
from scripts.campaigning.faults import MISBEHAVIOURS, NONSENSE, Fault
from scripts.campaigning.stack import Stack
from scripts.running.patience import FACTOR

_FEWEST = 3
"""Limit of descriptors under which a process can open nothing more."""
_STARTS_BEFORE = 20
_MISBEHAVING = 20.0 * FACTOR
"""Seconds in which a board should have misbehaved; one that lies in its greeting is not asked for another."""
_FAILED = "failed on a board"
_CLOCK_FILE = "clock"


class Injector:
    """Injector of faults into a stack; processes that the campaign supervises are restarted at once."""

    def __init__(
        self,
        stack: Stack,
        folder: Path,
        *,
        publish: Callable[[str, int], Awaitable[None]],
    ) -> None:
        """Store a function that publishes special readings (kind, number)."""
        self._stack = stack
        self._clock = folder / _CLOCK_FILE
        self._publish = publish
        self.killed: set[str] = set()
        """Roles whose processes were ended by a fault since the last restart."""

    async def inject(self, fault: Fault) -> None:
        """Begin a fault, and return after it has been undone."""
        if fault.what in {"kill", "stop"}:
            await self._signal(fault)
        elif fault.kind == "containers":
            await self._contain(fault)
        elif fault.what == "misbehave":
            await self._misbehave(fault)
        elif fault.what in {"files", "memory"}:
            await self._limit(fault)
        elif fault.what == "clock":
            await self._step_clock(fault)
        elif fault.kind == "input":
            await self._publish(fault.what, fault.number)
        else:
            await self._weather(fault)

    async def _signal(self, fault: Fault) -> None:
        if fault.what == "stop":
            async with self._stack.paused(fault.target):
                await asyncio.sleep(fault.seconds)
        elif await self._stack.kill(fault.target):  # or the other fault of the step has ended it already
            self.killed.add(fault.target)

    async def _contain(self, fault: Fault) -> None:
        """Apply a fault that only containers have."""
        stack = self._stack
        assert isinstance(stack, ContainerStack)
        if fault.what == "cut-off":
            async with stack.cut_off(fault.target):
                await asyncio.sleep(fault.seconds)
        elif fault.what == "restart":
            await stack.stop_part(fault.target)
            self.killed.add(fault.target)
        else:
            with stack.full():
                await stack.stop_part(fault.target)
                await stack.start_part(fault.target)
                await asyncio.sleep(fault.seconds)

    async def restart(self) -> set[str]:
        """Restart killed processes that the campaign supervises, in order, and return the killed roles."""
        killed, self.killed = self.killed, set()
        for role in self._stack.own_parts:
            if role not in killed:
                continue
            await self._stack.wait(role)
            if role == "master":
                await self._stack.forget_run()
            await self._stack.start_part(role)
        return killed

    async def _misbehave(self, fault: Fault) -> None:
        """Restart a board that misbehaves once after some frames, and wait until a frame has failed on it."""
        os.kill(await self._stack.pid(fault.target), signal.SIGKILL)
        await self._stack.wait(fault.target)
        kind = MISBEHAVIOURS[fault.number]
        await self._stack.start_part(fault.target, f"{kind}:{_STARTS_BEFORE}:1")
        deadline = asyncio.get_running_loop().time() + _MISBEHAVING
        back = failed = -1
        while asyncio.get_running_loop().time() < deadline:
            await asyncio.sleep(0.1)
            counters = await self._stack.counters()
            if counters is None:
                continue
            now_failed = counters.lost.get(_FAILED, 0)
            if back < 0 or (failed != now_failed and counters.completed == back):
                back, failed = counters.completed, now_failed  # the board is not ready yet
            elif failed != now_failed:
                return

    async def _weather(self, fault: Fault) -> None:
        link = self._stack.links[fault.target]
        weather = link.weather
        try:
            if fault.what == "gone":
                link.vanish()
            elif fault.what == "cut":
                link.cut()
                return
            elif fault.what == "finish":
                link.finish()
                return
            elif fault.what == "hold":
                weather.open.clear()
            elif fault.what == "slow":
                weather.rate = 20_000.0
            elif fault.what == "delay":
                weather.delay = 0.05
            elif fault.what == "nonsense":
                weather.insert = NONSENSE[fault.number]
            elif fault.what == "cut-inside":
                weather.cut_inside = True
            elif fault.what == "corrupt":
                weather.spoil = fault.number
            elif fault.what == "repeat":
                weather.repeat = fault.number
            await asyncio.sleep(fault.seconds)
        finally:
            weather.delay = weather.rate = 0.0
            weather.insert = b""
            weather.cut_inside = False
            weather.spoil = weather.repeat = 0
            weather.open.set()
            if fault.what == "gone":
                await link.start()

    async def _limit(self, fault: Fault) -> None:
        """Limit a process's descriptors or memory, while connections are restored."""
        pid = await self._stack.pid(fault.target)
        used = self._stack.resources(pid)
        if not pid or used is None:
            return
        which = {"files": resource.RLIMIT_NOFILE, "memory": resource.RLIMIT_AS}[fault.what]
        least = {"files": _FEWEST, "memory": _size(pid) // 2}[fault.what]
        try:
            former = resource.prlimit(pid, which)
            resource.prlimit(pid, which, (least, former[1]))
            if fault.what == "files":
                self._stack.links["rosbridge"].cut()
            else:
                await self._publish("burst", 500)
            await asyncio.sleep(fault.seconds)
            resource.prlimit(pid, which, former)
        except ProcessLookupError:
            return

    async def _step_clock(self, fault: Fault) -> None:
        self.set_clock(self._clock, fault.number)
        await asyncio.sleep(fault.seconds)
        self.set_clock(self._clock, 0)

    @staticmethod
    def set_clock(path: Path, seconds: int) -> None:
        """Write the number of seconds by which the clock is stepped."""
        new = path.with_suffix(".new")
        new.write_text(f"{seconds:+d}\n")
        new.replace(path)


def _size(pid: int) -> int:
    """Return the bytes of a process's address space."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def steppable_clock(folder: Path) -> dict[str, str]:
    """Return the variables under which processes have a clock that can be stepped."""
    path = folder / _CLOCK_FILE
    Injector.set_clock(path, 0)
    paths = [str(Path(__file__).with_name("clock")), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"PYTHONPATH": os.pathsep.join(paths), "CAMPAIGN_CLOCK": str(path)}
