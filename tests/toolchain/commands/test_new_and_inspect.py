"""`toolchain new` writes a model that builds and a robot that publishes; `inspect` reports with and without the model."""

import contextlib
import json
import re
import runpy
import shlex

import numpy as np
import pytest

import bridge.client
from tests.toolchain.running import TARGET, assert_refused, done, toolchain
from tests.toolchain.running import toolchain as run
from toolchain.analysis.inspection import _with_unit
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


@pytest.fixture
def deployment(case):
    build(case)
    return case.parent / "out"


def build(case, *arguments):
    return done(toolchain("build", case, "-o", case.parent / "out", *TARGET, "--partitions", 2, *arguments))


def look(deployment, *arguments):
    return toolchain("inspect", deployment, "--frames", 20, *arguments)


def test_with_the_model_and_without(case, deployment):
    text = done(look(deployment, "--model", str(case), "--clock", "50e6")).stdout
    assert "12 lines (x 12), 2 sensor columns and the prior, on 2 boards of 6 lines each." in text
    assert "Codes of 8 bits (scale = address)" in text
    assert "20 frames drawn from the model (seed 1), each with 4 sets of seeds." in text
    assert "time at 50 MHz" in text
    assert [part.split()[0] for part in text.split("\n\n")] == [
        *("Deployment", "Lost", "Readings:", "Cycles", "Accuracy", "Resources", "Energy")
    ]
    text = done(look(deployment)).stdout
    assert "drawn from the codes" in text
    assert "by quantising alone" not in text


def test_json(case, deployment):
    found = json.loads(look(deployment, "--model", str(case), "--json").stdout)
    assert (found["lines"], found["columns"], found["boards"], found["clock_hz"]) == (12, 3, 2, 100e6)
    assert found["accuracy"]["frames"] == 20
    assert 0 < found["accuracy"]["machine"]["total_variation"]["value"] < 0.2
    assert [loss["name"] for loss in found["losses"]] == ["prior", "range", "loud"]
    assert all(each["fits"] for each in found["resources"])
    assert found["energy_model"]["dynamic_j"] > 0


def test_recorded_readings(case, deployment):
    recording = case.parent / "run.csv"
    recording.write_text("range_m,loud\n3.0,1\n,0\n4.5,0\n")
    result = done(
        look(deployment, "--readings", str(recording), "--reading", "range=range_m", "--reading", "loud=loud")
    )
    assert "Readings: 3 of 3 rows of run.csv, each with 4 sets of seeds." in result.stdout


def test_deployments_of_other_machines(case):
    build(case, "--per-cell", "--target-count", "20")
    slow = toolchain("inspect", case.parent / "out")  # to emulate, so for fewer frames
    assert "Readings: 20 frames " in slow.stdout
    build(case, "--bits", "range=6", "--scale", "column", "--rng", "lfsr16", "--stop", "own")
    out = case.parent / "out"
    result = done(look(out, "--model", str(case), "--bits", "range=6"))
    assert "(scale = column)" in result.stdout
    assert "stop = own" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--model", "{case}", "--set", "cells=13"], ["/out", "corridor", "--set"]),
        (["--model", "{case}", "--bits", "range=7"], ["/out", "corridor", "--bits"]),
        (["--clock", "0"], ["--clock is 0"]),
        (["--clock", "1e13"], ["--clock is 1e+13"]),
        (["--device", "d9"], ["--device d9", "proce-v-d8"]),
        (["--reading", "range=a"], ["--reading range=a", "--readings FILE"]),
        (["--banks", "0"], ["--banks is 0"]),
        (["--frames", "9" * 30], ["1 to 100000"]),
    ],
)
def test_mistakes(case, deployment, arguments, named):
    assert_refused(look(deployment, *[argument.format(case=case) for argument in arguments]), *named)


def test_a_build_on_a_device_takes_its_own_number_of_boards(case):
    result = build(case, "--device", "proce-v-d8")
    assert "\nAll 12 lines fit one Gidel Proce V D8 (Stratix V GS D8):" in result.stdout
    assert "--partitions 2 asks for more.\n" in result.stdout
    assert (case.parent / "out" / "report.txt").read_text() == result.stdout
    assert len(load_deployment(case.parent / "out").boards) == 2  # as asked for, since that is more


def test_units():
    values = {20.48e-6: "20.5 us", 1e-3: "1 ms", 1.0: "1 s", 0.0: "0 s", 3e-15: "0.003 ps"}
    assert {value: _with_unit(value, "s") for value in values} == values
    assert _with_unit(100e6, "Hz") == "100 MHz"
