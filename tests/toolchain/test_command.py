"""The toolchain command: the report on stdout, all else on stderr, one sentence and exit code 2 for a mistake."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pcie_shim.programming_file import read_image
from tests.patience import PROCESS_PATIENCE
from tests.toolchain.running import TARGET, TINY, assert_refused, done, toolchain
from toolchain.deployment import load_deployment
from toolchain.outputs.mif import read_mif

MODEL = TINY
BOAT = Path(__file__).parents[2] / "casestudies" / "boat"


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
        (["--partitions", "5"], ["4 lines", "5 boards", "1 to 4"]),
        (["--interface", "20"], ["--interface", "'20'"]),
        (["--bits", "K"], ["--bits K:", "KEY=VALUE"]),
        (["--bits", "L=3"], ["--bits L=3", "it has K"]),
        (["--bits", "K=17"], ["--bits K=17", "1 to 16"]),
        (["--bits", "K=1"], ["'K'", "2 values", "1 bit holds 1"]),
        (["--rng-table", "a.mif"], ["--rng-table", "--rng lfsr32"]),
        (["--rng", "table", "--rng-table", "/no.mif"], ["/no.mif", "No such file"]),
        (["--replicas", "257"], ["--replicas", "256"]),
        (["--searched", "s"], ["--searched"]),
    ],
)
def test_mistakes(case, arguments, named):
    assert_refused(build(case, *arguments), *named)
    assert not (case.parent / "out").exists()


def test_machine_options(case):
    table = case.parent / "random.mif"
    table.write_text("WIDTH=4; DEPTH=3; CONTENT BEGIN 0 : 1 F 7; END;")
    rng = ("--rng", "table", "--rng-table", table, "--per-cell", "--steps-per-clock", "2")
    prior = ("--prior-mode", "written", "--prior-path", "prior.data")
    done(build(case, *rng, "--prob-bits", "3", "--bits", "K=4", *prior))
    deployment = load_deployment(case.parent / "out")
    machine = deployment.machine
    assert (machine.rng, machine.shared, machine.steps_per_clock) == ("table", False, 2)
    assert (deployment.variables[0].bits, deployment.prior.path) == (4, "prior.data")
    parameters = read_image(deployment.image_path(0)).machine.parameters
    assert (parameters.sensor_bits, parameters.shared, parameters.steps_per_clock) == ((4,), False, 2)
    assert read_image(deployment.image_path(0)).machine.rng_table.tolist() == [1, 15, 7]
    # the memory holds what cells compare with: as many bits as a code
    assert read_mif(case.parent / "out/bm_arch/Memory_MIFs/rng_table.mif").words == (1, 7, 7)


def test_a_network_with_a_question(network):
    result = done(
        build(network, "--searched", "rain,sprinkler", "--known", "shoes", "--on-missing", "missing")
    )
    deployment = load_deployment(network.parent / "out")
    assert deployment.name == "garden"
    assert [(each.label, each.states) for each in deployment.searched] == [
        ("rain", ("yes", "no")),
        ("sprinkler", ("on", "off")),
    ]
    (shoes,) = deployment.variables
    assert (shoes.states, shoes.on_missing, shoes.offset, shoes.step) == (("wet", "dry"), "missing", 0, 1)
    assert "  shoes: 0 wet, 1 dry\n" in result.stdout
    assert "  rain: 1 yes, 0 no\n" in result.stdout


def test_a_network_with_a_fixed_and_a_selecting_variable(network):
    question = "--searched grass --known shoes --given sprinkler=on --prior-select rain"
    done(build(network, *question.split()))
    deployment = load_deployment(network.parent / "out")
    assert [(each.name, each.kind) for each in deployment.variables] == [
        ("shoes", "sensor"),
        ("rain", "prior_select"),
    ]
    assert deployment.machine.prior_bits == 2


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], ["garden.bif", "--searched"]),
        (["--searched", "grass", "--known", "rain,sprinkler"], ["rain and sprinkler", "given grass"]),
        (["--searched", "gras"], ["'gras'", "rain, sprinkler, grass, shoes"]),
        (["--searched", "rain,,grass"], ["--searched rain,,grass"]),
        (["--searched", "rain", "--given", "grass"], ["--given grass", "KEY=VALUE"]),
        (["--searched", "rain", "--given", "grass=damp"], ["'damp'", "wet, dry"]),
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


@pytest.mark.parametrize("missing", ["--uri", "--topic", "--type"])
def test_a_target_with_a_part_missing(case, missing):
    at = TARGET.index(missing)
    assert_refused(build(case, target=TARGET[:at] + TARGET[at + 2 :]), f"{missing} is missing")


@pytest.mark.parametrize(
    ("number", "code"),
    [
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.process),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.thorough),
    ],
)
def test_signals_end_it_with_their_code(case, number, code):
    (case / "model.py").write_text(
        "import time\n\ndef model():\n    print('here', flush=True)\n    time.sleep(6000)\n"
    )
    command = [Path(sys.executable).parent / "toolchain", "build", case, "-o", case.parent / "out", *TARGET]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert "here\n" in process.stderr  # line by line, after what the command itself says
        process.send_signal(number)
        _, sentences = process.communicate(timeout=PROCESS_PATIENCE)
    assert process.returncode == code
    assert "Traceback" not in sentences


@pytest.mark.thorough
@pytest.mark.parametrize("module", ["toolchain.commands.main", "toolchain.deployment.address"])
def test_help_and_a_subscriber_load_no_numpy(module):
    code = f"import sys, {module}; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PROCESS_PATIENCE
    )
    assert done.stdout == "False\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["check"],
        ["inspect"],
        ["regenerate", "project"],
        ["build", "-o", "out", *TARGET],
        ["fit", "-o", "f.toml", "--truth", "y=a", "--truth", "x=b", str(BOAT)],
    ],
)
def test_a_path_that_the_system_refuses_is_one_sentence(arguments):
    name = "x" * 300
    result = toolchain(*arguments, name)
    assert_refused(result, "File name too long")
