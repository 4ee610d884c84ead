"""The toolchain command: the report on stdout, all else on stderr, one sentence and exit code 2 for a mistake."""

import os
import subprocess
import sys
from dataclasses import asdict, fields
from enum import Enum

import pytest

from machines.parameters import PriorMode
from pcie_shim.programming_file import read_image
from tests.patience import PROCESS_PATIENCE
from tests.toolchain.running import TARGET, TINY, assert_refused, done, toolchain
from toolchain.building.options import BuildOptions, MachineOptions, TargetOptions
from toolchain.commands.request import BuildFlags, build_options
from toolchain.deployment import UNFINISHED, Queue, Scale, load_deployment
from toolchain.outputs.mif import read_mif

MODEL = TINY


def build(case, *arguments, target=TARGET):
    return toolchain("build", case, "-o", case.parent / "out", *target, *arguments)


def test_a_build(case):
    os.utime(case / "model.py", (1_000_000_000, 1_000_000_000))
    result = done(build(case, "--partitions", "2", "--set", "size=6", "--queue", "all", "--interface", "1x3"))
    out = case.parent / "out"
    assert result.stdout == (out / "report.txt").read_text()
    assert f"Reading {case / 'model.py'}" in result.stderr
    assert f"Wrote {out / 'deployment.toml'}" in result.stderr
    deployment = load_deployment(out)
    assert [board.lines for board in deployment.boards] == [3, 3]
    assert (deployment.machine.interface, deployment.queue) == ("1x3", "all")
    assert deployment.sources[0].type == "std_msgs/msg/Float64"
    assert read_image(deployment.image_path(0)).build_date == "2001-09-09T01:46:40Z"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--set", "sze=3"], ["model.py", "'sze'", "'size'"]),
        (["--set", "size"], ["--set size", "KEY=VALUE"]),
        (["--set", "=3"], ["--set =3"]),
        (["--set", "size=3", "--set", "size=4"], ["--set size", "twice"]),
        (["--interface", "20"], ["--interface", "'20'"]),
        (["--bits", "L=3"], ["--bits L=3", "it has K"]),
        (["--bits", "K=17"], ["--bits K=17", "1 to 16"]),
        (["--bits", "K=x"], ["--bits K=x", "1 to 16"]),
        (["--rng-table", "a.mif"], ["--rng-table", "--rng lfsr32"]),
        (["--rng", "table", "--rng-table", "/no.mif"], ["/no.mif", "No such file"]),
        (["--searched", "s"], ["--searched"]),
    ],
)
def test_mistakes(case, arguments, named):
    assert_refused(build(case, *arguments), *named)
    assert not (case.parent / "out").exists()


DEFAULTS = BuildOptions(uri="ws://a:2", topic="/c", type="d/D")


def another(default, number):
    """Return a value that is not the default: another member of its enumeration, the other bool, or the number."""
    if isinstance(default, Enum):
        return next(each for each in type(default) if each is not default)
    return not default if isinstance(default, bool) else number


MACHINE = {
    field.name: another(getattr(DEFAULTS, field.name), number)
    for number, field in enumerate(fields(MachineOptions), 100)
} | {"scale": Scale.NONE, "prior_mode": PriorMode.WRITTEN}
TARGETED = TargetOptions(
    uri="ws://a:1",
    topic="/b",
    type="c/D",
    output="/e",
    order="B,A",
    path=["A=g"],
    prior_path="f",
    queue=Queue.ALL,
    tolerance_s=0.7,
)


def test_every_flag_reaches_the_options():
    given = MACHINE | asdict(TARGETED)
    options = build_options(BuildFlags(**MACHINE), TARGETED)
    assert {name: getattr(options, name) for name in given} == given
    assert not [name for name, value in given.items() if getattr(DEFAULTS, name) == value]


def test_machine_options(case):
    table = case.parent / "random.mif"
    table.write_text("WIDTH=4; DEPTH=3; CONTENT BEGIN 0 : 1 F 7; END;")
    rng = ("--rng", "table", "--rng-table", table)
    prior = ("--prior-mode", "written", "--prior-path", "prior.data")
    done(build(case, *rng, "--prob-bits", "3", "--bits", "K=4", *prior))
    deployment = load_deployment(case.parent / "out")
    assert (deployment.variables[0].bits, deployment.prior.path) == (4, "prior.data")
    assert read_image(deployment.image_path(0)).machine.rng_table.tolist() == [1, 15, 7]
    # the memory holds what cells compare with: as many bits as a code
    assert read_mif(case.parent / "out/bm_arch/Memory_MIFs/rng_table.mif").words == (1, 7, 7)


def test_a_network_with_a_question(network):
    result = done(
        build(network, "--searched", "rain,sprinkler", "--known", "shoes", "--on-missing", "missing")
    )
    deployment = load_deployment(network.parent / "out")
    assert deployment.name == "garden"
    states = {each.label: each.states for each in deployment.searched}
    assert states == {"rain": ("yes", "no"), "sprinkler": ("on", "off")}
    (shoes,) = deployment.variables
    assert (shoes.states, shoes.on_missing, shoes.offset, shoes.step) == (("wet", "dry"), "missing", 0, 1)
    assert "  shoes: 0 wet, 1 dry\n" in result.stdout
    assert "  rain: 1 yes, 0 no\n" in result.stdout


def test_a_network_with_a_fixed_and_a_selecting_variable(network):
    question = "--searched grass --known shoes --given sprinkler=on --prior-select rain"
    done(build(network, *question.split()))
    deployment = load_deployment(network.parent / "out")
    kinds = {each.name: each.kind for each in deployment.variables}
    assert kinds == {"shoes": "sensor", "rain": "prior_select"}
    assert deployment.machine.prior_bits == 2


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], ["garden.bif", "--searched"]),
        (["--searched", "rain,,grass"], ["--searched rain,,grass"]),
        (["--searched", "rain", "--given", "grass"], ["--given grass", "KEY=VALUE"]),
        (["--searched", "rain", "--set", "size=3"], ["--set size"]),
        (["--searched", "rain", "--prior-path", "x"], ["--prior-mode written"]),
    ],
)
def test_questions_that_cannot_be_built(network, arguments, named):
    assert_refused(build(network, *arguments), *named)
    assert not (network.parent / "out").exists()


@pytest.mark.parametrize(
    ("option", "value"), [("--uri", "robot9090"), ("--topic", "a b"), ("--type", "x"), ("--output", "/a b")]
)
def test_a_wrong_target_is_refused_before_the_model_is_read(case, option, value):
    (case / "model.py").write_text("raise SystemExit('the model was read')")
    target = dict(zip(TARGET[::2], TARGET[1::2], strict=True)) | {option: value}
    result = build(case, target=[word for pair in target.items() for word in pair])
    assert_refused(result, f"error: {option}: ")


@pytest.mark.parametrize("name", ["nope", "nope.bif"])
def test_a_missing_model_is_named_before_a_missing_target(tmp_path, name):
    assert_refused(build(tmp_path / name, target=()), str(tmp_path / name))


def test_check_names_what_a_path_lacks(tmp_path):
    assert_refused(
        toolchain("check", tmp_path), tmp_path, "contains no model or deployment", "deployment.toml"
    )
    assert_refused(toolchain("check", tmp_path / "new"), tmp_path / "new", "does not exist", "model.py")


def test_check_names_an_interrupted_build(tmp_path):
    (tmp_path / UNFINISHED).touch()
    checked = toolchain("check", tmp_path)
    assert checked.exit_code == 2
    assert f"the build of {tmp_path} has not ended or was interrupted" in checked.stdout


@pytest.mark.parametrize("at", [0, 2, 4], ids=TARGET[::2])
def test_a_target_with_a_part_missing(case, at):
    assert_refused(build(case, target=TARGET[:at] + TARGET[at + 2 :]), f"{TARGET[at]} is missing")


@pytest.mark.thorough
def test_a_subscriber_loads_no_numpy():
    code = "import sys, toolchain.deployment.address; sys.exit('numpy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PROCESS_PATIENCE)


@pytest.mark.parametrize(
    "command", [["check"], ["inspect"], ["regenerate", "project"], ["build", "-o", "out", *TARGET]]
)
def test_a_path_that_the_system_refuses_is_one_sentence(command):
    assert_refused(toolchain(*command, "x" * 300), "File name too long")
