"""The compose file on a container engine of its own: built, started, hurt and stopped: see scripts/verify.

The engine is scripts/container-engine's, so a bare Debian machine will do. What is built is a copy of this folder.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any, Final, Self

from processes import ROOT
from verify_rosbridge import CheckError, Tally, expect

OUT: Final = ROOT / "out" / "verify-containers"
ENGINE: Final = ROOT / "scripts" / "container-engine"
CLIENT: Final = ROOT / "scripts" / "verify_containers_client.py"

LIMIT: Final = 900
"""Seconds after which the verification gives up, whatever it waits for."""
INSTALL_LIMIT, BUILD_LIMIT, UP_LIMIT, FLOW_LIMIT = 300.0, 300.0, 90.0, 60.0
FIRST_RESULT: Final = 15.0
"""Seconds from `docker compose up` to the first result, at most."""
STOP_LIMIT: Final = 5
"""Seconds that a service has to end after SIGTERM; then the engine kills it (exit code 137)."""
TERMINATED: Final = 143
KILLED: Final = 137

MEAN_TV, LARGEST_TV = 0.06, 0.25
"""Of results, against float64 fusion: 0.04 on average at a target count of 255, and what no draw of a frame reaches."""
MAX_CYCLES: Final = 1 << 17
"""A frame that ends there has seen so unlikely readings that its counts are few: no bound holds for it."""
RESULTS_AGAIN: Final = 5
"""Results in a row after which they flow again."""

CORE: Final = ("master", "subscriber", "publisher", "pcie-app")
BOARDS: Final = ("board0", "board1", "board2", "board3")
BOAT: Final = ("hub", "boat-simulator", "boat-normaliser")
VIEWER: Final = ("boat-viewer",)
SERVICES: Final = (*CORE, *BOARDS, *BOAT, *VIEWER)
ROBOT_PORT, BOARD_PORT = 9191, 7100
BUILT, UP = "the image is built", "docker compose up"
ALWAYS: Final = (BUILT, UP)


class Engine:
    """scripts/container-engine, up while the context lasts; ends with this process, however that ends."""

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
            code = self._process.wait(60)
            raise CheckError(
                f"scripts/container-engine ended with exit code {code}; what it said stands above"
            )
        self.home = Path(self.environment["ROSBAYES_ENGINE_HOME"])
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is None:
            return
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()  # whatever it started dies with it
            self._process.wait(10)

    def left_behind(self) -> list[str]:
        """Processes, mounts and control groups that should have gone with it."""
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
    """One line of the client: when a result arrived (Unix time, s), and how far it is from float64."""

    at: float
    cycles: int
    tv: float | None
    wrong: str

    @classmethod
    def of(cls, told: dict[str, Any]) -> Self:
        """A line, read."""
        return cls(told["at"], told["cycles"], told.get("tv"), told.get("wrong", ""))


class Client:
    """verify_containers_client.py in a container that goes on until the context ends."""

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
                self._process.wait(10)
            self._process.kill()
            self._process.wait(10)
        self._stack.docker("rm", "--force", self._name, check=False)
        self._log.close()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            told = json.loads(line)
            self._log.write(line)
            if "at" in told:
                with self._news:
                    self.results.append(Result.of(told))
                    self._news.notify_all()

    def flowing(self, after: float, count: int = RESULTS_AGAIN, limit: float = FLOW_LIMIT) -> float:
        """Wait for so many right results that arrived after a time; gives when the first of them did.

        Raises:
            CheckError: they don't come in time, or one is wrong.
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
        """Wait until no result has come for a while.

        Raises:
            CheckError: they go on coming.
        """
        deadline = time.time() + limit
        while self.results and time.time() - self.results[-1].at < seconds:
            expect(time.time() < deadline, f"results still come after {limit:g} s")
            time.sleep(0.1)

    def _after(self, after: float) -> list[Result]:
        return [each for each in self.results if each.at > after]


def check_results(results: list[Result]) -> str:
    """Results are float64's but for the machine's own randomness; gives their figures in words.

    Raises:
        CheckError: they are not.
    """
    wrong = [each.wrong for each in results if each.wrong]
    # who has just connected, or connected again, may have missed a reading whose result it hears
    others = [each for each in wrong if each != "no reading has its stamp"]
    expect(not others, f"a result is wrong: {others[:1]}")
    expect(len(wrong) <= len(results) / 2, "of most results no reading was heard")
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
    """The compose project, and the docker commands to treat it with."""

    def __init__(self, engine: Engine, project: Path, only: str) -> None:
        self.only = only
        self.engine = engine
        self.project = project
        self.variables: dict[str, str] = {}
        self.notes: list[str] = []

    @property
    def environment(self) -> dict[str, str]:
        """Of docker's commands: the compose file's variables are those of the check, and no others."""
        kept = {name: os.environ[name] for name in ("HOME", "LANG", "TMPDIR") if name in os.environ}
        extra = {"COMPOSE_ANSI": "never", "COMPOSE_PROGRESS": "plain", "BUILDKIT_PROGRESS": "plain"}
        return kept | extra | self.engine.environment | self.variables

    def docker(self, *arguments: str, limit: float = 60, check: bool = True) -> str:
        """Run docker and give what it prints.

        Raises:
            CheckError: it fails, or does not end in time.
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
        if check and done.returncode:
            said = (done.stderr.strip() or done.stdout.strip()).splitlines()[-8:]
            raise CheckError(
                f"{what} ended with exit code {done.returncode}:\n      " + "\n      ".join(said)
            )
        return done.stdout

    def compose(self, *arguments: str, limit: float = 60) -> str:
        """Run docker compose."""
        return self.docker("compose", *arguments, limit=limit)

    def client_command(self, network: str, *options: str) -> list[str]:
        """How a client's container is started; its URI and flags follow."""
        volumes = ["--volume", f"{self.project / 'scripts' / CLIENT.name}:/client.py:ro"]
        safe = ["--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL", "--init"]  # noqa: S108 - the container's own
        return [
            "docker",
            "run",
            "--rm",
            *options,
            "--network",
            network,
            *safe,
            *volumes,
            "rosbayes",
            "python",
            "/client.py",
        ]

    def up(self, services: tuple[str, ...] = SERVICES) -> float:
        """Start it and wait until all of it is healthy; gives the seconds that it took.

        Raises:
            CheckError: it does not get healthy, or has other services than it should.
        """
        began = time.time()
        self.compose("up", "--detach", "--wait", "--wait-timeout", str(int(UP_LIMIT)), limit=UP_LIMIT + 30)
        took = time.time() - began
        running = set(self.states())
        expect(running == set(services), f"it runs {sorted(running)} instead of {sorted(services)}")
        return took

    def down(self) -> None:
        """Take it away."""
        self.variables.clear()
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", "5", limit=60)

    def container(self, service: str) -> str:
        """The name of a service's container."""
        return f"rosbayes-{service}-1"

    def inspect(self, *services: str) -> list[dict[str, Any]]:
        """What the engine says of services' containers."""
        told: list[dict[str, Any]] = json.loads(
            self.docker("inspect", *(self.container(each) for each in services))
        )
        return told

    def states(self) -> dict[str, dict[str, Any]]:
        """State of all the project's containers, by service."""
        ids = self.compose("ps", "--all", "--quiet").split()
        told = json.loads(self.docker("inspect", *ids)) if ids else []
        return {each["Config"]["Labels"]["com.docker.compose.service"]: each["State"] for each in told}

    def healthy(self, limit: float = UP_LIMIT) -> None:
        """Wait until all services are healthy.

        Raises:
            CheckError: one does not get so in time.
        """
        deadline = time.time() + limit
        while True:
            states = self.states()
            ill = {
                name: state
                for name, state in states.items()
                if state.get("Health", {}).get("Status") != "healthy"
            }
            if not ill:
                return
            if time.time() > deadline:
                name, state = next(iter(ill.items()))
                probes = state.get("Health", {}).get("Log") or [{"Output": "no probe"}]
                raise CheckError(f"{name} is not healthy after {limit:g} s: {probes[-1]['Output'].strip()}")
            time.sleep(0.25)

    def ready(self) -> None:
        """Ask every service at once, rather than wait for its next probe.

        Raises:
            CheckError: one is not ready.
        """
        for service in self.states():
            self.docker("exec", self.container(service), "python", "-m", "services.ready", service)

    def signal(self, service: str, name: str) -> None:
        """Send a signal to the process inside: `docker kill` would count as somebody's wish, and nothing be restarted."""
        self.docker("exec", self.container(service), "sh", "-c", f"kill -{name} -1")

    def log(self, service: str, since: float) -> str:
        """What a service, or a container outside the project, has said since a time."""
        container = self.container(service) if service in SERVICES else service
        done = subprocess.run(
            ["docker", "logs", "--since", f"{since:.3f}", container],
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=30,
            check=False,
        )
        return done.stdout

    def restarted(self, service: str, before: int, since: float, limit: float = 30) -> float:
        """Wait until the engine has started a service anew; gives when.

        Raises:
            CheckError: it does not.
        """
        deadline = time.time() + limit
        while True:
            (told,) = self.inspect(service)
            state = told["State"]
            # the count rises before the start, and until then the old one's times stand there
            if (
                told["RestartCount"] > before
                and state["Running"]
                and not state["Restarting"]
                and seconds(state["StartedAt"]) > since
            ):
                return seconds(state["StartedAt"])
            expect(time.time() < deadline, f"{service} was not restarted within {limit:g} s")
            time.sleep(0.1)

    def restarts(self, service: str) -> int:
        """How often the engine has restarted a service."""
        return int(self.inspect(service)[0]["RestartCount"])

    def save_logs(self, check: str) -> None:
        """Keep all logs in the folder of results, as they are after a check."""
        with contextlib.suppress(CheckError):
            logs = self.compose("logs", "--timestamps", "--no-color", limit=30)
            (OUT / f"{re.sub(r'[^A-Za-z0-9]+', '-', check)}.log").write_text(logs)


def seconds(stamp: str) -> float:
    """Unix time of the engine's way to write a time, which has nanoseconds."""
    return datetime.fromisoformat(re.sub(r"(\.\d{1,6})\d*Z$", r"\1+00:00", stamp)).timestamp()


# The checks


def check_build(stack: Stack) -> None:
    """The image is built of a copy of this folder, with the wheels of the lock file."""
    stack.compose("config", "--quiet")
    stack.compose("build", limit=BUILD_LIMIT)
    size = int(stack.docker("image", "inspect", "--format", "{{.Size}}", "rosbayes"))
    stack.notes.append(f"{size / 1e6:.0f} MB")


def check_up(stack: Stack) -> None:
    """From `docker compose up` to the first result, and to all services being healthy; the better of two times."""
    first = start(stack)
    if first > FIRST_RESULT:  # other load on the machine would be to blame
        stack.down()
        first = start(stack)
    expect(
        first <= FIRST_RESULT, f"the first result came after {first:.1f} s, {FIRST_RESULT:g} s are allowed"
    )


def start(stack: Stack) -> float:
    """Start the stack; gives the seconds until boat-viewer shows the first result."""
    began = time.time()
    took = stack.up()
    deadline = time.time() + FLOW_LIMIT
    line = re.compile(r"^(\S+Z) +\d+ ", re.MULTILINE)
    while not (found := line.search(stack.docker("logs", "--timestamps", stack.container("boat-viewer")))):
        expect(time.time() < deadline, "boat-viewer shows no result")
        time.sleep(0.1)
    first = seconds(found[1]) - began
    stack.notes.append(f"first result after {first:.1f} s, all healthy after {took:.1f} s")
    return first


def check_bits(stack: Stack) -> None:
    """A client container computes results anew: counts and posterior to the bit, and near float64."""
    count = 8
    command = stack.client_command("rosbayes_ros")[1:]
    lines = stack.docker(*command, "ws://hub:9090", "--bits", str(count), limit=120).splitlines()
    told = [json.loads(line) for line in lines]
    results = [Result.of(each) for each in told if "at" in each]
    expect(len(results) == count, f"{len(results)} of {count} results came")
    stack.notes.append(check_results(results))


def check_confined(stack: Stack) -> None:
    """Inside: no root, no capabilities, nothing to write to, no way out; outside: the hub's port on loopback only."""
    said = stack.docker("exec", stack.container("master"), "cat", "/proc/self/status")
    fields = dict(line.split(":\t", 1) for line in said.splitlines() if ":\t" in line)
    expect(fields["Uid"].split() == ["10001"] * 4, f"it runs as {fields['Uid']}")
    for name in ("CapEff", "CapPrm", "CapBnd"):
        expect(int(fields[name], 16) == 0, f"it has capabilities: {name} {fields[name]}")
    expect(fields["NoNewPrivs"] == "1", "it may gain privileges")
    expect(fields["Seccomp"] == "2", "its system calls are not filtered")
    for told in stack.inspect(*SERVICES):
        host = told["HostConfig"]
        expect(host["ReadonlyRootfs"], f"{told['Name']} may write to its root")
        expect(host["Memory"] > 0 and host["PidsLimit"] > 0, f"{told['Name']} has no limits")
        for ports in host["PortBindings"].values():
            expect({each["HostIp"] for each in ports} == {"127.0.0.1"}, f"{told['Name']} publishes {ports}")
    write = "touch /opt/rosbayes/x /deployment/x /run/x"
    out = "import socket; socket.create_connection(('172.17.0.1', 2375), 2)"
    for service in ("pcie-app", "subscriber", "board0", "boat-simulator"):
        done = stack.docker(
            "exec", stack.container(service), "sh", "-c", f"{write} 2>/dev/null || echo refused"
        )
        expect(done == "refused\n", f"{service} can write to its root")
        done = stack.docker(
            "exec",
            stack.container(service),
            "python",
            "-c",
            f"try:\n {out}\nexcept OSError as e: print(e.errno)",
        )
        expect(done == "101\n", f"{service} has a way out of its network: {done}")  # ENETUNREACH
    published = stack.docker("port", stack.container("hub")).strip()
    expect(published == "9090/tcp -> 127.0.0.1:9090", f"the hub is published at {published}")


def kill(service: str) -> Callable[[Stack, Client], None]:
    """A check that kills a service's process."""

    def check(stack: Stack, client: Client) -> None:
        before = stack.restarts(service)
        at = time.time()
        stack.signal(service, "KILL")
        again(stack, client, at, stack.restarted(service, before, at))

    return check


def again(stack: Stack, client: Client, hurt: float, back: float) -> None:
    """Results flow again, right ones, and all services are healthy; the times are noted."""
    first = client.flowing(back)
    stack.healthy()
    healthy = time.time() - hurt
    stack.ready()
    stack.notes.append(f"results again after {first - hurt:.1f} s, all healthy after {healthy:.1f} s")


def kill_mid_frame(stack: Stack, client: Client) -> None:
    """A board is held until a frame waits for it, and killed then: that frame is lost and said so."""
    before = stack.restarts("board1")
    stack.signal("board1", "STOP")
    client.silent(0.5, 20)
    at = time.time()
    stack.signal("board1", "KILL")
    back = stack.restarted("board1", before, at)
    again(stack, client, at, back)
    told = stack.log("master", at)
    expect("board 1" in told.lower(), f"the master says nothing of board 1: {told[-300:]}")


def cut_off(stack: Stack, client: Client) -> None:
    """A board loses its network with the link open, and gets it back."""
    cut = time.time()
    stack.docker("network", "disconnect", "rosbayes_boards", stack.container("board2"))
    client.silent(1.0, 20)
    deadline = time.time() + 30
    while "board 2" not in stack.log("master", cut).lower():
        expect(time.time() < deadline, "the master says nothing of board 2, which has no network any more")
        time.sleep(0.25)
    noticed = time.time()
    joined = time.time()
    stack.docker("network", "connect", "--alias", "board2", "rosbayes_boards", stack.container("board2"))
    again(stack, client, joined, joined)
    stack.notes.append(
        f"cut off; the master said so after {noticed - cut:.1f} s; the times are from joining it again"
    )


def check_stop(stack: Stack) -> None:
    """All services end by themselves within their time after SIGTERM."""
    began = time.time()
    stack.compose("stop", limit=60)
    took = time.time() - began
    codes = {name: state["ExitCode"] for name, state in stack.states().items()}
    wrong = {name: code for name, code in codes.items() if code != TERMINATED}
    expect(
        not wrong,
        f"exit codes other than {TERMINATED} (SIGTERM): {wrong}; {KILLED} had to be killed after {STOP_LIMIT} s",
    )
    stack.notes.append(f"{len(codes)} services ended within {took:.1f} s, all with exit code {TERMINATED}")


def check_faults(stack: Stack, tally: Tally) -> None:
    """Each service is killed, and a board cut off, while a client listens."""
    checks: list[tuple[str, Callable[[Stack, Client], None]]] = [
        (f"{service} killed", kill(service))
        for service in (*CORE, "board0", "boat-simulator", "boat-normaliser", "boat-viewer", "hub")
    ]
    checks += [
        ("a board killed mid-frame", kill_mid_frame),
        ("a board cut off its network and joined again", cut_off),
    ]
    with Client(stack, "ws://hub:9090", "rosbayes_ros") as client:
        began = time.time()
        run_check(stack, tally, "results flow to a client container", lambda: client.flowing(began, 20))
        for name, check in checks:
            run_check(stack, tally, name, lambda check=check: check(stack, client))  # type: ignore[misc]  # a default binds the loop's check
        run_check(
            stack,
            tally,
            "all results of these runs",
            lambda: stack.notes.append(check_results(client.results)),
        )


def check_another_deployment(stack: Stack, folder: Path) -> None:
    """DEPLOYMENT=DIR: `up` makes the running stack one of another model."""
    stack.up()
    stack.variables["DEPLOYMENT"] = str(folder)
    try:
        began = time.time()
        took = stack.up()
        with Client(stack, "ws://hub:9090", "rosbayes_ros", "--cells", "16", "16") as client:
            client.flowing(began, 20)
            stack.notes.append(f"healthy after {took:.1f} s; {check_results(client.results)}")
    except CheckError:
        stack.save_logs("DEPLOYMENT before down")
        raise
    finally:
        stack.down()


@contextlib.contextmanager
def containers(stack: Stack, commands: dict[str, list[str]]) -> Iterator[None]:
    """Containers outside the compose project, in the network of their machine."""
    try:
        for name, command in commands.items():
            stack.docker(
                "run", "--detach", "--init", "--name", name, "--network", "host", "rosbayes", *command
            )
        yield
    finally:
        stack.docker("rm", "--force", *commands, check=False)


def check_robot(stack: Stack) -> None:
    """ROSBRIDGE_URI and BM_BOARDS: a server and boards elsewhere; neither hub nor boat nor boards are started here."""
    here = f"ws://127.0.0.1:{ROBOT_PORT}"
    elsewhere = {
        "robot-hub": ["hub", "--host", "0.0.0.0", "--insecure", "--port", str(ROBOT_PORT)],  # noqa: S104 - the engine's own network
        "robot-normaliser": ["boat-normaliser", "--uri", here],
        "robot-simulator": ["boat-simulator", "--uri", here],
    }
    ports = range(BOARD_PORT, BOARD_PORT + 2 * len(BOARDS), 2)
    for index, port in enumerate(ports):
        elsewhere[f"far-board{index}"] = ["board", "--listen", f"tcp://0.0.0.0:{port}", "--index", str(index)]
    server, others = dict([*elsewhere.items()][:1]), dict([*elsewhere.items()][1:])
    with containers(stack, server):
        deadline = time.time() + 20
        while "listening" not in stack.log("robot-hub", 0):
            expect(time.time() < deadline, "the robot's hub does not listen")
            time.sleep(0.1)
        with containers(stack, others):
            began = time.time()
            stack.variables["ROSBRIDGE_URI"] = f"ws://host.docker.internal:{ROBOT_PORT}"
            stack.variables["BM_BOARDS"] = ",".join(f"tcp://host.docker.internal:{port}" for port in ports)
            try:
                took = stack.up((*CORE, *VIEWER))
                with Client(stack, here, "host") as client:
                    client.flowing(began, 20)
                    stack.notes.append(f"healthy after {took:.1f} s; {check_results(client.results)}")
            except CheckError:
                stack.save_logs("ROSBRIDGE_URI before down")
                raise
            finally:
                stack.down()


FAKE_PROCESSOR: Final = """
import llvmlite.binding as llvm
llvm.get_host_cpu_name = lambda: "goldmont-plus"
from machines.kernel import warm_up
warm_up()
"""


def check_processor(stack: Stack) -> None:
    """On a processor of another name, kernels come from the image; left to itself, numba would compile."""
    settings = ["--read-only", "--tmpfs", "/tmp", "--env", "NUMBA_DEBUG_CACHE=1"]  # noqa: S108 - the container's own
    program = ["python", "-c", FAKE_PROCESSOR]
    with_image = stack.docker("run", "--rm", *settings, "rosbayes", *program)
    loaded, saved = (len(re.findall(rf"\] data {word} ", with_image)) for word in ("loaded from", "saved to"))
    expect(
        loaded > 0 and saved == 0, f"{loaded} kernels were loaded and {saved} compiled:\n{with_image[-500:]}"
    )
    # the same with the image's own kernels, but not told which: shows that the check can fail
    untold = ["env", "--unset=NUMBA_CPU_NAME", "--unset=NUMBA_CPU_FEATURES", *program]
    compiled = stack.docker("run", "--rm", *settings, "rosbayes", *untold).count("] data saved to ")
    expect(
        compiled > 0, "numba compiles nothing although it is not told the baseline: this check shows nothing"
    )
    stack.notes.append(
        f"{loaded} kernels loaded, none compiled; without the baseline's name {compiled} compiled"
    )


# Preparing


def copy_project(folder: Path, wheels: Path) -> None:
    """What the image is built of: this folder as git sees it, and the wheels, since builds here have no network."""
    shutil.rmtree(folder, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        check=True,
        timeout=60,
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    shutil.copytree(wheels, folder / "wheelhouse")


def fetch_wheels(folder: Path) -> None:
    """The wheels of the lock file, hashes checked, for the image's Python.

    Raises:
        CheckError: pip can't get them.
    """
    lock = ROOT / "requirements.lock"
    made = folder / ".made"
    stamp = hashlib.sha256(lock.read_bytes()).hexdigest()
    if made.exists() and made.read_text() == stamp:
        return
    shutil.rmtree(folder, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    what = ["--require-hashes", "--no-deps", "--only-binary", ":all:", "--python-version", "3.11"]
    done = subprocess.run(
        [*pip, *what, "--dest", str(folder), "--requirement", str(lock)],
        stderr=subprocess.PIPE,
        text=True,
        timeout=INSTALL_LIMIT,
        check=False,
    )
    expect(done.returncode == 0, f"pip could not get the wheels of {lock.name}: {done.stderr.strip()[-500:]}")
    made.write_text(stamp)


def build_another(folder: Path) -> None:
    """A deployment of another model for DEPLOYMENT: the boat on 16 x 16 cells."""
    toolchain = [
        str(Path(sys.executable).with_name("toolchain")),
        "build",
        str(ROOT / "casestudies" / "boat"),
    ]
    source = ["--uri", "ws://hub:9090", "--topic", "/boat/sensors", "--type", "boat_msgs/Sensors"]
    subprocess.run(
        [
            *toolchain,
            "-o",
            str(folder),
            "--partitions",
            "4",
            *source,
            "--set",
            "width=16",
            "--set",
            "height=16",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        check=True,
        timeout=60,
    )


def run_check(stack: Stack, tally: Tally, name: str, check: Callable[[], object]) -> bool:
    """Run one check and print its line; whether it passed."""
    if stack.only not in name and name not in ALWAYS:
        return True
    started = time.monotonic()
    stack.notes.clear()
    why = None
    try:
        check()
    except (CheckError, subprocess.SubprocessError, OSError) as error:
        why = str(error)
        stack.save_logs(name)
    tally.tell(name, started, why, "\n".join(f"    {note}" for note in stack.notes))
    return why is None


def verify(only: str) -> int:
    """All checks, or those with a word in their names; the exit code."""
    OUT.mkdir(parents=True, exist_ok=True)
    for log in OUT.glob("*.log"):
        log.unlink()
    tally = Tally()
    began = time.monotonic()
    engine = Engine()
    with engine:
        print(f"the engine is up after {time.monotonic() - began:.1f} s", flush=True)
        wheels, project, another = engine.home / "wheels", OUT / "project", OUT / "deployment"
        fetch_wheels(wheels)
        copy_project(project, wheels)
        shutil.rmtree(another, ignore_errors=True)
        build_another(another)
        stack = Stack(engine, project, only)
        stack.docker("compose", "down", "--volumes", "--remove-orphans", check=False)
        try:
            if run_check(stack, tally, BUILT, lambda: check_build(stack)) and run_check(
                stack, tally, UP, lambda: check_up(stack)
            ):
                run_check(stack, tally, "a client container: results to the bit", lambda: check_bits(stack))
                run_check(stack, tally, "services are confined", lambda: check_confined(stack))
                check_faults(stack, tally)
                run_check(stack, tally, "docker compose stop", lambda: check_stop(stack))
                run_check(
                    stack, tally, "DEPLOYMENT=another", lambda: check_another_deployment(stack, another)
                )
                run_check(stack, tally, "ROSBRIDGE_URI and BM_BOARDS", lambda: check_robot(stack))
                run_check(stack, tally, "a processor of another name", lambda: check_processor(stack))
        finally:
            signal.alarm(0)
            stack.save_logs("last")
            stack.variables.clear()
            stack.docker("compose", "down", "--volumes", "--remove-orphans", check=False)
            shutil.rmtree(project, ignore_errors=True)
    left = engine.left_behind()
    tally.tell("nothing is left behind", time.monotonic(), ", ".join(left) or None)
    print(f"{time.monotonic() - began:.0f} s in all; logs are in {OUT.relative_to(ROOT)}")
    print(f"{tally.passed} passed, {tally.failed} failed")
    return 1 if tally.failed else 0


def main() -> int:
    """Say whether it can run here at all, then run it with an end to its patience."""
    parser = argparse.ArgumentParser(prog="scripts/verify containers", description=__doc__)
    parser.add_argument(
        "--only", default="", help="only the checks with this in their names, and what they need"
    )
    only = parser.parse_args().only
    able = subprocess.run([str(ENGINE), "able"], stderr=subprocess.PIPE, text=True, check=False, timeout=30)
    if able.returncode:
        must = os.environ.get("CI", "") == "true"
        print(able.stderr.strip(), file=sys.stderr)
        print(
            f"CONTAINERS WERE NOT VERIFIED: {'CI=true demands it' if must else 'run this on a machine that allows it'}"
        )
        print(f"0 passed, {int(must)} failed")
        return int(must)

    def give_up(_number: int, _frame: FrameType | None) -> None:
        raise CheckError(f"this did not end within {LIMIT} s")

    def end(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGALRM, give_up)
    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGHUP, end)
    signal.alarm(LIMIT)
    try:
        return verify(only)
    except CheckError as error:
        print(f"FAIL {error}")
        print("0 passed, 1 failed")
        return 1
    except KeyboardInterrupt:
        print("interrupted (Ctrl-C)", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
