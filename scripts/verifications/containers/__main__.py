"""Verification of the compose file on a separate container engine (see scripts/verify).

scripts/container-engine provides the engine, so a bare Debian machine suffices. The image is built from a copy of
the project. After each fault, a client container recomputes results with the reference kernel.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR
from scripts.running.script import ROOT
from scripts.verifications.checks import CheckError, DownloadError, Tally, expect
from scripts.verifications.containers.project import STOP_GRACE, copy_project, fetch_wheels, home
from scripts.verifications.containers.stack import (
    BOARDS,
    COMMAND_LIMIT,
    CORE,
    KILLED,
    OUT,
    SERVICES,
    UP_LIMIT,
    Stack,
    until,
)
from toolchain.deployment import load_deployment

ENGINE: Final = ROOT / "scripts" / "container-engine"
BUILD_LIMIT = 900.0 * FACTOR
DOWNLOAD_FAILED, NOT_ABLE, TERMINATED = 3, 4, 143
"""Exit codes: two of this command, and one of a service.

This command exits with 3 after a failed download, and with 4 if the machine cannot run containers. A service exits
with 143 after SIGTERM.
"""
ROBOT_PORT, BOARD_PORT = 9191, 7100
MINE: Final = "build/mine"


# The checks of every commit


def check_build(stack: Stack) -> None:
    """Build the image from a copy of the project, with the wheels of the lock file."""
    stack.compose("config", "--quiet")
    stack.compose("build", limit=BUILD_LIMIT)


def check_up(stack: Stack) -> None:
    """Start the stack, and wait until all services are healthy and boat-viewer shows a result."""
    stack.up()
    line = re.compile(r"^ *\d+ ", re.MULTILINE)
    until(lambda: line.search(stack.log("boat-viewer")), lambda: "boat-viewer shows no result")


def check_bits(stack: Stack) -> None:
    """Check that a client in a container computes the stack's results again, bit for bit."""
    stack.bits(8)


def kill(*services: str) -> Callable[[Stack], None]:
    """Return a check that kills these services, and recomputes results after their restart."""

    def check(stack: Stack) -> None:
        stack.kill(*services)
        stack.bits(3)

    return check


def check_stop(stack: Stack) -> None:
    """Check that all services end by themselves after SIGTERM."""
    stack.compose("stop", limit=COMMAND_LIMIT + STOP_GRACE)
    codes = {name: state["ExitCode"] for name, state in stack.states().items()}
    # a machine on which limits are multiplied may be too slow for any grace period
    right = {TERMINATED, KILLED} if FACTOR > 1 else {TERMINATED}
    wrong = {name: code for name, code in codes.items() if code not in right}
    expect(not wrong, f"exit codes other than {TERMINATED} (SIGTERM): {wrong}; {KILLED} had to be killed")


# The others


def check_confined(stack: Stack) -> None:
    """Check that containers have no root, capabilities, writable files, external network or open ports."""
    output = stack.docker("exec", stack.container("master"), "cat", "/proc/self/status")
    fields = dict(line.split(":\t", 1) for line in output.splitlines() if ":\t" in line)
    expect(fields["Uid"].split() == ["10001"] * 4, f"it runs as {fields['Uid']}")
    for name in ("CapEff", "CapPrm", "CapBnd"):
        expect(int(fields[name], 16) == 0, f"it has capabilities: {name} {fields[name]}")
    expect(fields["NoNewPrivs"] == "1", "it may gain privileges")
    expect(fields["Seccomp"] == "2", "its system calls are not filtered")
    for name, container in stack.inspect().items():
        host = container["HostConfig"]
        expect(host["ReadonlyRootfs"], f"{name} may write to its root")
        expect(host["Memory"] > 0 and host["PidsLimit"] > 0, f"{name} has no limits")
        ports = host["PortBindings"]
        expect(not ports or name in {"hub", "dashboard"}, f"{name} publishes {ports}")
    for name, port in (("hub", 9090), ("dashboard", 8080)):
        published = stack.docker("port", stack.container(name)).strip()
        expect(published == f"{port}/tcp -> 127.0.0.1:{port}", f"{name} is published at {published}")
    out = "import socket\ntry: socket.create_connection(('172.17.0.1', 2375), 2)\nexcept OSError as e: print(e.errno)"
    for service in ("pcie-app", "subscriber", "boards", "boat-simulator"):
        inside = ("exec", stack.container(service))
        write = "touch /opt/rosbayes/x /deployment/x /run/x 2>/dev/null || echo refused"
        expect(stack.docker(*inside, "sh", "-c", write) == "refused\n", f"{service} can write to its root")
        done = stack.docker(*inside, "python", "-c", out)
        expect(done == "101\n", f"{service} has a way out of its network: {done}")  # ENETUNREACH


def check_status(stack: Stack) -> None:
    """Check that `status` shows the whole stack as ready, and the name of the project, which distinguishes stacks."""
    expected = {*SERVICES, *BOARDS} - {"boards", "viewer"}

    def shown() -> bool:
        status = stack.status()
        names = {each["name"] for each in status.get("processes", [])}
        return names == expected and status["ready"] and str(status["directory"]).endswith("/rosbayes")

    until(shown, lambda: f"it shows {stack.status()}")


def check_silent_board(stack: Stack) -> None:
    """Suspend a board's process, as if it lost power, and resume it. Then suspend the process again and kill it."""

    def silent(then: str) -> None:
        until(lambda: "board2" in stack.processes(), lambda: "status does not show board2")
        pid, stopped = int(stack.processes()["board2"]["pid"]), time.time()
        stack.signal(pid, "STOP")
        until(
            lambda: "board 2" in stack.log("master", stopped).lower(),
            lambda: "the master says nothing of board 2, which does not answer any more",
        )
        stack.signal(pid, then)
        stack.bits(3)

    silent("CONT")
    silent("KILL")
    expect(not stack.restarts()["boards"], "the container of all boards was restarted")


def check_lost_network(stack: Stack) -> None:
    """Disconnect the network of subscriber and publisher during connections, as when a robot drives out of range."""
    lost = ("subscriber", "publisher")
    for service in lost:
        stack.docker("network", "disconnect", "rosbayes_ros", stack.container(service))
    until(lambda: not stack.status().get("ready"), lambda: "status shows a stack without network as ready")
    for service in lost:
        stack.docker("network", "connect", "--alias", service, "rosbayes_ros", stack.container(service))
    stack.bits(3)


def check_healthy(stack: Stack) -> None:
    """Check that all services become healthy after the faults."""

    def ill() -> list[str]:
        states = stack.states().items()
        return [
            name for name, state in states if state.get("Health", {}).get("Status", "healthy") != "healthy"
        ]

    until(lambda: not ill(), lambda: f"{ill()} are not healthy", UP_LIMIT)


@contextlib.contextmanager
def containers(stack: Stack, commands: dict[str, list[str]], *options: str) -> Iterator[None]:
    """Run containers outside the compose project, with the network of the host."""
    stack.docker("rm", "--force", *commands, check=False)  # those of a run that was ended
    try:
        for name, command in commands.items():
            run = ("run", "--detach", "--init", "--name", name, "--network", "host", *options, "rosbayes")
            stack.docker(*run, *command)
        yield
    finally:
        stack.docker("rm", "--force", *commands, check=False)


@contextlib.contextmanager
def robot(stack: Stack) -> Iterator[None]:
    """Run a boat with a rosbridge server outside the project, as on another machine."""
    here = f"ws://127.0.0.1:{ROBOT_PORT}"
    server = ["hub", "--host", "0.0.0.0", "--insecure", "--port", str(ROBOT_PORT)]  # noqa: S104 - the engine's own network
    boat = {f"robot-{part}": [f"boat-{part}", "--uri", here] for part in ("normaliser", "simulator")}
    with containers(stack, {"robot-hub": server, **boat}, "--env", "BM_CONNECT_TIMEOUT=600"):
        yield


def check_robot(stack: Stack) -> None:
    """Check ROSBRIDGE_URI and BM_BOARDS: with a server and boards elsewhere, none are started here."""
    ports = [BOARD_PORT + 2 * index for index in range(len(BOARDS))]
    boards = {
        f"far-board{at}": ["board", "--listen", f"tcp://0.0.0.0:{port}", "--insecure", "--index", str(at)]
        for at, port in enumerate(ports)
    }
    variables = {
        "ROSBRIDGE_URI": f"ws://host.docker.internal:{ROBOT_PORT}",
        "BM_BOARDS": ",".join(f"tcp://host.docker.internal:{port}" for port in ports),
    }
    with robot(stack), containers(stack, boards), stack.cleared(**variables):
        stack.up((*CORE, "viewer", "dashboard"))
        stack.bits(3, f"ws://127.0.0.1:{ROBOT_PORT}", "host")


def check_absent_robot(stack: Stack) -> None:
    """Check that a stack reports that it waits for a robot, and computes results after the robot has appeared."""
    uri = f"ws://host.docker.internal:{ROBOT_PORT}"
    with stack.cleared(ROSBRIDGE_URI=uri):
        stack.compose("up", "--detach")
        until(
            lambda: uri in " ".join(stack.status().get("why", [])),
            lambda: f"status does not name the robot: {stack.status()}",
        )
        with robot(stack):
            stack.bits(3, f"ws://127.0.0.1:{ROBOT_PORT}", "host")
        expect(not any(stack.restarts().values()), f"containers were restarted: {stack.restarts()}")


def check_own_model(stack: Stack) -> None:
    """Check a user's model with readings from another container, first built as a BM1, then as a BM2."""
    topic = ("--topic", "/mine/readings", "--type", "std_msgs/Float64MultiArray")
    source = ("--uri", "ws://127.0.0.1:9090", *topic)

    def toolchain(*arguments: str) -> None:
        command = [str(Path(sys.executable).with_name("toolchain")), *arguments]
        subprocess.run(command, cwd=stack.project, capture_output=True, check=True, timeout=COMMAND_LIMIT)

    def runs(boards: int) -> None:
        """Wait until the stack runs the deployment in the folder on this number of boards, and the viewer shows it."""
        since, wanted = time.time(), load_deployment(stack.project / MINE, images=False).hash

        def of_deployment() -> bool:
            found = stack.processes()
            running = {found.get(service, {}).get("deployment") for service in CORE}
            return running == {wanted} and len(found.keys() & {*BOARDS}) == boards

        until(of_deployment, lambda: f"status shows {stack.status()}")
        until(
            lambda: " x " in stack.log("viewer", since), lambda: f"the viewer shows {stack.log('viewer')!r}"
        )

    (stack.project / "models").mkdir(exist_ok=True)
    toolchain("new", "models/mine")
    toolchain("build", "models/mine", "-o", MINE, *source)
    program = f"{stack.project}/models/mine/robot.py:/robot.py:ro"
    with stack.cleared(DEPLOYMENT=MINE):
        stack.compose("up", "--detach")
        expect(
            set(stack.states()) == {*CORE, "boards", "hub", "viewer", "dashboard"},
            f"it runs {[*stack.states()]}",
        )
        with containers(stack, {"my-robot": ["python", "/robot.py"]}, "--volume", program):
            runs(boards=1)
            drawn = stack.compose("exec", "--no-TTY", "viewer", "listen", "--plot", "--count", "1")
            expect("###" in drawn, f"listen --plot draws {drawn}")
            toolchain("build", "models/mine", "-o", MINE, "--machine", "bm2", "--partitions", "2", *source)
            stack.compose("restart", limit=COMMAND_LIMIT + STOP_GRACE)
            runs(boards=2)


def check_hub_alone(stack: Stack) -> None:
    """Check `docker compose up hub`, and that a second stack with the same port starts nothing."""
    with stack.cleared():
        stack.compose("up", "--detach", "--wait", "hub")
        expect(set(stack.states()) == {"hub"}, f"it runs {[*stack.states()]}")
        stack.variables["COMPOSE_PROJECT_NAME"] = "second"
        try:
            expect("9090" in (said := stack.refused()), f"it does not name the port: {said}")
        finally:
            stack.compose("down", "--volumes", "--remove-orphans")


ON_CLUSTER: Final = """
set -e; cd /tmp
{ echo D1,D2,D3,B1,B2,B3; for row in $(seq 99); do echo $row,43,50,58,20,106; done; } >recording.csv
run() {
    toolchain infer recording.csv -d /deployment -o $1.npz $2
    toolchain explore boat -o $1.jsonl --frames 2 --prob-bits 6,8 --targets 15,31 --rngs lfsr16 $2
}
run serial; run cluster "--scheduler tcp://127.0.0.1:8786"
cmp serial.npz cluster.npz; cmp serial.jsonl cluster.jsonl
python -c "from urllib.request import urlopen; print(urlopen('http://127.0.0.1:8787/status').read())"
"""
"""Script that computes a recording and a sweep in one process and on the cluster, and prints a page from dask.

The script fails if the cluster's files differ from those of one process.
"""


def check_cluster(stack: Stack) -> None:
    """Check that the profile `cluster` starts only dask, and that dask and a single process write equal files."""
    with stack.cleared():
        try:
            stack.compose("--profile", "cluster", "up", "--detach", limit=UP_LIMIT)
            running = stack.compose("--profile", "cluster", "ps", "--services").split()
            expect(set(running) == {"cluster-scheduler", "cluster-worker"}, f"it runs {running}")
            until(
                lambda: stack.log("cluster-scheduler").count("Register worker") == 3,
                lambda: f"3 workers are not there: {stack.log('cluster-scheduler')}",
            )
            host = ("run", "--rm", "--network", "host", "--read-only", "--tmpfs", "/tmp")  # noqa: S108 - the container's
            said = stack.docker(*host, "rosbayes", "sh", "-c", ON_CLUSTER, limit=UP_LIMIT)
            expect("Dask" in said, f"its page does not name Dask: {said}")
        finally:
            stack.compose("--profile", "cluster", "down")


def check_refused(stack: Stack) -> None:
    """Check that a start that cannot succeed ends with a reason that names the user's input."""
    broken = stack.project / "build" / "broken"
    broken.mkdir(parents=True, exist_ok=True)
    (broken / "deployment.toml").write_text("format = 1\n")
    for variables, reason in (
        ({"DEPLOYMENT": "build/mien"}, "build/mien"),
        ({"DEPLOYMENT": "build/broken"}, "error: build/broken"),
        ({"BM_BOARDS": "tcp://far:7000"}, "error: --boards"),
        ({"ROSBRIDGE_URI": "http://far"}, "http://far"),
    ):
        with stack.cleared(**variables):
            said = stack.refused()
            expect(reason in said, f"with {variables} it says: {said}")


def check_processor(stack: Stack) -> None:
    """Check that a processor with another name loads the kernels from the image instead of compiling them."""
    settings = ("--read-only", "--tmpfs", "/tmp", "--env", "NUMBA_DEBUG_CACHE=1")  # noqa: S108 - the container's
    program = (
        "import llvmlite.binding as llvm; llvm.get_host_cpu_name = lambda: 'goldmont-plus'\n"
        "from machines import warm_up; warm_up()"
    )
    # the second time without the variables that name the processor of the image's kernels, to show that the check can
    # fail
    for words in ([], ["env", "--unset=NUMBA_CPU_NAME", "--unset=NUMBA_CPU_FEATURES"]):
        said = stack.docker("run", "--rm", *settings, "rosbayes", *words, "python", "-c", program)
        loaded, compiled = (said.count(f"] data {word} ") for word in ("loaded from", "saved to"))
        right = compiled > 0 if words else loaded > 0 and compiled == 0
        expect(right, f"{loaded} kernels were loaded and {compiled} compiled:\n{said[-500:]}")


Check = Callable[[Stack], None]
SHORT: tuple[tuple[str, Check], ...] = (
    ("the image is built", check_build),
    ("docker compose up", check_up),
    ("a client container: results to the bit", check_bits),
    ("pcie-app killed: results to the bit again", kill("pcie-app")),
    ("docker compose stop", check_stop),
)
"""The checks of every commit; each is needed by the next one."""
FULL: tuple[tuple[str, Check], ...] = (
    *SHORT[:3],
    ("services are confined", check_confined),
    ("status shows all services", check_status),
    ("a silent board", check_silent_board),
    ("subscriber and publisher without network", check_lost_network),
    *((f"{each} killed", kill(each)) for each in SERVICES if each != "viewer"),
    ("all services killed", kill(*SERVICES)),
    ("all services healthy again", check_healthy),
    SHORT[-1],
    ("ROSBRIDGE_URI and BM_BOARDS", check_robot),
    ("an absent robot that appears", check_absent_robot),
    ("a user's model", check_own_model),
    ("the hub alone", check_hub_alone),
    ("a cluster alone", check_cluster),
    ("starts that cannot succeed", check_refused),
    ("a processor of another name", check_processor),
)


def verify(only: str, *, short: bool) -> int:
    """Run all checks, or those whose names contain a word of `only`, and return the exit code."""
    OUT.mkdir(parents=True, exist_ok=True)
    for log in OUT.glob("*.log"):
        log.unlink()
    tally, stack = Tally(), Stack(OUT / "project")
    fetch_wheels()
    copy_project(stack.project)
    stack.docker("compose", "down", "--volumes", "--remove-orphans", check=False)
    try:
        for name, check in SHORT if short else FULL:
            needed = name in {name for name, _ in SHORT[:2]}
            if not needed and only not in name:
                continue
            failed = tally.failed
            with tally.check(
                name, subprocess.SubprocessError, OSError, details=partial(stack.save_logs, name)
            ):
                check(stack)
            if tally.failed > failed and (needed or short):
                break
    finally:
        stack.save_logs("last")
        stack.variables.clear()
        stack.docker("compose", "down", "--volumes", "--remove-orphans", check=False)
        # the cache makes the next build faster, but would fill the disk over many runs
        stack.docker("image", "prune", "--force", check=False)
        stack.docker("builder", "prune", "--force", "--keep-storage", "2GB", check=False)
        shutil.rmtree(stack.project, ignore_errors=True)
    return tally.end()


def left_behind() -> list[str]:
    """Return processes, mounts and control groups that the engine has left."""
    left = []
    for each in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if each.name.isdigit() and str(home() / "engine").encode() in (each / "cmdline").read_bytes():
                left.append(f"process {each.name}")
    left += [f"mount {line}" for line in Path("/proc/mounts").read_text().splitlines() if str(home()) in line]
    for root, folders, _ in os.walk("/sys/fs/cgroup"):
        left += [f"control group {root}/{name}" for name in folders if name == "rosbayes-engine"]
    return left


def in_engine(arguments: list[str]) -> int:
    """Run this command again within the engine, and check that nothing is left behind."""
    if subprocess.run([str(ENGINE), "able"], check=False, timeout=COMMAND_LIMIT).returncode:
        print("CONTAINERS WERE NOT VERIFIED: run this on a machine that allows it")
        return NOT_ABLE
    signal.signal(signal.SIGINT, lambda *_: None)  # Ctrl-C reaches the engine's command, which ends in order
    again = [sys.executable, "-P", "-m", "scripts.verifications.containers", *arguments]
    with_this_process = ["setpriv", "--pdeathsig", "TERM", "--"]
    code = subprocess.run([*with_this_process, str(ENGINE), "run", *again], check=False).returncode
    try:
        until(lambda: not left_behind(), lambda: f"left behind: {left_behind()}", 30 * FACTOR)
    except CheckError as error:
        print(f"FAIL {error}")
        return code or 1
    return code


def main() -> int:
    """Parse the flags, and run the checks inside a Docker engine that the script starts."""
    parser = ScriptParser("scripts/verify containers", __doc__)
    parser.flag("--only", "only the checks with this in their names, and what they need", "")
    parser.switch("--short", "build, start, compare results, kill a service, stop")
    parser.switch("--fetch", "only download the wheels")
    options = parser.parse_args()

    try:
        if options.fetch:
            fetch_wheels()
            return 0
        if os.environ.get("DOCKER_HOST") != f"unix://{home()}/run/docker.sock":
            return in_engine(sys.argv[1:])
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
        return verify(options.only, short=options.short)
    except DownloadError as error:
        print(f"error: a download failed: {error}", file=sys.stderr)
        return DOWNLOAD_FAILED
    except KeyboardInterrupt:
        print("interrupted (Ctrl-C)", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
