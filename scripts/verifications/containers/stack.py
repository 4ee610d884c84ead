"""The compose project on its own container engine, with a client, for scripts/verify containers."""

from __future__ import annotations

import contextlib
import json
import os
import re
import statistics
import subprocess
import threading
import time
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Self

from scripts.running.patience import FACTOR
from scripts.running.processes import ROOT
from scripts.verifications.checks import CheckError, DownloadError, expect

OUT: Final = ROOT / "out" / "verify-containers"
ENGINE: Final = ROOT / "scripts" / "container-engine"
CLIENT: Final = Path(__file__).resolve().with_name("client.py")

UP_LIMIT, FLOW_LIMIT, COMMAND_LIMIT = 300.0 * FACTOR, 180.0 * FACTOR, 120.0 * FACTOR
"""Seconds until all services are healthy, until results arrive, and for a docker command; generous, not judged."""
MEAN_TV, LARGEST_TV = 0.06, 0.25
"""Limits of results' total variation to float64 fusion: 0.04 is the mean at a target count of 255."""
MAX_CYCLES: Final = 1 << 17
"""Cycle limit; a frame that ends there has too few counts for a bound, because its readings are unlikely."""
DOWNLOAD_FAILED: Final = 3
"""Exit code of scripts/container-engine, and of a verification, after a failed download."""
KILLED: Final = 137
"""Exit code after SIGKILL."""
RESULTS_AGAIN: Final = 5
"""Number of consecutive results that show a recovery."""

CORE: Final = ("master", "subscriber", "publisher", "pcie-app")
BOARDS: Final = ("board0", "board1", "board2", "board3")
"""Processes of the container `boards` with the boat's deployment."""
BOAT: Final = ("hub", "boat-simulator", "boat-normaliser", "boat-viewer")
VIEWER: Final = ("viewer",)
SERVICES: Final = (*CORE, "boards", *BOAT, *VIEWER)
CHECK: Final = "check"
"""The container that ends before all others start."""


class Engine:
    """scripts/container-engine, which runs within the context and ends with this process in any case."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self.environment: dict[str, str] = {}
        self.home = Path()

    def __enter__(self) -> Self:
        # the engine runs for as long as this process holds the other end of its standard input
        self._process = subprocess.Popen(
            [str(ENGINE), "run", "sh", "-c", "env && echo up && cat"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line == "up\n":
                break
            name, _, value = line.rstrip("\n").partition("=")
            if name in {"DOCKER_HOST", "DOCKER_CONFIG", "PATH", "ROSBAYES_ENGINE_HOME"}:
                self.environment[name] = value
        else:
            code = self._process.wait(COMMAND_LIMIT)
            if code == DOWNLOAD_FAILED:
                raise DownloadError("the container engine could not be downloaded; the reason is above")
            raise CheckError(f"scripts/container-engine ended with exit code {code}; its output is above")
        self.home = Path(self.environment["ROSBAYES_ENGINE_HOME"])
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is None:
            return
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(COMMAND_LIMIT)
        except subprocess.TimeoutExpired:
            self._process.kill()  # everything that it started dies with it
            self._process.wait(COMMAND_LIMIT)

    def left_behind(self) -> list[str]:
        """Return processes, mounts and control groups that are left after a grace period."""
        deadline = time.time() + 30 * FACTOR
        while (left := self._left()) and time.time() < deadline:
            time.sleep(0.25)
        return left

    def _left(self) -> list[str]:
        left = []
        for each in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if (
                    each.name.isdigit()
                    and str(self.home / "engine").encode() in (each / "cmdline").read_bytes()
                ):
                    left.append(f"process {each.name}")
        mounts = Path("/proc/mounts").read_text().splitlines()
        left += [f"mount {line.split()[1]}" for line in mounts if str(self.home) in line]
        for root, folders, _ in os.walk("/sys/fs/cgroup"):
            left += [f"control group {root}/{name}" for name in folders if name == "rosbayes-engine"]
        return left


@dataclass(slots=True)
class Result:
    """One line of the client: a result's arrival (Unix time, s) and its distance from float64 fusion."""

    at: float
    cycles: int
    tv: float | None
    wrong: str

    @classmethod
    def of(cls, fields: dict[str, Any]) -> Self:
        """Parse a line."""
        return cls(fields["at"], fields["cycles"], fields.get("tv"), fields.get("wrong", ""))


class Client:
    """client.py in a container that runs until the context ends."""

    def __init__(self, stack: Stack, uri: str, network: str, *flags: str) -> None:
        self._stack = stack
        self._name = "verify-client"
        self._command = [*stack.client_command(network, "--name", self._name), uri, *flags]
        self._process: subprocess.Popen[str] | None = None
        self.results: list[Result] = []
        self._news = threading.Condition()
        self._log = (OUT / "client.log").open("a", buffering=1)

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(
            self._command,
            env=self._stack.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            start_new_session=True,
        )
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.terminate()  # which docker passes on, even to a container that is only about to start
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(COMMAND_LIMIT)
            self._process.kill()
            self._process.wait(COMMAND_LIMIT)
        self._stack.docker("rm", "--force", self._name, check=False)
        self._log.close()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            fields = json.loads(line)
            self._log.write(line)
            if "at" in fields:
                with self._news:
                    self.results.append(Result.of(fields))
                    self._news.notify_all()

    def flowing(self, after: float, count: int = RESULTS_AGAIN, limit: float = FLOW_LIMIT) -> float:
        """Wait for `count` correct results after a time, and return the arrival of the first.

        Raises:
            CheckError: They do not arrive in time, or one is wrong.
        """
        with self._news:
            came = self._news.wait_for(lambda: len(self._after(after)) >= count, limit)
        results = self._after(after)
        if not came:
            last = (
                f"the last one came {after - self.results[-1].at:.1f} s before"
                if self.results
                else "none ever came"
            )
            raise CheckError(
                f"{len(results)} of {count} results came within {limit:g} s; {last if not results else ''}"
            )
        check_results(results)
        return results[0].at

    def silent(self, seconds: float, limit: float) -> None:
        """Wait until no result has arrived for a while.

        Raises:
            CheckError: Results continue to arrive.
        """
        deadline = time.time() + limit
        while self.results and time.time() - self.results[-1].at < seconds:
            expect(time.time() < deadline, f"results still come after {limit:g} s")
            time.sleep(0.1)

    def _after(self, after: float) -> list[Result]:
        return [each for each in self.results if each.at > after]


def check_results(results: list[Result]) -> str:
    """Check that results equal float64 fusion except for the machine's randomness, and describe them.

    Raises:
        CheckError: They differ.
    """
    wrong = [each.wrong for each in results if each.wrong]
    # a client that has just connected may have missed the reading of a result
    others = [each for each in wrong if each != "no reading has its stamp"]
    expect(not others, f"a result is wrong: {others[:1]}")
    expect(len(wrong) <= len(results) / 2, "most results have no reading")
    variations = [each.tv for each in results if each.tv is not None and each.cycles < MAX_CYCLES]
    if not variations:
        return "only frames that ran out of cycles"
    mean, largest = statistics.fmean(variations), max(variations)
    expect(largest <= LARGEST_TV, f"a result's total variation to float64 fusion is {largest:.3f}")
    expect(
        mean <= MEAN_TV or len(variations) < 20,
        f"results' mean total variation to float64 fusion is {mean:.3f}",
    )
    ran_out = sum(each.cycles >= MAX_CYCLES for each in results)
    return (
        f"{len(variations)} results, total variation to float64 fusion {mean:.3f} on average, {largest:.3f} at most"
        + (f"; {ran_out} that ran out of cycles" if ran_out else "")
    )


class Stack:
    """The compose project, and docker commands for it."""

    def __init__(self, engine: Engine, project: Path, only: str) -> None:
        self.only = only
        self.engine = engine
        self.project = project
        self.variables: dict[str, str] = {}
        self.notes: list[str] = []

    @property
    def environment(self) -> dict[str, str]:
        """The environment of docker commands, with only the check's variables of the compose file."""
        kept = {name: os.environ[name] for name in ("HOME", "LANG", "TMPDIR") if name in os.environ}
        extra = {"COMPOSE_ANSI": "never", "COMPOSE_PROGRESS": "plain", "BUILDKIT_PROGRESS": "plain"}
        return kept | extra | self.engine.environment | self.variables

    def docker(
        self, *arguments: str, limit: float = COMMAND_LIMIT, check: bool = True, codes: Collection[int] = (0,)
    ) -> str:
        """Run docker and return its output.

        Raises:
            CheckError: It ends with another exit code than these, if they are checked, or not in time.
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
            output = (done.stderr.strip() or done.stdout.strip()).splitlines()[-8:]
            raise CheckError(
                f"{what} ended with exit code {done.returncode}:\n      " + "\n      ".join(output)
            )
        return done.stdout

    def compose(self, *arguments: str, limit: float = COMMAND_LIMIT) -> str:
        """Run docker compose."""
        return self.docker("compose", *arguments, limit=limit)

    def client_command(self, network: str, *options: str) -> list[str]:
        """Return the command that starts a client's container; its URI and flags follow."""
        volumes = ["--volume", f"{self.project / CLIENT.relative_to(ROOT)}:/client.py:ro"]
        safe = ["--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL", "--init"]  # noqa: S108 - the /tmp of the container
        return [
            "docker",
            "run",
            "--rm",
            *options,
            "--network",
            network,
            "--env",
            f"TEST_PATIENCE={FACTOR:g}",
            *safe,
            *volumes,
            "rosbayes",
            "python",
            "/client.py",
        ]

    def bits(self, count: int, *flags: str, folder: Path | None = None) -> list[Result]:
        """Return results that a client container recomputed exactly, with the deployment in a folder.

        Raises:
            CheckError: They do not arrive.
        """
        options: list[str] = []
        if folder is not None:
            options = [
                "--volume",
                f"{folder}:/deployment-given:ro",
                "--env",
                "BM_DEPLOYMENT=/deployment-given",
            ]
        command = self.client_command("rosbayes_ros", *options)[1:]
        lines = self.docker(
            *command, "ws://hub:9090", "--bits", str(count), *flags, limit=2 * FLOW_LIMIT
        ).splitlines()
        results = [Result.of(each) for each in map(json.loads, lines) if "at" in each]
        expect(len(results) == count, f"{len(results)} of {count} results came")
        return results

    def deployments(self) -> dict[str, str]:
        """Return the deployment hash of each service; empty for one that does not answer."""
        found = {each["name"]: each.get("deployment", "") for each in self.status().get("processes", [])}
        return {service: found.get(service, "") for service in CORE}

    def status(self) -> dict[str, Any]:
        """Return what `status` shows; its exit code is not 0 while a process is not ready."""
        output = self.docker("exec", self.container("master"), "status", "--json", check=False)
        status: dict[str, Any] = json.loads(output or "{}")
        return status

    def up(self, services: tuple[str, ...] = SERVICES) -> float:
        """Start the project, wait until all services are healthy, and return the seconds that this took.

        Raises:
            CheckError: A service does not become healthy, or the services are not the expected ones.
        """
        began = time.time()
        try:
            self.compose(
                "up", "--detach", "--wait", "--wait-timeout", str(int(UP_LIMIT)), limit=UP_LIMIT + 30
            )
        except CheckError as error:
            raise CheckError(f"{error}{self.last_words()}") from None
        took = time.time() - began
        running = set(self.states())
        expect(running == set(services), f"it runs {sorted(running)} instead of {sorted(services)}")
        return took

    def refused(self, *arguments: str) -> str:
        """Return the log of `docker compose up` of a stack that cannot start, with the engine's own error.

        Raises:
            CheckError: It starts, or a service runs or restarts afterwards.
        """
        try:
            self.compose("up", "--detach", *arguments)
        except CheckError as error:
            states = self.states()
            running = [name for name, state in states.items() if state["Status"] not in {"created", "exited"}]
            expect(not running, f"it still runs {running}")
            return f"{error}\n{self.compose('logs', '--no-color', CHECK)}"
        raise CheckError("it started")

    def last_words(self) -> str:
        """Return the last log lines of services that do not run or are unhealthy."""
        words = []
        for service, state in self.states().items():
            health = state.get("Health", {}).get("Status")
            if state["ExitCode"] or state["Restarting"] or health == "unhealthy":
                output = self.log(service, 0).strip().splitlines()[-2:]
                words.append(f"\n      {service}: {' '.join(output)}")
        return "".join(words)

    def down(self) -> None:
        """Remove the project."""
        self.variables.clear()
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", "5")

    def container(self, service: str) -> str:
        """Return the name of a service's container."""
        return f"rosbayes-{service}-1"

    def inspect(self, *services: str) -> list[dict[str, Any]]:
        """Return the engine's state of services' containers."""
        containers: list[dict[str, Any]] = json.loads(
            self.docker("inspect", *(self.container(each) for each in services))
        )
        return containers

    def phases(self, began: float) -> tuple[float, float]:
        """Return the seconds after which all containers were created, and the hub was started."""
        found = self.inspect(*SERVICES)
        created = max(seconds(each["Created"]) for each in found)
        return created - began, seconds(self.inspect("hub")[0]["State"]["StartedAt"]) - began

    def states(self) -> dict[str, dict[str, Any]]:
        """Return the states of the project's containers, by service."""
        ids = self.compose("ps", "--all", "--quiet").split()
        found = json.loads(self.docker("inspect", *ids)) if ids else []
        states = {each["Config"]["Labels"]["com.docker.compose.service"]: each["State"] for each in found}
        return {service: state for service, state in states.items() if service != CHECK}

    def healthy(self, limit: float = UP_LIMIT) -> None:
        """Wait until all services are healthy.

        Raises:
            CheckError: One does not become so in time.
        """
        deadline = time.time() + limit
        while True:
            states = self.states()
            ill = {
                name: state
                for name, state in states.items()
                if name not in VIEWER and state.get("Health", {}).get("Status") != "healthy"
            }
            if not ill:
                return
            if time.time() > deadline:
                name, state = next(iter(ill.items()))
                probes = state.get("Health", {}).get("Log") or [{"Output": "no probe"}]
                raise CheckError(f"{name} is not healthy after {limit:g} s: {probes[-1]['Output'].strip()}")
            time.sleep(0.25)

    def ready(self) -> None:
        """Poll every service until it is ready, instead of waiting for its next probe.

        Raises:
            CheckError: One does not become so in time.
        """
        deadline = time.time() + UP_LIMIT
        for service in self.states().keys() - set(VIEWER):
            process = "board0" if service == "boards" else service
            ask = ("exec", self.container(service), "python", "-m", "services.ready", process)
            while True:
                try:
                    self.docker(*ask)
                    break
                except CheckError:
                    if time.time() > deadline:
                        raise
                time.sleep(0.25)

    def signal(self, service: str, name: str) -> None:
        """Send a signal to the process inside; after `docker kill` the engine would not restart it."""
        # SIGKILL ends the container, and with it the shell, which may not have returned from its call yet
        self.docker("exec", self.container(service), "sh", "-c", f"kill -{name} -1", codes=(0, KILLED))

    def board_pid(self, board: str) -> int:
        """Return the PID of one board inside the container of all, as `status` shows it.

        Raises:
            CheckError: It does not show the board in time.
        """
        deadline = time.time() + FLOW_LIMIT
        while True:
            pids = {each["name"]: int(each["pid"]) for each in self.status().get("processes", [])}
            if board in pids:
                return pids[board]
            expect(time.time() < deadline, f"status does not show {board}")
            time.sleep(0.25)

    def signal_board(self, pid: int, name: str) -> None:
        """Send a signal to the process of one board."""
        self.docker("exec", self.container("boards"), "sh", "-c", f"kill -{name} {pid}")

    def log(self, service: str, since: float) -> str:
        """Return the log of a service, or of a container outside the project, since a time."""
        container = self.container(service) if service in {*SERVICES, CHECK} else service
        done = subprocess.run(
            ["docker", "logs", "--since", f"{since:.3f}", container],
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=COMMAND_LIMIT,
            check=False,
        )
        return done.stdout

    def restarted(self, service: str, before: int, since: float, limit: float = FLOW_LIMIT) -> float:
        """Wait until the engine has restarted a service, and return the time.

        Raises:
            CheckError: It does not restart it in time.
        """
        deadline = time.time() + limit
        while True:
            (container,) = self.inspect(service)
            state = container["State"]
            # the count rises before the start, and until then the times are those of the old container
            if (
                container["RestartCount"] > before
                and state["Running"]
                and not state["Restarting"]
                and seconds(state["StartedAt"]) > since
            ):
                return seconds(state["StartedAt"])
            expect(time.time() < deadline, f"{service} was not restarted within {limit:g} s")
            time.sleep(0.1)

    def restarts(self, service: str) -> int:
        """Return the number of times that the engine has restarted a service."""
        return int(self.inspect(service)[0]["RestartCount"])

    def save_logs(self, check: str) -> None:
        """Save all logs, as they are after a check, in the folder of results."""
        with contextlib.suppress(CheckError):
            logs = self.compose("logs", "--timestamps", "--no-color")
            (OUT / f"{re.sub(r'[^A-Za-z0-9]+', '-', check)}.log").write_text(logs)


def seconds(stamp: str) -> float:
    """Return the Unix time of an engine's time stamp, which has nanoseconds."""
    return datetime.fromisoformat(re.sub(r"(\.\d{1,6})\d*Z$", r"\1+00:00", stamp)).timestamp()
