"""`toolchain new` writes a model that builds as printed, and a robot that publishes its readings."""

import contextlib
import re
import runpy
import shlex

import numpy as np
import pytest

import bridge.client
from tests.toolchain.running import assert_refused, done
from tests.toolchain.running import toolchain as run
from toolchain.deployment import load_deployment
from toolchain.deployment.address import to_address
from toolchain.models.case_study import load_model
from toolchain.models.model import exact_posterior


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_what_it_prints_builds(here):
    (command,) = re.findall(r"^ +(toolchain build .*)$", done(run("new", "mymodel")).stdout, re.MULTILINE)
    done(run(*shlex.split(command)[1:], "--set", "cells=20"))
    deployment = load_deployment(here / "build" / "mymodel")
    assert (deployment.name, deployment.machine.lines) == ("mymodel", 20)
    assert [variable.path for variable in deployment.variables] == ["data[0]", "data[1]"]


class Robot:
    """A server on which the first message is followed by Ctrl-C."""

    async def advertise(self, *topic):
        self.topic = topic
        return self

    async def publish(self, message):
        self.message = message
        raise KeyboardInterrupt


def test_the_robot_says_what_the_model_reads_and_ends_quietly_at_ctrl_c(here, monkeypatch):
    (here / "deep" / "er").mkdir(parents=True)
    made = done(run("new", "deep/er/mymodel"))
    folder, robot = here / "deep" / "er" / "mymodel", Robot()
    monkeypatch.setattr(bridge.client, "connect", lambda _: contextlib.nullcontext(robot))
    runpy.run_path(str(folder / "robot.py"))
    assert "--topic {} --type {}".format(*robot.topic) in made.stdout
    model = load_model(folder, {})
    readings = zip(model.variables, robot.message["data"], strict=True)
    posterior = exact_posterior(model, [to_address(variable, reading) for variable, reading in readings])
    assert model.searched[0].value(int(np.argmax(posterior))) == pytest.approx(6.5, abs=0.2)


def test_it_overwrites_nothing(here):
    run("new", "mymodel")
    (here / "mymodel" / "model.py").write_text("mine")
    assert_refused(run("new", "mymodel"), "mymodel/model.py")
    assert (here / "mymodel" / "model.py").read_text() == "mine"


@pytest.mark.parametrize("name", ["3d", "a-b", "..", "", "é", "a" * 80, "nowhere/mymodel", "file/mymodel"])
def test_names_that_no_topic_or_folder_can_have(here, name):
    (here / "file").write_text("")
    assert_refused(run("new", name), name.partition("/")[0][:20])
    assert [each.name for each in here.iterdir()] == ["file"]
