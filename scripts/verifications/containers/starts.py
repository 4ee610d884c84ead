"""Checks of how stacks start in containers: any model, an absent robot, the hub alone, and refused starts."""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from scripts.running.patience import FACTOR
from scripts.verifications.checks import expect
from scripts.verifications.containers.stack import (
    BOARDS,
    CORE,
    FLOW_LIMIT,
    OUT,
    VIEWER,
    Client,
    Stack,
    check_results,
)

ROBOT_PORT, BOARD_PORT = 9191, 7100
ALONE_S: Final = 15.0
"""Seconds without a robot: longer than the timeout of a connection on the command line."""
MINE: Final = "build/mine"
SECOND: Final = "second"


def toolchain(*arguments: str, folder: Path | None = None) -> None:
    """Run the command `toolchain`."""
    command = [str(Path(sys.executable).with_name("toolchain")), *arguments]
    subprocess.run(
        command,
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        check=True,
        timeout=300 * FACTOR,
    )


@contextlib.contextmanager
def containers(stack: Stack, commands: dict[str, list[str]], *options: str) -> Iterator[None]:
    """Run containers outside the compose project, in the network of their machine."""
    try:
        for name, command in commands.items():
            stack.docker(
                *("run", "--detach", "--init", "--name", name, "--network", "host", *options, "rosbayes"),
                *command,
            )
        yield
    finally:
        stack.docker("rm", "--force", *commands, check=False)


@contextlib.contextmanager
def robot(stack: Stack) -> Iterator[None]:
    """Run a boat with a rosbridge server outside the project, as on another machine."""
    here = f"ws://127.0.0.1:{ROBOT_PORT}"
    server = ["hub", "--host", "0.0.0.0", "--insecure", "--port", str(ROBOT_PORT)]  # noqa: S104 - the engine's own network
    boat = {
        "robot-normaliser": ["boat-normaliser", "--uri", here],
        "robot-simulator": ["boat-simulator", "--uri", here],
    }
    with containers(stack, {"robot-hub": server}):
        deadline = time.time() + FLOW_LIMIT
        while "listening" not in stack.log("robot-hub", 0):
            expect(time.time() < deadline, "the robot's hub does not listen")
            time.sleep(0.1)
        with containers(stack, boat):
            yield


def check_robot(stack: Stack) -> None:
    """Check ROSBRIDGE_URI and BM_BOARDS: with a server and boards elsewhere, none are started here."""
    ports = range(BOARD_PORT, BOARD_PORT + 2 * len(BOARDS), 2)
    boards = {
        f"far-board{index}": [
            "board",
            "--listen",
            f"tcp://0.0.0.0:{port}",
            "--insecure",
            "--index",
            str(index),
        ]
        for index, port in enumerate(ports)
    }
    with robot(stack), containers(stack, boards):
        began = time.time()
        stack.variables["ROSBRIDGE_URI"] = f"ws://host.docker.internal:{ROBOT_PORT}"
        stack.variables["BM_BOARDS"] = ",".join(f"tcp://host.docker.internal:{port}" for port in ports)
        try:
            took = stack.up((*CORE, *VIEWER))
            with Client(stack, f"ws://127.0.0.1:{ROBOT_PORT}", "host") as client:
                client.flowing(began, 20)
                stack.notes.append(f"healthy after {took:.1f} s; {check_results(client.results)}")
        except Exception:
            stack.save_logs("ROSBRIDGE_URI before down")
            raise
        finally:
            stack.down()


def check_absent_robot(stack: Stack) -> None:
    """Check that a stack reports that it waits for a robot, and computes results soon after the robot appears."""
    uri = f"ws://host.docker.internal:{ROBOT_PORT}"
    stack.variables["ROSBRIDGE_URI"] = uri
    try:
        stack.compose("up", "--detach")
        time.sleep(ALONE_S)
        states = stack.states()
        ended = [name for name, state in states.items() if state["Status"] != "running"]
        expect(not ended, f"without a robot these do not run: {ended}")
        deadline = time.time() + FLOW_LIMIT
        while uri not in (why := " ".join(stack.status().get("why", []))):
            expect(time.time() < deadline, f"status does not name the robot that is waited for: {why}")
            time.sleep(0.25)
        before = {service: stack.restarts(service) for service in states}
        with robot(stack):
            appeared = time.time()
            # not necessarily frame 1: the viewer may connect after the first results
            while not re.search(r"^frame \d+:", stack.log("viewer", 0), re.MULTILINE):
                expect(time.time() < appeared + FLOW_LIMIT, "no result after the robot appeared")
                time.sleep(0.1)
            took = time.time() - appeared
        after = {service: stack.restarts(service) for service in states}
        expect(before == after and not any(after.values()), f"containers were restarted: {after}")
        stack.notes.append(f"the first result came {took:.1f} s after the robot")
    except Exception:
        stack.save_logs("an absent robot before down")
        raise
    finally:
        stack.down()


def check_own_model(stack: Stack) -> None:
    """Check a user's model on one board, built by `toolchain build` in the project, with readings from outside."""
    models = stack.project / "models"
    models.mkdir(exist_ok=True)
    toolchain("new", "models/mine", folder=stack.project)
    source = (
        "--uri",
        "ws://127.0.0.1:9090",
        "--topic",
        "/mine/readings",
        "--type",
        "std_msgs/Float64MultiArray",
    )
    toolchain("build", "models/mine", "-o", MINE, *source, folder=stack.project)
    stack.variables["DEPLOYMENT"] = MINE
    try:
        stack.compose("up", "--detach")
        expect(set(stack.states()) == {*CORE, "boards", "hub", *VIEWER}, f"it runs {[*stack.states()]}")
        program = f"{models / 'mine' / 'robot.py'}:/robot.py:ro"
        with containers(stack, {"my-robot": ["python", "/robot.py"]}, "--volume", program):
            for begins in (0.0, None):
                since = time.time() if begins is None else begins
                deadline = time.time() + FLOW_LIMIT
                while " x " not in stack.log("viewer", since):
                    expect(time.time() < deadline, f"the viewer shows {stack.log('viewer', since)!r}")
                    time.sleep(0.25)
                if begins is not None:
                    stack.signal_board(stack.board_pid("board0"), "KILL")
                    time.sleep(1)
            names = {each["name"] for each in stack.status()["processes"]}
            expect(names & set(BOARDS) == {"board0"}, f"status shows {names}")
            drawn = stack.compose("exec", "--no-TTY", "viewer", "listen", "--plot", "--count", "1")
            expect("###" in drawn, f"listen --plot draws {drawn}")
    finally:
        stack.down()


def check_hub_alone(stack: Stack) -> None:
    """Check `docker compose up hub`, and that a second stack with the same port starts nothing."""
    try:
        stack.compose("up", "--detach", "--wait", "hub")
        expect(set(stack.states()) == {"hub"}, f"it runs {[*stack.states()]}")
        stack.variables["COMPOSE_PROJECT_NAME"] = SECOND
        try:
            expect("9090" in (said := stack.refused()), f"it does not name the port: {said}")
        finally:
            stack.compose("down", "--volumes", "--remove-orphans")
    finally:
        stack.down()


def check_refused(stack: Stack) -> None:
    """Check that starts which cannot succeed end with a reason that names what the user typed."""
    broken = OUT / "broken"
    shutil.rmtree(broken, ignore_errors=True)
    shutil.copytree(OUT / "deployment", broken)
    (broken / "deployment.toml").write_text((broken / "deployment.toml").read_text().replace("hash = ", "# "))
    (stack.project / "build" / "empty").mkdir(parents=True, exist_ok=True)
    cases = (
        ({"DEPLOYMENT": "build/mien"}, "build/mien"),
        ({"DEPLOYMENT": "build/empty"}, "error: build/empty"),
        ({"DEPLOYMENT": str(broken)}, f"error: {broken}"),
        ({"BM_BOARDS": "tcp://far:7000"}, "error: --boards"),
        ({"ROSBRIDGE_URI": "http://far"}, "http://far"),
    )
    for variables, reason in cases:
        stack.variables |= variables
        try:
            said = stack.refused()
            expect(reason in said, f"with {variables} it says: {said}")
        finally:
            stack.down()
