"""`toolchain new` writes a model that builds as printed, and a robot that publishes its readings."""

import ast
import re
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest

from tests.patience import PROCESS_PATIENCE
from tests.toolchain.running import assert_refused
from tests.toolchain.running import toolchain as run
from toolchain.deployment import load_deployment
from toolchain.deployment.address import to_address
from toolchain.models.case_study import load_model
from toolchain.models.model import exact_posterior

# runs a program with a server that never answers in the place of the robot's
WAITING = """
import asyncio, contextlib, runpy, sys
import bridge.client

@contextlib.asynccontextmanager
async def connect(uri):
    print("connecting", flush=True)
    await asyncio.sleep(60)
    yield

bridge.client.connect = connect
runpy.run_path(sys.argv[1])
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_what_it_prints_builds(here):
    made = run("new", "mymodel")
    assert made.exit_code == 0, made.stderr
    (command,) = re.findall(r"^ +(toolchain build .*)$", made.stdout, re.MULTILINE)
    built = run(*shlex.split(command)[1:])
    assert built.exit_code == 0, built.stderr
    deployment = load_deployment(here / "build" / "mymodel")
    assert deployment.name == "mymodel"
    assert [variable.path for variable in deployment.variables] == ["data[0]", "data[1]"]
    smaller = run(*shlex.split(command)[1:], "--set", "cells=20")
    assert smaller.exit_code == 0
    assert load_deployment(here / "build" / "mymodel").machine.lines == 20


def test_the_robot_says_what_the_model_reads(here):
    (here / "deep" / "er").mkdir(parents=True)
    made = run("new", "deep/er/mymodel")
    folder = here / "deep" / "er" / "mymodel"
    text = (folder / "robot.py").read_text()
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    arguments = [
        [ast.literal_eval(each) for each in call.args]
        for call in calls
        if call.args and not isinstance(call.args[0], ast.Call | ast.Name)
    ]
    topic, kind = next(each for each in arguments if len(each) == 2)
    assert f"--topic {topic} --type {kind}" in made.stdout
    (message,) = next(each for each in arguments if isinstance(each[0], dict))
    model = load_model(folder, {})
    addresses = [
        to_address(variable, reading)
        for variable, reading in zip(model.variables, message["data"], strict=True)
    ]
    posterior = exact_posterior(model, addresses)
    assert model.searched[0].value(int(np.argmax(posterior))) == pytest.approx(6.5, abs=0.2)


@pytest.mark.thorough
def test_the_robot_ends_quietly_at_ctrl_c(here):
    run("new", "mymodel")
    robot = subprocess.Popen(
        [sys.executable, "-c", WAITING, here / "mymodel" / "robot.py"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        assert robot.stdout.readline() == b"connecting\n"
        robot.send_signal(signal.SIGINT)
        _, said = robot.communicate(timeout=PROCESS_PATIENCE)
    finally:
        robot.kill()
    assert (robot.returncode, said) == (0, b"")


def test_it_overwrites_nothing(here):
    run("new", "mymodel")
    (here / "mymodel" / "model.py").write_text("mine")
    assert_refused(run("new", "mymodel"), "mymodel/model.py")
    assert (here / "mymodel" / "model.py").read_text() == "mine"


@pytest.mark.parametrize("name", ["3d", "my model", "a-b", "..", "", "é", "a" * 80, "nowhere/mymodel"])
def test_names_that_no_topic_or_folder_can_have(here, name):
    assert_refused(run("new", name), name.partition("/")[0][:20])
    assert not list(here.iterdir())


def test_a_folder_that_cannot_be_written(here):
    (here / "file").write_text("")
    assert_refused(run("new", "file/mymodel"), "file")
