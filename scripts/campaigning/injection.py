"""Injection of faults into a stack: each begins, lasts, and is taken back."""

from __future__ import annotations

import asyncio
import contextlib
import os
import resource
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path

from scripts.campaigning.faults import MISBEHAVIOURS, NONSENSE, Fault
from scripts.campaigning.stack import Stack

_FEWEST = 3
"""Limit of descriptors under which a process can open nothing more."""
_STARTS_BEFORE = 20
_MISBEHAVING = 20.0
"""Seconds in which a board should have misbehaved; one that lies in its greeting is not asked for another."""
_FAILED = "failed on a board"
_CLOCK_FILE = "clock"


class Injector:
    """Does faults to a stack. Processes that the campaign supervises are started again at once."""

    def __init__(
        self,
        stack: Stack,
        folder: Path,
        *,
        publish: Callable[[str, int], Awaitable[None]],
        reload: Callable[[], Awaitable[None]],
    ) -> None:
        """Take how special readings are published (what, how many), and how a reload is ordered."""
        self._stack = stack
        self._clock = folder / _CLOCK_FILE
        self._publish = publish
        self._reload = reload
        self.killed: set[str] = set()
        """Roles whose processes were ended by a fault since the last look."""

    async def inject(self, fault: Fault) -> None:
        """Begin a fault, and return when it has been taken back."""
        if fault.what in {"kill", "stop"}:
            await self._signal(fault)
        elif fault.what == "reload":
            await self._reload()
        elif fault.what == "misbehave":
            await self._misbehave(fault)
        elif fault.what in {"files", "memory", "disk"}:
            await self._limit(fault)
        elif fault.what == "clock":
            await self._step_clock(fault)
        elif fault.kind == "input":
            await self._publish(fault.what, fault.number)
        else:
            await self._weather(fault)

    async def _signal(self, fault: Fault) -> None:
        pid = await self._stack.pid(fault.target)
        if not pid:
            return  # the other fault of the step has ended it already
        with contextlib.suppress(ProcessLookupError):
            if fault.what == "kill":
                os.kill(pid, signal.SIGKILL)
                self.killed.add(fault.target)
                return
            os.kill(pid, signal.SIGSTOP)
            try:
                await asyncio.sleep(fault.seconds)
            finally:
                os.kill(pid, signal.SIGCONT)

    async def restart(self) -> set[str]:
        """Start killed processes of the campaign's own again, in their order; return the roles that were killed."""
        killed, self.killed = self.killed, set()
        for role in self._stack.own_parts:
            if role not in killed:
                continue
            await self._stack.ended(role)
            if role == "master":
                await self._stack.forget_run()
            await self._stack.start_part(role)
        return killed

    async def _misbehave(self, fault: Fault) -> None:
        """Start a board again as one that misbehaves once, after some frames, and wait until one has failed for it."""
        os.kill(await self._stack.pid(fault.target), signal.SIGKILL)
        await self._stack.ended(fault.target)
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
                back, failed = counters.completed, now_failed  # the board is not back yet
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
        """Take descriptors, memory or the disk from a process, while connections are made again."""
        pid = await self._stack.pid(fault.target)
        used = self._stack.resources(pid)
        if not pid or used is None:
            return
        which = {
            "files": resource.RLIMIT_NOFILE,
            "memory": resource.RLIMIT_AS,
            "disk": resource.RLIMIT_FSIZE,
        }[fault.what]
        least = {"files": _FEWEST, "memory": _size(pid) // 2, "disk": 0}[fault.what]
        try:
            former = resource.prlimit(pid, which)
            resource.prlimit(pid, which, (least, former[1]))
            if fault.what == "disk":
                await self._reload()
            elif fault.what == "files":
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
        """Write by how many seconds the clock is moved."""
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
