"""The stack under test in containers of the compose file, on the engine of scripts/container-engine."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from scripts.campaigning.stack import BOARD_TIMEOUT, BOARDS_PARENT, SERVICES, NotThereError, Stack, Topology
from scripts.running.patience import FACTOR
from scripts.running.processes import ROOT
from scripts.verifications.checks import DownloadError
from scripts.verifications.containers.project import copy_project, fetch_wheels, override

PROJECT: Final = "campaign"
VOLUMES: Final = ("status", "sockets", "boards")
"""Volumes of the compose file, each a small tmpfs."""
BUILD_LIMIT, COMMAND_LIMIT = 1800.0 * FACTOR, 180.0 * FACTOR
_PIECE: Final = bytes(1 << 14)


class EngineError(Exception):
    """A docker command that failed."""


async def docker(
    *arguments: str, limit: float = COMMAND_LIMIT, variables: Mapping[str, str] | None = None
) -> str:
    """Run a docker command in the project's folder, and return its output.

    Raises:
        EngineError: It fails or does not end in time.
    """
    process = await asyncio.create_subprocess_exec(
        "docker",
        *arguments,
        cwd=ROOT,
        env={**os.environ, **(variables or {})},
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(limit):
            output, errors = await process.communicate()
    except TimeoutError:
        process.kill()
        await process.wait()
        raise EngineError(f"docker {' '.join(arguments)} did not end within {limit:g} s") from None
    if process.returncode:
        raise EngineError(f"docker {' '.join(arguments)}: {errors.decode(errors='replace').strip()[-500:]}")
    return output.decode(errors="replace")


def build_image() -> None:
    """Build the image from a copy of this project, because builds on this engine have no network."""
    wheels = Path(os.environ["ROSBAYES_ENGINE_HOME"]) / "wheels"
    fetch_wheels(wheels)
    with tempfile.TemporaryDirectory() as folder:
        copy_project(Path(folder), wheels)
        asyncio.run(docker("compose", "--file", f"{folder}/compose.yaml", "build", limit=BUILD_LIMIT))


class ContainerStack(Stack):
    """A stack in containers; rosbridge is reached through a proxy, like a robot on another machine."""

    def __init__(self, folder: Path, deployment: Path, rng: random.Random) -> None:
        """Store an empty folder with a short path, and the deployment."""
        super().__init__(folder, Topology.CONTAINERS, deployment, rng)
        self.links["rosbridge"].host = "0.0.0.0"  # noqa: S104 - the engine's own network, which containers share
        override_file = folder / "compose.override.yaml"
        override_file.write_text(json.dumps(override(BOARD_TIMEOUT)))
        self._variables = {
            "COMPOSE_FILE": f"{ROOT / 'compose.yaml'}:{override_file}",
            "COMPOSE_PROJECT_NAME": PROJECT,
            "COMPOSE_PROFILES": "hub,boards",
            "HUB_PORT": str(self.hub_port),
            "ROSBRIDGE_URI": f"ws://host.docker.internal:{self.proxied_port}",
            "DEPLOYMENT": str(deployment),
            "BM_ROS_VERSION": "1",
        }

    @property
    def own_parts(self) -> tuple[str, ...]:
        """All containers, in order of their start."""
        return ("hub", BOARDS_PARENT, *SERVICES, "master")

    @property
    def roles(self) -> tuple[str, ...]:
        """The same."""
        return self.own_parts

    async def start(self, on_reading: Callable[[int], None]) -> None:
        """Start all containers.

        Raises:
            NotThereError: They do not start.
        """
        self.links["rosbridge"].on_reading = on_reading
        await self.links["rosbridge"].start()
        try:
            await self._compose("up", "--detach", "--quiet-pull")
        except EngineError as error:
            raise NotThereError(str(error)) from error
        self._runs.rmdir()
        self._runs.symlink_to(self._volume("status"))

    @staticmethod
    def _volume(name: str) -> Path:
        """Return the folder of a volume, which is mounted in the namespace of the engine alone."""
        home, pid = os.environ["ROSBAYES_ENGINE_HOME"], os.environ["ROSBAYES_ENGINE_PID"]
        return Path(f"/proc/{pid}/root{home}/data/volumes/{PROJECT}_{name}/_data")

    async def _compose(self, *arguments: str) -> str:
        return await docker("compose", *arguments, variables=self._variables)

    @staticmethod
    def _container(role: str) -> str:
        return f"{PROJECT}-{role}-1"

    async def start_part(self, role: str, misbehave: str = "") -> None:
        """Start a container that has ended."""
        assert not misbehave
        await docker("start", self._container(role))

    def is_over(self, _role: str) -> bool:
        """Return False, because the engine restarts a container whose process ends."""
        return False

    async def wait(self, role: str) -> str:
        """Wait for the end of a container, and return its exit code."""
        return f"exit code {(await docker('wait', self._container(role))).strip()}"

    async def forget_run(self) -> None:
        """Do nothing, because the other containers remain."""

    async def pid(self, _role: str) -> int:
        """Return 0: the PIDs in a container are not those of this machine."""
        return 0

    async def kill(self, role: str) -> bool:
        """Kill a container with `docker kill`, after which the engine does not restart it."""
        await docker("kill", self._container(role))
        return True

    async def stop_part(self, role: str) -> None:
        """End a container in an orderly way."""
        await docker("stop", self._container(role))

    @contextlib.asynccontextmanager
    async def paused(self, role: str) -> AsyncIterator[None]:
        """Freeze a container within the context."""
        await docker("pause", self._container(role))
        try:
            yield
        finally:
            await docker("unpause", self._container(role))

    @contextlib.asynccontextmanager
    async def cut_off(self, role: str) -> AsyncIterator[None]:
        """Take a container's network away within the context."""
        network = f"{PROJECT}_ros-outside"
        await docker("network", "disconnect", network, self._container(role))
        try:
            yield
        finally:
            await docker("network", "connect", "--alias", role, network, self._container(role))

    @contextlib.contextmanager
    def full(self) -> Iterator[None]:
        """Fill the run directory and the folders of sockets, each on a tmpfs, within the context."""
        fillers = [self._volume(name) / "filler" for name in VOLUMES]
        try:
            for filler in fillers:
                with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
                    while file.write(_PIECE):
                        pass
            yield
        finally:
            for filler in fillers:
                filler.unlink(missing_ok=True)

    def last_words(self) -> str:
        """Return the last lines of all logs, for a finding."""
        command = ["docker", "compose", "logs", "--no-color", "--tail", "4"]
        return subprocess.run(
            command,
            cwd=ROOT,
            env=os.environ | self._variables,
            stdout=subprocess.PIPE,
            text=True,
            timeout=COMMAND_LIMIT,
            check=False,
        ).stdout

    async def end(self) -> None:
        """Remove the project."""
        await self._compose("down", "--volumes", "--remove-orphans", "--timeout", "5")
        for link in self.links.values():
            await link.end()


if __name__ == "__main__":
    try:
        build_image()
    except DownloadError as error:
        print(f"error: a download failed: {error}", file=sys.stderr)
        sys.exit(3)
