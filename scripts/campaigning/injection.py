"""Injection of faults into a stack: each begins, lasts for a while, and is undone."""

import asyncio
import contextlib
import os
import resource
import struct
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from scripts.campaigning.accounts import FAILED
from scripts.campaigning.connections import Weather
from scripts.campaigning.faults import MISBEHAVIOURS, NONSENSE, Fault, Kind
from scripts.campaigning.stack import Stack, Topology, used_by
from scripts.running.patience import FACTOR

_FEWEST = 3
"""Limit of descriptors so low that a process cannot open anything more."""
_STARTS_BEFORE = 20
_MISBEHAVING = 300.0 * FACTOR
"""Timeout in seconds for a restarted board to compute some frames."""


class Injector:
    """Injector of faults into a stack; processes that the campaign supervises are restarted at once."""

    def __init__(
        self, stack: Stack, topology: Topology, clock: Path, publish: Callable[[str, int], Awaitable[None]]
    ) -> None:
        """Store the parameters.

        `clock` is the file with the offset of the clock. `publish(kind, number)` publishes readings.
        """
        self._stack = stack
        self._topology = topology
        self._clock = clock
        self._publish = publish
        # Roles whose processes were ended by a fault since the last `restart`.
        self._killed: set[str] = set()

    def steppable_clock(self) -> dict[str, str]:
        """Return the environment variables that give processes a clock that can be stepped."""
        self._clock.write_bytes(struct.pack("<q", 0))
        paths = [str(Path(__file__).with_name("clock")), *filter(None, [os.environ.get("PYTHONPATH")])]
        return {"PYTHONPATH": os.pathsep.join(paths), "CAMPAIGN_CLOCK": str(self._clock)}

    async def inject(self, fault: Fault) -> None:
        """Begin a fault, and return after it has been undone."""
        if fault.what == "kill":
            if await self._stack.kill(fault.target):  # or the other fault of the step has ended it already
                self._killed.add(fault.target)
        elif fault.what == "stop":
            async with self._stack.paused(fault.target):
                await asyncio.sleep(fault.seconds)
        elif fault.what == "misbehave":
            await self._misbehave(fault)
        elif fault.what in {"files", "memory"}:
            await self._limit(fault)
        elif fault.what == "clock":
            self._step_clock(fault.number)
            await asyncio.sleep(fault.seconds)
            self._step_clock(0)
        elif fault.kind is Kind.INPUT:
            await self._publish(fault.what, fault.number)
        else:
            await self._change_weather(fault)

    async def restart(self) -> set[str]:
        """Restart killed processes that the campaign supervises, in order, and return the killed roles."""
        killed, self._killed = self._killed, set()
        for role in self._topology.own_parts:
            if role not in killed:
                continue
            await self._stack.wait(role)
            if role == "master":
                await self._stack.forget_run()
            await self._stack.start_part(role)
        return killed

    async def _misbehave(self, fault: Fault) -> None:
        """Restart a board that misbehaves once after some frames, and wait until it has done so.

        The board has misbehaved as soon as another frame fails. If the host tolerates the misbehaviour, no frame fails;
        then enough completed frames are the sign, because each frame starts the board at least once.
        """
        await self._stack.kill(fault.target)
        await self._stack.wait(fault.target)
        await self._stack.start_part(fault.target, f"{MISBEHAVIOURS[fault.number]}:{_STARTS_BEFORE}:1")
        before: tuple[int, int] | None = None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_MISBEHAVING):
                while True:
                    if (counters := await self._stack.counters()) is not None:
                        completed, failed = counters.completed, counters.lost.get(FAILED, 0)
                        if before is None or completed == before[0]:
                            before = completed, failed  # the board is not ready yet
                        elif failed > before[1] or completed > before[0] + _STARTS_BEFORE:
                            return
                    await asyncio.sleep(0.05)

    async def _change_weather(self, fault: Fault) -> None:
        link = self._stack.links[fault.target]
        if fault.what in {"cut", "finish"}:
            (link.cut if fault.what == "cut" else link.finish)()
            return
        changes: dict[str, dict[str, Any]] = {
            "slow": {"rate": 20_000.0},
            "delay": {"delay": 0.05},
            "nonsense": {"insert": NONSENSE[fault.number]},
            "cut-inside": {"cut_inside": True},
            "corrupt": {"spoil": True},
            "repeat": {"repeat": True},
        }
        link.weather = weather = Weather(**changes.get(fault.what, {}))
        if fault.what == "hold":
            weather.open.clear()
        elif fault.what == "gone":
            link.vanish()
        try:
            await asyncio.sleep(fault.seconds)
        finally:
            weather.open.set()
            link.weather = Weather()
            if fault.what == "gone":
                await link.start()

    async def _limit(self, fault: Fault) -> None:
        """Limit a process's descriptors or memory while connections are restored or many readings arrive."""
        pid = await self._stack.pid(fault.target)
        try:
            which, least = resource.RLIMIT_NOFILE, _FEWEST
            if fault.what == "memory":
                which, least = resource.RLIMIT_AS, used_by(pid)[0] // 2
            former = resource.prlimit(pid, which)
            resource.prlimit(pid, which, (least, former[1]))
            if fault.what == "files":
                self._stack.links["rosbridge"].cut()
            else:
                await self._publish("burst", 500)
            await asyncio.sleep(fault.seconds)
            resource.prlimit(pid, which, former)
        except (ProcessLookupError, FileNotFoundError):
            return  # it has ended, by this limit or by the other fault of the step

    def _step_clock(self, seconds: int) -> None:
        with self._clock.open("r+b") as file:  # processes have mapped it, so it must keep its size
            file.write(struct.pack("<q", seconds))
