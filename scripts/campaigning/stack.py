"""The stack under test: its processes, the proxies between them, and their status."""

import asyncio
import contextlib
import os
import random
import shutil
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable
from enum import StrEnum
from pathlib import Path

from scripts.campaigning.accounts import Counters
from scripts.campaigning.connections import Proxy, process_status
from scripts.campaigning.expected import BOARDS
from scripts.running.patience import FACTOR, PRODUCT_LIMITS
from terminal.processes import Process

SERVICES = ("subscriber", "publisher", "pcie-app")
BOARD_NAMES = tuple(f"board{at}" for at in range(BOARDS))
BOARDS_PARENT = "boards"
"""Role of the process from which a master's boards are forked."""
START_LIMIT, END_LIMIT = 120.0 * FACTOR, 30.0 * FACTOR
"""Timeouts in seconds for a process to start and to end, even on a busy machine."""
BOARD_TIMEOUT = 2.0 * FACTOR
"""Timeout of a board in seconds; short, because some faults silence boards."""


class Topology(StrEnum):
    """The processes that the campaign starts instead of the master, and the parts between which its proxies stand."""

    OWN = "processes"
    """The master starts services and boards; a proxy stands between them and rosbridge."""
    FUSED = "fused"
    """As `OWN`, but the services run inside the master."""
    APART = "apart"
    """The campaign starts services and boards; proxies stand between all parts."""
    FUSED_APART = "fused, boards apart"

    @property
    def fused(self) -> bool:
        """True if the services are inside the master."""
        return self in {Topology.FUSED, Topology.FUSED_APART}

    @property
    def apart(self) -> bool:
        """True if the campaign, not the master, starts the boards."""
        return self in {Topology.APART, Topology.FUSED_APART}

    @property
    def roles(self) -> tuple[str, ...]:
        """All roles that are processes in this topology."""
        services = () if self.fused else SERVICES
        return ("hub", *(() if self.apart else (BOARDS_PARENT,)), *BOARD_NAMES, *services, "master")

    @property
    def own_parts(self) -> tuple[str, ...]:
        """Roles whose processes the campaign starts, in the order of starting."""
        services = SERVICES if self is Topology.APART else ()
        return ("hub", *(BOARD_NAMES if self.apart else ()), *services, "master")


class NotThereError(Exception):
    """A process did not start in time."""


def free_port() -> int:
    """Return a free port whose next one is free too."""
    while True:
        with socket.socket() as probe, socket.socket() as following, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", 0))
            port: int = probe.getsockname()[1]
            following.bind(("127.0.0.1", port + 1))
            return port


class Stack:
    """A run of the stack in its own folder.

    Attributes:
        environment: Variables of all processes.
        hub_port: Port of the hub itself, for the campaign's own client.
        links: Proxies by name: `rosbridge`, and the services and boards that the campaign starts.
    """

    def __init__(self, folder: Path, topology: Topology, deployment: Path, rng: random.Random) -> None:
        """Store an empty folder with a short path, and the deployment."""
        self._folder, self._topology, self._deployment = folder, topology, deployment
        self._runs = folder / "run"
        for each in (self._runs, folder / "tmp"):
            each.mkdir(mode=0o700, parents=True)
        self.environment = {name: f"{limit:g}" for name, limit in PRODUCT_LIMITS.items()}
        self.environment |= {"BM_RUN_DIRECTORY": str(self._runs), "TMPDIR": str(folder / "tmp")}
        # The newest process of each of `own_parts`, and the number of all starts, which numbers their logs.
        self._parts: dict[str, Process] = {}
        self._starts = 0
        self.hub_port, proxied_port = free_port(), free_port()
        self._uri = f"ws://127.0.0.1:{proxied_port}"
        self.links = {"rosbridge": Proxy(proxied_port, self.hub_port, rng)}
        for name in SERVICES if topology is Topology.APART else ():
            self.links[name] = Proxy(str(folder / f"{name}.sock"), str(folder / f"real-{name}.sock"), rng)
        # By board, the ports of its proxy and of the board itself; the next port is that for programming.
        self._board_ports = {name: (free_port(), free_port()) for name in BOARD_NAMES if topology.apart}
        for name, (outer, inner) in self._board_ports.items():
            self.links[name] = Proxy(outer, inner, rng)
            self.links[f"{name} programming"] = Proxy(outer + 1, inner + 1, rng)

    async def start(self, on_reading: Callable[[int], None]) -> None:
        """Start everything, but do not wait until the master is ready."""
        self.links["rosbridge"].on_reading = on_reading
        for link in self.links.values():
            await link.start()
        for role in self._topology.own_parts:
            await self.start_part(role)

    def _command(self, role: str, misbehave: str) -> list[str]:
        deployment, folder = ["-d", str(self._deployment)], self._folder
        rosbridge = ["--uri", self._uri, "--connect-timeout", f"{60 * FACTOR:g}", "--ros-version", "1"]
        outside = [f"tcp://127.0.0.1:{outer}" for outer, _ in self._board_ports.values()]
        boards = ["--boards", ",".join(outside)] if outside else []
        limits = ["--board-timeout", f"{BOARD_TIMEOUT:g}"]
        listen = ["--listen", f"unix:{folder}/real-{role}.sock"]
        if role == "hub":
            return ["hub", "--port", str(self.hub_port)]
        if role in BOARD_NAMES:
            endpoint, index = f"tcp://127.0.0.1:{self._board_ports[role][1]}", role.removeprefix("board")
            if misbehave:
                return ["python", "-m", "tests.misbehaving_board", endpoint, index, misbehave]
            return ["board", "--listen", endpoint, "--index", index]
        if role == "pcie-app":
            return [role, *deployment, *listen, *boards, *limits]
        if role in SERVICES:
            return [role, *deployment, *listen, *rosbridge]
        master = ["master", "--loop", *deployment, *rosbridge, *limits]
        if self._topology is Topology.APART:
            return [*master, "--connect", str(folder)]
        return [*master, *(["--fused"] if self._topology.fused else []), *boards]

    async def start_part(self, role: str, misbehave: str = "") -> None:
        """Start a process of the campaign.

        Raises a NotThereError if the hub or a board does not become ready.
        """
        self._starts += 1
        process = Process(role, self._folder / f"{self._starts:03}-{role}.log")
        command = self._command(role, misbehave)
        settings = [f"{name}={value}" for name, value in self.environment.items()]
        program = str(Path(sys.executable).with_name(command[0]))
        await process.start(shutil.which("env") or "env", *settings, program, *command[1:])
        self._parts[role] = process
        if role == "hub" or role in BOARD_NAMES:
            try:
                async with asyncio.timeout(START_LIMIT):
                    await process.line(r"ws://\S+" if role == "hub" else "listens at")
            except Exception as error:
                raise NotThereError(f"{role} did not come up: {error}") from error

    def is_over(self, role: str) -> bool:
        """Return whether a process that the campaign started has ended."""
        process = self._parts.get(role)
        return process is None or not process.pid or _stat(process.pid)[0] == "Z"

    async def wait(self, role: str) -> str:
        """Wait for the end of a process that the campaign started, and return its exit code and last line."""
        try:
            async with asyncio.timeout(END_LIMIT):
                code = await self._parts[role].wait()
        except TimeoutError:
            return "it has not ended"
        return str(self._parts[role].failure(code)) if code else "exit code 0"

    async def forget_run(self) -> None:
        """Wait until the children of a killed master have ended."""
        left = set(self._topology.roles) - {*self._topology.own_parts, BOARDS_PARENT}
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(END_LIMIT):
                while left:
                    left = {role for role in left if await self.status(role) is not None}
                    await asyncio.sleep(0.05)

    async def pid(self, role: str) -> int:
        """Return the PID of a role's process; 0 if it cannot be found."""
        if role in self._parts:
            return 0 if self.is_over(role) else self._parts[role].pid
        status = await self.status(BOARD_NAMES[0] if role == BOARDS_PARENT else role)
        pid = 0 if status is None else int(str(status["pid"]))
        return int(_stat(pid)[1]) if role == BOARDS_PARENT and pid else pid

    async def kill(self, role: str) -> bool:
        """Kill a role's process, and return whether it was found."""
        return _signal(await self.pid(role), signal.SIGKILL)

    @contextlib.asynccontextmanager
    async def paused(self, role: str) -> AsyncIterator[None]:
        """Stop a role's process within the context, if it is found."""
        pid = await self.pid(role)
        _signal(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            _signal(pid, signal.SIGCONT)

    async def status(self, role: str) -> dict[str, object] | None:
        """Return the status of a process; None if it does not answer."""
        return await process_status(f"{self._runs}/{role}.status.sock")

    async def counters(self) -> Counters | None:
        """Return the master's counters; None if it does not answer."""
        frames = (await self.status("master") or {}).get("frames")
        return Counters(frames["completed"], frames["lost"]) if isinstance(frames, dict) else None

    async def resources(self) -> dict[tuple[str, int], tuple[int, int]]:
        """Return the resident memory in KiB and the open descriptors of each process, by role and PID."""
        found = {}
        for role in self._topology.roles:
            if pid := await self.pid(role):
                with contextlib.suppress(OSError):
                    found[role, pid] = used_by(pid)[1:]
        return found

    def last_words(self) -> str:
        """Return the last lines of all logs, for a finding."""
        lines = []
        for log in sorted(self._folder.glob("*.log")):
            lines += [
                f"    | {log.stem}: {line}" for line in log.read_text(errors="replace").splitlines()[-4:]
            ]
        return "\n".join(lines)

    async def end(self) -> None:
        """End everything."""
        for role in reversed(self._topology.own_parts):
            if role in self._parts:
                with contextlib.suppress(ProcessLookupError):
                    await self._parts[role].end()
        for link in self.links.values():
            await link.end()


def used_by(pid: int) -> tuple[int, int, int]:
    """Return the bytes of a process's address space, its KiB in memory, and its number of descriptors.

    Raises an OSError if the process has ended.
    """
    pages = Path(f"/proc/{pid}/statm").read_text().split()
    size, resident = (int(each) * os.sysconf("SC_PAGE_SIZE") for each in pages[:2])
    return size, resident // 1024, len(list(Path(f"/proc/{pid}/fd").iterdir()))


def _stat(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat after the name: first the state, then the parent's id, then the others.

    If the process has ended, the fields are `Z` and `0`.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return ["Z", "0"]


def _signal(pid: int, number: signal.Signals) -> bool:
    with contextlib.suppress(ProcessLookupError):
        if pid:
            os.kill(pid, number)
            return True
    return False
