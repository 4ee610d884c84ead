"""The compose project, on the container engine that scripts/container-engine starts for this process."""

import contextlib
import json
import os
import re
import subprocess
import time
from collections.abc import Callable, Collection, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from scripts.running.patience import FACTOR
from scripts.running.script import ROOT
from scripts.verifications.checks import CheckError, expect

OUT: Final = ROOT / "out" / "verify-containers"
CLIENT: Final = Path(__file__).resolve().with_name("client.py")
UP_LIMIT, FLOW_LIMIT, COMMAND_LIMIT = 300.0 * FACTOR, 180.0 * FACTOR, 120.0 * FACTOR
"""Time limits in seconds until all services are healthy, until an event, and for a docker command."""
KILLED: Final = 137
"""Exit code after SIGKILL."""
CORE: Final = ("master", "subscriber", "publisher", "pcie-app")
BOARDS: Final = ("board0", "board1", "board2", "board3")
"""Names of the processes in the container `boards` with the boat's deployment."""
BOAT: Final = ("hub", "boat-simulator", "boat-normaliser", "boat-viewer")
SERVICES: Final = (*CORE, "boards", *BOAT, "viewer", "dashboard")
CHECK: Final = "check"
"""The container that ends before all others start."""


def until(condition: Callable[[], object], otherwise: Callable[[], str], limit: float = FLOW_LIMIT) -> None:
    """Poll until a condition holds; raise a CheckError if it does not in time."""
    deadline = time.monotonic() + limit
    while not condition():
        if time.monotonic() > deadline:
            raise CheckError(f"{otherwise()} ({limit:g} s)")
        time.sleep(0.25)


class Stack:
    """The compose project, with methods that run docker commands.

    Attributes:
        project: Folder of compose.yaml.
        variables: Variables of compose.yaml that a check sets. The method `down` clears the variables.
    """

    def __init__(self, project: Path) -> None:
        self.project = project
        self.variables: dict[str, str] = {}

    @property
    def environment(self) -> dict[str, str]:
        """The environment of docker commands, without the user's other variables, which the compose file would read."""
        names = ("HOME", "LANG", "TMPDIR", "PATH", "DOCKER_HOST", "DOCKER_CONFIG")
        kept = {name: os.environ[name] for name in names if name in os.environ}
        extra = {"COMPOSE_ANSI": "never", "COMPOSE_PROGRESS": "plain", "BUILDKIT_PROGRESS": "plain"}
        return kept | extra | self.variables

    def docker(
        self,
        *arguments: str,
        limit: float = COMMAND_LIMIT,
        check: bool = True,
        codes: Collection[int] = (0,),
        streams: str = "output",
    ) -> str:
        """Run docker and return its output.

        Raises a CheckError if docker runs longer than `limit` seconds. If `check` is true, also raises a CheckError if
        docker's exit code is not in `codes`.
        """
        what = f"docker {' '.join(arguments[:3])}"
        with (OUT / "docker.log").open("a") as log:
            log.write(f"--- {datetime.now(UTC):%H:%M:%S} docker {' '.join(arguments)}\n")
            log.flush()
            try:
                done = subprocess.run(
                    ["docker", *arguments],
                    env=self.environment,
                    cwd=self.project,
                    stdin=subprocess.DEVNULL,
                    capture_output=True,
                    text=True,
                    timeout=limit,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                raise CheckError(f"{what} did not end within {limit:g} s") from None
            log.write(done.stderr)
        if check and done.returncode not in codes:
            output = (done.stdout + done.stderr).strip().splitlines()[-8:]
            raise CheckError(
                f"{what} ended with exit code {done.returncode}:\n      " + "\n      ".join(output)
            )
        return done.stdout + (done.stderr if streams == "both" else "")

    def compose(self, *arguments: str, limit: float = COMMAND_LIMIT) -> str:
        """Run docker compose."""
        return self.docker("compose", *arguments, limit=limit)

    def bits(self, count: int, uri: str = "ws://hub:9090", network: str = "rosbayes_ros") -> None:
        """Let a client container recompute results from now on; raise a CheckError if one is wrong or none arrive."""
        client = self.project / CLIENT.relative_to(ROOT)
        confined = ("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL", "--init")  # noqa: S108 - the container's
        self.docker(
            *("run", "--rm", "--network", network, "--env", f"TEST_PATIENCE={FACTOR:g}", *confined),
            *("--volume", f"{client}:/client.py:ro", "rosbayes", "python", "/client.py", uri, str(count)),
            limit=2 * FLOW_LIMIT,
        )

    def status(self) -> dict[str, Any]:
        """Return the output of the command `status --json`.

        The exit code of the command is ignored, because it is not 0 while a process is not ready.
        """
        output = self.docker("exec", self.container("master"), "status", "--json", check=False)
        status: dict[str, Any] = json.loads(output or "{}")
        return status

    def processes(self) -> dict[str, dict[str, Any]]:
        """Return the processes that `status` shows, by name."""
        return {each["name"]: each for each in self.status().get("processes", [])}

    def up(self, services: tuple[str, ...] = SERVICES) -> None:
        """Start the project and wait until its services are healthy.

        Raises a CheckError if a service does not become healthy, or if the running services are not `services`.
        """
        wait = ("--wait", "--wait-timeout", str(int(UP_LIMIT)))
        try:
            self.compose("up", "--detach", *wait, limit=UP_LIMIT + COMMAND_LIMIT)
        except CheckError as error:
            words = [
                f"\n      {service}: {self.log(service).strip().splitlines()[-2:]}"
                for service, state in self.states().items()
                if state["ExitCode"] or state.get("Health", {}).get("Status") == "unhealthy"
            ]
            raise CheckError(f"{error}{''.join(words)}") from None
        running = set(self.states())
        expect(running == set(services), f"it runs {sorted(running)} instead of {sorted(services)}")

    def refused(self, *arguments: str) -> str:
        """Return the log of `docker compose up` of a stack that cannot start; raise a CheckError if a service runs."""
        try:
            self.compose("up", "--detach", *arguments)
        except CheckError as error:
            running = [
                name for name, state in self.states().items() if state["Status"] not in {"created", "exited"}
            ]
            expect(not running, f"it still runs {running}")
            return f"{error}\n{self.compose('logs', '--no-color', CHECK)}"
        raise CheckError("it started")

    def down(self) -> None:
        """Remove the project."""
        self.variables.clear()
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", "5")

    @contextlib.contextmanager
    def cleared(self, **variables: str) -> Iterator[None]:
        """Remove the project and set variables. Remove the project again after the block.

        If the block fails, save the logs.
        """
        self.down()
        self.variables |= variables
        try:
            yield
        except Exception:
            self.save_logs("failed")
            raise
        finally:
            self.down()

    def container(self, service: str) -> str:
        """Return the name of a service's container."""
        return f"rosbayes-{service}-1"

    def inspect(self) -> dict[str, dict[str, Any]]:
        """Return the engine's view of the project's containers, by service."""
        ids = self.compose("ps", "--all", "--quiet").split()
        found = json.loads(self.docker("inspect", *ids)) if ids else []
        services = {each["Config"]["Labels"]["com.docker.compose.service"]: each for each in found}
        return {service: each for service, each in services.items() if service != CHECK}

    def states(self) -> dict[str, dict[str, Any]]:
        """Return the states of the project's containers, by service."""
        return {service: each["State"] for service, each in self.inspect().items()}

    def restarts(self) -> dict[str, int]:
        """Return how often the engine has restarted each service."""
        return {service: int(each["RestartCount"]) for service, each in self.inspect().items()}

    def kill(self, *services: str) -> None:
        """Kill the processes of services, and wait until the engine has restarted them."""
        before = self.restarts()
        for service in services:
            # after `docker kill` the engine would not restart it; this shell ends together with its process
            kill = ("sh", "-c", "kill -KILL -1")
            self.docker("exec", self.container(service), *kill, codes=(0, KILLED))

        def waited_for() -> list[str]:
            found, restarts = self.states(), self.restarts()
            is_new = {
                each: restarts[each] > before[each] and found[each]["Status"] == "running"
                for each in services
            }
            return [service for service in services if not is_new[service]]

        until(lambda: not waited_for(), lambda: f"{waited_for()} are not restarted")

    def signal(self, pid: int, name: str) -> None:
        """Send a signal to a process in the container `boards`, by the PID that `status` shows."""
        self.docker("exec", self.container("boards"), "sh", "-c", f"kill -{name} {pid}")

    def log(self, service: str, since: float = 0.0) -> str:
        """Return the log of a service since a time."""
        return self.docker("logs", "--since", f"{since:.3f}", self.container(service), streams="both")

    def save_logs(self, check: str) -> str:
        """Save all logs after a check, in the folder of results, and return where they are."""
        path = OUT / f"{re.sub(r'[^A-Za-z0-9]+', '-', check)}.log"
        with contextlib.suppress(CheckError):
            path.write_text(self.compose("logs", "--timestamps", "--no-color"))
        return f"    its logs are in {path.relative_to(ROOT)}"
