"""The processes of a run for benches and verifications, in a folder of their own.

boat-simulator --> boat-normaliser --> hub <--> masters with 4 boards each
                                        ^
                                        v
                                    dashboard
"""

import asyncio
import contextlib
import math
import os
import signal
import socket
import tempfile
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from casestudies.boat.normaliser import normalise
from casestudies.boat.sensors import BEACONS, SENSOR_NAMES, SENSORS_TOPIC, SENSORS_TYPE, bearing, distance
from casestudies.demo import build
from scripts.running.patience import FACTOR
from terminal.processes import Process

PATIENCE: Final = 60.0 * FACTOR
"""Time limit of each wait, in seconds."""
TAIL: Final = 12
"""Number of the last lines of each log that are shown when a check fails."""


def free_port() -> int:
    """Return a port of this machine that is free now."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def readings_at(x: float, y: float) -> dict[str, int]:
    """Return the normaliser's readings of a boat at (x, y), without noise."""
    bearings = (math.radians(bearing(x, y, beacon)) for beacon in BEACONS)
    values = normalise((*(distance(x, y, beacon) for beacon in BEACONS), *bearings))
    return {name: value for name, value in zip(SENSOR_NAMES, values, strict=True) if value is not None}


class Stand:
    """The processes of a run; each can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        """Keep deployments, logs and sockets in a folder."""
        folder.mkdir(exist_ok=True)
        self.folder = folder
        self.uri = self.url = ""
        # The processes that were started and their command lines, so that they can be started again.
        self._commands: dict[str, tuple[str, ...]] = {}
        self._processes: dict[str, Process] = {}
        self.shown: list[str] = []
        """The processes of which `tails` shows the logs."""

    def pid(self, name: str) -> int:
        """Return the process ID of a process."""
        return self._processes[name].pid

    def log(self, name: str) -> Path:
        """Return the log of a process."""
        return self.folder / f"{name}.log"

    async def start(self, name: str, ready: str, *command: str, limit: float = 2 * PATIENCE) -> str:
        """Start a process, by default with the command of its last start.

        Return the text that matched the regular expression `ready` in its output.
        """
        self._commands[name] = command or self._commands[name]
        self._processes[name] = process = Process(name, self.log(name))
        if name not in self.shown:
            self.shown.append(name)
        await process.start(*self._commands[name])
        async with asyncio.timeout(limit):
            return (await process.line(ready))[0]

    async def kill(self, name: str) -> None:
        """Kill a process as a crash would, and wait for its end."""
        os.kill(self.pid(name), signal.SIGKILL)
        await self.wait(name)

    async def wait(self, name: str) -> int:
        """Wait for the end of a process, and return its exit code."""
        # shielded, because a time limit around this would also end the reading of its lines
        return await asyncio.shield(self._processes[name].wait())

    async def start_hub(self, *flags: str) -> None:
        """Start the hub on a free port; a restart uses the same port."""
        self.uri = await self.start("hub", r"ws://\S+", "hub", *flags, "--port", "0")
        self._commands["hub"] = ("hub", *flags, "--port", str(urlsplit(self.uri).port))

    async def start_master(
        self, deployment: Path, *flags: str, name: str = "master", boards: int = 4
    ) -> None:
        """Start a master on the hub, with `--loop` and a run directory of its own, and wait for its boards."""
        command = ("master", "--loop", "-d", str(deployment), *self._where(name), *flags)
        await self.start(name, f"pcie-app: {boards} board", *command)

    async def start_boat_master(
        self,
        *flags: str,
        name: str = "master",
        topic: str = SENSORS_TOPIC,
        options: Sequence[str] = (),
        extra: str = "",
    ) -> None:
        """Build the boat's deployment, add lines to its deployment.toml, and start its master."""
        deployment = self.folder / f"boat-{name}"
        await build("boat", deployment, self.uri, topic, SENSORS_TYPE, *options)
        with (deployment / "deployment.toml").open("a") as file:
            file.write(extra)
        await self.start_master(deployment, *flags, name=name)

    async def start_boat(self) -> None:
        """Start normaliser and simulator."""
        await self.start("normaliser", "boat", "boat-normaliser", "--uri", self.uri)
        await self.start("simulator", "seed", "boat-simulator", "--uri", self.uri)

    async def start_dashboard(self) -> None:
        """Start the dashboard on a free port; a restart uses the same port."""
        command = ("dashboard", *self._where("master"), "--port")
        self.url = await self.start("dashboard", r"http://[\w.:]+", *command, "0")
        self._commands["dashboard"] = (*command, str(urlsplit(self.url).port))

    def _where(self, name: str) -> tuple[str, ...]:
        """Return the flags with the URI of the hub, and with a new run directory for the process `name`."""
        (run := self.folder / f"run-{name}").mkdir(mode=0o700, exist_ok=True)
        return "--uri", self.uri, "--run-directory", str(run)

    def tails(self) -> str:
        """Return the last lines of the logs."""
        lines = (
            (name, line) for name in self.shown for line in self.log(name).read_text().splitlines()[-TAIL:]
        )
        return "\n".join(f"    {name}: {line}" for name, line in lines)

    def traceback(self) -> str | None:
        """Return which processes have shown a traceback; None if none has."""
        names = [name for name in self._processes if "Traceback" in self.log(name).read_text()]
        return f"there is one from {' and '.join(names)}" if names else None

    async def end(self, *names: str) -> None:
        """End the processes with these names, or all if there are no names."""
        await asyncio.gather(*(self._processes[name].end() for name in names or self._processes))


@contextlib.asynccontextmanager
async def temporary_stand() -> AsyncIterator[Stand]:
    """Give a stand in a temporary folder, and end its processes afterwards."""
    with tempfile.TemporaryDirectory(prefix="rosbayes-") as folder:
        stand = Stand(Path(folder))
        try:
            yield stand
        finally:
            await stand.end()
