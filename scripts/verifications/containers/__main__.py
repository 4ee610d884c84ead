"""Verification of the compose file on a separate container engine (see scripts/verify).

The engine is scripts/container-engine's, so a bare Debian machine suffices. The image is built from a copy of
this folder.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Final

from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR
from scripts.running.processes import ROOT
from scripts.verifications.checks import CheckError, DownloadError, Tally, expect
from scripts.verifications.containers.project import STOP_GRACE, copy_project, fetch_wheels, home
from scripts.verifications.containers.stack import (
    BOARDS,
    COMMAND_LIMIT,
    CORE,
    DOWNLOAD_FAILED,
    ENGINE,
    FLOW_LIMIT,
    KILLED,
    OUT,
    SERVICES,
    VIEWER,
    Client,
    Engine,
    Stack,
    check_results,
    seconds,
)
from scripts.verifications.containers.starts import (
    check_absent_robot,
    check_hub_alone,
    check_own_model,
    check_refused,
    check_robot,
    toolchain,
)
from toolchain.deployment import load_deployment

LIMIT: Final = round(3600 * FACTOR)
"""Time limit of the verification, in seconds, for the case that it hangs."""
BUILD_LIMIT = 900.0 * FACTOR
NOT_ABLE: Final = 4
"""Exit code if this machine cannot run containers, as of `scripts/container-engine able`."""
TERMINATED: Final = 143
MOST_RESTARTS: Final = 8
"""Maximum number of restarts of a container until all use the deployment in the folder."""
BUILT, UP = "the image is built", "docker compose up"
ALWAYS: Final = (BUILT, UP)


# The checks


def check_build(stack: Stack) -> None:
    """Build the image from a copy of this folder, with the wheels of the lock file."""
    stack.compose("config", "--quiet")
    stack.compose("build", limit=BUILD_LIMIT)
    size = int(stack.docker("image", "inspect", "--format", "{{.Size}}", "rosbayes"))
    stack.notes.append(f"{size / 1e6:.0f} MB")


def check_up(stack: Stack) -> None:
    """Start the stack, and wait until all services are healthy and boat-viewer shows a result."""
    began = time.time()
    took = stack.up()
    deadline = time.time() + FLOW_LIMIT
    line = re.compile(r"^(\S+Z) +\d+ ", re.MULTILINE)
    while not (found := line.search(stack.docker("logs", "--timestamps", stack.container("boat-viewer")))):
        expect(time.time() < deadline, "boat-viewer shows no result")
        time.sleep(0.1)
    created, hub = stack.phases(began)
    stack.notes.append(
        f"created after {created:.1f} s, the hub started after {hub:.1f} s, "
        f"first result after {seconds(found[1]) - began:.1f} s, all healthy after {took:.1f} s"
    )


def check_bits(stack: Stack) -> None:
    """Check that a client container recomputes results exactly, and that they are near float64 fusion's."""
    results = stack.bits(8)
    stack.notes.append(check_results(results))


def check_confined(stack: Stack) -> None:
    """Check that containers are not root, have no capabilities, writable files or external network."""
    output = stack.docker("exec", stack.container("master"), "cat", "/proc/self/status")
    fields = dict(line.split(":\t", 1) for line in output.splitlines() if ":\t" in line)
    expect(fields["Uid"].split() == ["10001"] * 4, f"it runs as {fields['Uid']}")
    for name in ("CapEff", "CapPrm", "CapBnd"):
        expect(int(fields[name], 16) == 0, f"it has capabilities: {name} {fields[name]}")
    expect(fields["NoNewPrivs"] == "1", "it may gain privileges")
    expect(fields["Seccomp"] == "2", "its system calls are not filtered")
    for container in stack.inspect(*SERVICES):
        host = container["HostConfig"]
        expect(host["ReadonlyRootfs"], f"{container['Name']} may write to its root")
        expect(host["Memory"] > 0 and host["PidsLimit"] > 0, f"{container['Name']} has no limits")
        for ports in host["PortBindings"].values():
            expect(
                {each["HostIp"] for each in ports} == {"127.0.0.1"}, f"{container['Name']} publishes {ports}"
            )
    write = "touch /opt/rosbayes/x /deployment/x /run/x"
    out = "import socket; socket.create_connection(('172.17.0.1', 2375), 2)"
    for service in ("pcie-app", "subscriber", "boards", "boat-simulator"):
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


def check_status(stack: Stack) -> None:
    """Check that `status` shows the whole stack as ready."""
    deadline = time.time() + FLOW_LIMIT
    expected = {*SERVICES, *BOARDS} - {"boards", *VIEWER}
    while True:
        status = stack.status()
        shown = {each["name"] for each in status.get("processes", [])}
        if shown == expected and status["ready"]:
            break
        expect(time.time() < deadline, f"it shows {sorted(shown)}, not ready: {status.get('why')}")
        time.sleep(0.25)
    project = str(status["directory"]).rpartition("/")[2]
    expect(project == "rosbayes", f"it does not name the project, by which two stacks differ: {project}")


def kill(service: str) -> Callable[[Stack, Client], None]:
    """Return a check that kills a service's process."""

    def check(stack: Stack, client: Client) -> None:
        before = stack.restarts(service)
        at = time.time()
        stack.signal(service, "KILL")
        again(stack, client, at, stack.restarted(service, before, at))

    return check


def again(stack: Stack, client: Client, hurt: float, back: float) -> None:
    """Wait until correct results arrive again and all services are healthy, and record the times."""
    first = client.flowing(back)
    stack.healthy()
    healthy = time.time() - hurt
    stack.ready()
    stack.notes.append(f"results again after {first - hurt:.1f} s, all healthy after {healthy:.1f} s")


def kill_all(stack: Stack, client: Client) -> None:
    """Kill everything within a second or two, in no particular order."""
    before = {service: stack.restarts(service) for service in SERVICES}
    at = time.time()
    for service in SERVICES:
        stack.signal(service, "KILL")
    back = [stack.restarted(service, before[service], at) for service in SERVICES]
    again(stack, client, at, max(back))


def kill_board(stack: Stack, client: Client) -> None:
    """Kill the process of one board, which the others' parent restarts."""
    before = stack.restarts("boards")
    board = stack.board_pid("board0")
    at = time.time()
    stack.signal_board(board, "KILL")
    again(stack, client, at, at + 0.2)
    expect(stack.restarts("boards") == before, "the container of all boards was restarted")


def kill_mid_frame(stack: Stack, client: Client) -> None:
    """Stop a board until a frame waits for it, then kill it, so that the frame is lost and reported."""
    board = stack.board_pid("board1")
    stack.signal_board(board, "STOP")
    client.silent(0.5 * FACTOR, FLOW_LIMIT)
    at = time.time()
    stack.signal_board(board, "KILL")
    again(stack, client, at, at)
    log = stack.log("master", at)
    expect("board 1" in log.lower(), f"the master does not mention board 1: {log[-300:]}")


def cut_off(stack: Stack, client: Client) -> None:
    """Stop a board's process, which is then silent like a board without power, and continue it."""
    board = stack.board_pid("board2")
    cut = time.time()
    stack.signal_board(board, "STOP")
    client.silent(FACTOR, FLOW_LIMIT)
    deadline = time.time() + FLOW_LIMIT
    while "board 2" not in stack.log("master", cut).lower():
        expect(time.time() < deadline, "the master says nothing of board 2, which does not answer any more")
        time.sleep(0.25)
    noticed = joined = time.time()
    stack.signal_board(board, "CONT")
    again(stack, client, joined, joined)
    stack.notes.append(
        f"cut off; the master reported it after {noticed - cut:.1f} s; the times are from joining it again"
    )


def rosbridge_cut_off(stack: Stack, client: Client) -> None:
    """Disconnect subscriber and publisher with open connections, as when a robot drives out of range."""
    lost = ("subscriber", "publisher")
    for service in lost:
        stack.docker("network", "disconnect", "rosbayes_ros", stack.container(service))
    client.silent(2.0 * FACTOR, FLOW_LIMIT)
    joined = time.time()
    for service in lost:
        stack.docker("network", "connect", "--alias", service, "rosbayes_ros", stack.container(service))
    again(stack, client, joined, joined)
    stack.notes.append("the times are from joining them again")


def check_stop(stack: Stack) -> None:
    """Check that all services end by themselves after SIGTERM."""
    began = time.time()
    stack.compose("stop", limit=COMMAND_LIMIT + STOP_GRACE)
    took = time.time() - began
    codes = {name: state["ExitCode"] for name, state in stack.states().items()}
    # a machine on which limits are multiplied may be too slow for any grace period
    right = {TERMINATED, KILLED} if FACTOR > 1 else {TERMINATED}
    wrong = {name: code for name, code in codes.items() if code not in right}
    expect(
        not wrong,
        f"exit codes other than {TERMINATED} (SIGTERM): {wrong}; {KILLED} had to be killed after {STOP_GRACE:g} s",
    )
    stack.notes.append(
        f"{len(codes)} services ended after {took:.1f} s with exit codes {sorted(set(codes.values()))}"
    )


def kill_short(stack: Stack) -> None:
    """Kill pcie-app, and check that the engine restarts it and that results are again right to the bit."""
    before, at = stack.restarts("pcie-app"), time.time()
    stack.signal("pcie-app", "KILL")
    back = stack.restarted("pcie-app", before, at)
    stack.notes.append(f"restarted after {back - at:.1f} s; {check_results(stack.bits(4))}")


def check_faults(stack: Stack, tally: Tally) -> None:
    """Kill each service, and disconnect a board, while a client listens."""
    checks: list[tuple[str, Callable[[Stack, Client], None]]] = [
        (f"{service} killed", kill(service))
        for service in (*CORE, "boards", "boat-simulator", "boat-normaliser", "boat-viewer", "hub")
    ]
    checks += [
        ("all services killed", kill_all),
        ("a board killed", kill_board),
        ("a board killed mid-frame", kill_mid_frame),
        ("a board cut off and joined again", cut_off),
        ("subscriber and publisher cut off theirs", rosbridge_cut_off),
    ]
    with Client(stack, "ws://hub:9090", "rosbayes_ros") as client:
        began = time.time()
        run_check(stack, tally, "results flow to a client container", lambda: client.flowing(began, 20))
        for name, check in checks:
            run_check(stack, tally, name, partial(check, stack, client))
        run_check(
            stack,
            tally,
            "all results of these runs",
            lambda: stack.notes.append(check_results(client.results)),
        )


def check_other_deployments(stack: Stack, tally: Tally, folder: Path) -> None:
    """Check DEPLOYMENT=DIR, and builds into this folder while the stack runs."""
    checks: list[tuple[str, Callable[[Stack, Path], None]]] = [
        ("DEPLOYMENT=another", another_deployment),
        ("DEPLOYMENT: changed, pcie-app killed", kill_after_change),
    ]
    if stack.only and not any(stack.only in name for name, _ in checks):
        return
    try:
        for name, check in checks:
            run_check(stack, tally, name, partial(check, stack, folder))
    finally:
        stack.down()


def another_deployment(stack: Stack, folder: Path) -> None:
    """Check that `up` replaces the model of the running stack, here by another one of the boat."""
    stack.up()
    stack.variables |= {"DEPLOYMENT": str(folder), "COMPOSE_PROFILES": "hub,boat,boards,viewer"}
    began = time.time()
    took = stack.up()
    with Client(stack, "ws://hub:9090", "rosbayes_ros", "--cells", "16", "16") as client:
        client.flowing(began, 20)
        stack.notes.append(f"healthy after {took:.1f} s; {check_results(client.results)}")


def kill_after_change(stack: Stack, folder: Path) -> None:
    """Check a changed folder: after the first restart, all others restart once."""
    before = {service: stack.restarts(service) for service in SERVICES}
    correct_tables(folder, 1.2)
    at = time.time()
    stack.signal("pcie-app", "KILL")
    stack.restarted("pcie-app", before["pcie-app"], at)
    of_deployment(stack, folder)
    took = time.time() - at
    more = {service: stack.restarts(service) - before[service] for service in CORE}
    expect(max(more.values()) <= MOST_RESTARTS, f"containers were restarted again and again: {more}")
    times = ", ".join(f"{service} {count}" for service, count in more.items())
    stack.notes.append(f"results of the new one were compared after {took:.1f} s; restarts: {times}")


def of_deployment(stack: Stack, folder: Path) -> None:
    """Wait until all services use the folder's deployment, and results are exactly those of it."""
    wanted = hash_of(folder)
    deadline = time.time() + FLOW_LIMIT
    while set((found := stack.deployments()).values()) != {wanted}:
        expect(time.time() < deadline, f"the folder holds {wanted[:12]}, and the services work by {found}")
        time.sleep(0.25)
    check_results(stack.bits(3, "--cells", "16", "16", folder=folder))


FAKE_PROCESSOR: Final = """
import llvmlite.binding as llvm
llvm.get_host_cpu_name = lambda: "goldmont-plus"
from machines import warm_up
warm_up()
"""


def check_processor(stack: Stack) -> None:
    """Check that, on a processor of another name, kernels are loaded from the image instead of compiled."""
    settings = ["--read-only", "--tmpfs", "/tmp", "--env", "NUMBA_DEBUG_CACHE=1"]  # noqa: S108 - the /tmp of the container
    program = ["python", "-c", FAKE_PROCESSOR]
    with_image = stack.docker("run", "--rm", *settings, "rosbayes", *program)
    loaded, saved = (len(re.findall(rf"\] data {word} ", with_image)) for word in ("loaded from", "saved to"))
    expect(
        loaded > 0 and saved == 0, f"{loaded} kernels were loaded and {saved} compiled:\n{with_image[-500:]}"
    )
    # the same with the image's kernels but without their names, to show that the check can fail
    untold = ["env", "--unset=NUMBA_CPU_NAME", "--unset=NUMBA_CPU_FEATURES", *program]
    compiled = stack.docker("run", "--rm", *settings, "rosbayes", *untold).count("] data saved to ")
    expect(compiled > 0, "numba compiles nothing although the baseline is not set: this check shows nothing")
    stack.notes.append(
        f"{loaded} kernels loaded, none compiled; without the baseline's name {compiled} compiled"
    )


# Preparation


def hash_of(folder: Path) -> str:
    """Return the hash of the deployment in a folder."""
    return load_deployment(folder, images=False).hash


SIZE: Final = ("--set", "width=16", "--set", "height=16")


def build_another(folder: Path) -> None:
    """Build a deployment of another model for DEPLOYMENT: the boat on 16 x 16 cells."""
    source = ("--uri", "ws://hub:9090", "--topic", "/boat/sensors", "--type", "boat_msgs/Sensors")
    boat = str(ROOT / "casestudies" / "boat")
    toolchain("build", boat, "-o", str(folder), "--partitions", "4", *source, *SIZE)


def correct_tables(folder: Path, factor: float) -> None:
    """Build other tables into a deployment, with bearings whose uncertainty is a multiple of the model's."""
    model = OUT / "model"
    shutil.copytree(ROOT / "casestudies" / "boat", model, dirs_exist_ok=True)
    source = (ROOT / "casestudies" / "boat" / "model.py").read_text()
    changed = source.replace("sigma=BEARING_SIGMA", f"sigma={factor} * BEARING_SIGMA")
    expect(changed != source, "the boat's model does not say sigma=BEARING_SIGMA any more")
    (model / "model.py").write_text(changed)
    before = hash_of(folder)
    toolchain("regenerate", "memories", str(folder), "--model", str(model), *SIZE)
    expect(hash_of(folder) != before, "the deployment's hash is the same with other tables")


def run_check(stack: Stack, tally: Tally, name: str, check: Callable[[], object]) -> bool:
    """Run one check, print its line, and return whether it passed."""
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
    tally.report(name, started, why, "\n".join(f"    {note}" for note in stack.notes))
    return why is None


def verify_short(stack: Stack, tally: Tally) -> None:
    """Run the checks of every commit: each is needed by the next one."""
    checks: list[tuple[str, Callable[[Stack], None]]] = [
        (BUILT, check_build),
        (UP, check_up),
        ("a client container: results to the bit", check_bits),
        ("pcie-app killed: results to the bit again", kill_short),
        ("docker compose stop", check_stop),
    ]
    for name, check in checks:
        if not run_check(stack, tally, name, partial(check, stack)):
            break


def verify_all(stack: Stack, tally: Tally) -> None:
    """Run all checks."""
    another = OUT / "deployment"
    shutil.rmtree(another, ignore_errors=True)
    build_another(another)
    if run_check(stack, tally, BUILT, lambda: check_build(stack)) and run_check(
        stack, tally, UP, lambda: check_up(stack)
    ):
        run_check(stack, tally, "a client container: results to the bit", lambda: check_bits(stack))
        run_check(stack, tally, "services are confined", lambda: check_confined(stack))
        run_check(stack, tally, "status shows all services", lambda: check_status(stack))
        check_faults(stack, tally)
        run_check(stack, tally, "docker compose stop", lambda: check_stop(stack))
        check_other_deployments(stack, tally, another)
        run_check(stack, tally, "ROSBRIDGE_URI and BM_BOARDS", lambda: check_robot(stack))
        run_check(stack, tally, "an absent robot that appears", lambda: check_absent_robot(stack))
        run_check(stack, tally, "a user's model on one board", lambda: check_own_model(stack))
        run_check(stack, tally, "the hub alone", lambda: check_hub_alone(stack))
        run_check(stack, tally, "starts that cannot succeed", lambda: check_refused(stack))
        run_check(stack, tally, "a processor of another name", lambda: check_processor(stack))


def verify(only: str, *, short: bool) -> int:
    """Run the checks, or those with a word in their names, and return the exit code."""
    OUT.mkdir(parents=True, exist_ok=True)
    for log in OUT.glob("*.log"):
        log.unlink()
    tally = Tally()
    began = time.monotonic()
    engine = Engine()
    with engine:
        print(f"the engine is up after {time.monotonic() - began:.1f} s", flush=True)
        wheels, project = engine.home / "wheels", OUT / "project"
        at = time.monotonic()
        fetch_wheels(wheels)
        copy_project(project, wheels)
        print(f"sources and wheels are there after {time.monotonic() - at:.1f} s", flush=True)
        stack = Stack(engine, project, only)
        stack.docker("compose", "down", "--volumes", "--remove-orphans", check=False)
        try:
            (verify_short if short else verify_all)(stack, tally)
        finally:
            signal.alarm(0)
            at = time.monotonic()
            stack.save_logs("last")
            stack.variables.clear()
            stack.docker("compose", "down", "--volumes", "--remove-orphans", check=False)
            # the cache makes the next build faster, but would fill the disk over many runs
            stack.docker("image", "prune", "--force", check=False)
            stack.docker("builder", "prune", "--force", "--keep-storage", "2GB", check=False)
            shutil.rmtree(project, ignore_errors=True)
            print(f"removed after {time.monotonic() - at:.1f} s", flush=True)
    at = time.monotonic()
    left = engine.left_behind()
    tally.report("nothing is left behind", at, ", ".join(left) or None)
    print(f"{time.monotonic() - began:.0f} s in all; logs are in {OUT.relative_to(ROOT)}")
    print(f"{tally.passed} passed, {tally.failed} failed")
    return 1 if tally.failed else 0


def main() -> int:
    """Check that this machine can run it, then run it with a time limit."""
    parser = ScriptParser(prog="scripts/verify containers", description=__doc__)
    parser.add_argument(
        "--only", default="", help="only the checks with this in their names, and what they need"
    )
    parser.add_argument(
        "--short", action="store_true", help="build, start, compare results, kill a service, stop"
    )
    parser.add_argument("--fetch", action="store_true", help="only download the wheels")
    options = parser.parse_args()

    def give_up(_number: int, _frame: FrameType | None) -> None:
        raise CheckError(f"this did not end within {LIMIT} s")

    def end(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    try:
        if options.fetch:
            fetch_wheels(home() / "wheels")
            return 0
        able = subprocess.run([str(ENGINE), "able"], check=False, timeout=COMMAND_LIMIT)
        if able.returncode:
            print("CONTAINERS WERE NOT VERIFIED: run this on a machine that allows it")
            return NOT_ABLE
        signal.signal(signal.SIGALRM, give_up)
        signal.signal(signal.SIGTERM, end)
        signal.signal(signal.SIGHUP, end)
        signal.alarm(LIMIT)
        return verify(options.only, short=options.short)
    except DownloadError as error:
        print(f"error: a download failed: {error}", file=sys.stderr)
        return DOWNLOAD_FAILED
    except CheckError as error:
        print(f"FAIL {error}")
        print("0 passed, 1 failed")
        return 1
    except KeyboardInterrupt:
        print("interrupted (Ctrl-C)", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
