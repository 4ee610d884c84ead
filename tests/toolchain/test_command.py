"""The toolchain command: the report on stdout, all else on stderr, one sentence and exit code 2 for a mistake."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pcie_shim.programming_file import read_image
from tests.command_runner import invoke
from toolchain.commands.main import app
from toolchain.deployment import load_deployment
from toolchain.outputs.mif import read_mif

MODEL = """
import numpy as np
from toolchain.models.model import Known, Model, dimension

def model(size: int = 4):
    return Model(name="tiny", searched=(dimension("s", size=size),),
                 known=(Known(name="K", table=np.full((2, size), 0.5)),))
"""
TARGET = ["--uri", "ws://robot:9090", "--topic", "/readings", "--type", "std_msgs/msg/Float64"]
BOAT = Path(__file__).parents[2] / "casestudies" / "boat"


def build(case, *arguments, target=TARGET):
    return invoke(app, ["build", str(case), "-o", str(case.parent / "out"), *target, *arguments])


def test_a_build(case):
    result = build(case, "--partitions", "2", "--set", "size=6", "--queue", "all", "--interface", "1x3")
    assert result.exit_code == 0, result.stderr
    out = case.parent / "out"
    assert result.stdout == (out / "report.txt").read_text()
    assert f"Reading {case / 'model.py'}" in result.stderr
    assert f"Wrote {out / 'deployment.toml'}" in result.stderr
    deployment = load_deployment(out)
    assert [board.lines for board in deployment.boards] == [3, 3]
    assert (deployment.machine.interface, deployment.queue) == ("1x3", "all")
    assert deployment.sources[0].type == "std_msgs/msg/Float64"


def test_same_input_same_bytes_though_time_passes(case):
    os.utime(case / "model.py", (1_000_000_000, 1_000_000_000))
    build(case)
    out = case.parent / "out"
    first = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert b"2001-09-09T01:46:40Z" in first[out / "boards" / "board0.bm"]
    shutil.rmtree(out)
    build(case)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == first


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["--set", "sze=3"],
            "error: {case}/model.py: the model has no parameter 'sze'; did you mean 'size'?\n",
        ),
        (["--set", "size"], "error: --set size: expected KEY=VALUE, such as --set width=64\n"),
        (["--set", "=3"], "error: --set =3: expected KEY=VALUE"),
        (["--set", "size=3", "--set", "size=4"], "error: --set size is given twice\n"),
        (["--partitions", "5"], "error: 4 lines can't be split over 5 boards: expected 1 to 4 partitions\n"),
        (["--interface", "20"], "error: --interface: '20' is no interface; expected inputs x results"),
        (["--interface", "1x3"], "error: the model is larger than the interface 1x3"),
        (["--prob-bits", "99"], "error: prob_bits is 99"),
        (["--bits", "K"], "error: --bits K: expected KEY=VALUE, such as --bits range=8\n"),
        (["--bits", "L=3"], "error: --bits L=3: the model has no such variable; it has K\n"),
        (["--bits", "K=17"], "error: --bits K=17: expected 1 to 16 bits\n"),
        (["--bits", "K=1"], "error: variable 'K': K serves 2 values, but 1 bit holds 1 beside the address"),
        (["--steps-per-clock", "257"], "error: steps_per_clock is 257"),
        (
            ["--rng-table", "a.mif"],
            "error: --rng-table is what --rng table plays, but this is --rng lfsr32\n",
        ),
        (
            ["--rng", "table", "--rng-table", "/no.mif"],
            "error: /no.mif can't be read: No such file or directory\n",
        ),
        (
            ["--sensor-mode", "cell", "--scale", "address"],
            "error: --scale address does not go with --sensor-mode cell: lines look at different addresses",
        ),
        (["--replicas", "257"], "error: --replicas is 257, expected 1 to 256\n"),
        (["--replicas", "0"], "error: --replicas is 0, expected 1 to 256\n"),
        (
            ["--replicas", "3", "--interface", "20x11"],
            "error: the model is larger than the interface 20x11: a board needs 3 inputs and 12 results (1 known",
        ),
    ],
)
def test_mistakes(case, arguments, sentence):
    result = build(case, *arguments)
    assert result.exit_code == 2
    assert sentence.format(case=case) in result.stderr
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert not (case.parent / "out").exists()


def test_machine_options(case):
    table = case.parent / "random.mif"
    table.write_text("WIDTH=4; DEPTH=3; CONTENT BEGIN 0 : 1 F 7; END;")
    result = build(
        case,
        *("--rng", "table", "--rng-table", str(table), "--per-cell", "--steps-per-clock", "2"),
        *("--prob-bits", "3", "--bits", "K=4"),
    )
    assert result.exit_code == 0, result.stderr
    deployment = load_deployment(case.parent / "out")
    machine = deployment.machine
    assert (machine.rng, machine.shared, machine.steps_per_clock) == ("table", False, 2)
    assert deployment.variables[0].bits == 4
    parameters = read_image(deployment.image_path(0)).machine.parameters
    assert (parameters.sensor_bits, parameters.shared, parameters.steps_per_clock) == ((4,), False, 2)
    assert read_image(deployment.image_path(0)).machine.rng_table.tolist() == [1, 15, 7]
    # the memory holds what cells compare with: as many bits as a code
    assert read_mif(case.parent / "out/bm_arch/Memory_MIFs/rng_table.mif").words == (1, 7, 7)


NETWORK = """
variable rain { type discrete [ 2 ] { yes, no }; }
variable sprinkler { type discrete [ 2 ] { on, off }; }
variable grass { type discrete [ 2 ] { wet, dry }; }
variable shoes { type discrete [ 2 ] { wet, dry }; }
probability ( rain ) { table 0.2, 0.8; }
probability ( sprinkler | rain ) { (yes) 0.01, 0.99; (no) 0.4, 0.6; }
probability ( grass | sprinkler, rain ) { table 0.99 0.9 0.8 0.0 0.01 0.1 0.2 1.0; }
probability ( shoes | grass ) { (wet) 0.7, 0.3; (dry) 0.1, 0.9; }
"""


@pytest.fixture
def network(tmp_path):
    path = tmp_path / "garden.bif"
    path.write_text(NETWORK)
    return path


def test_a_network_with_a_question(network):
    result = build(network, "--searched", "rain,sprinkler", "--known", "shoes", "--on-missing", "missing")
    assert result.exit_code == 0, result.stderr
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
    question = [
        "--searched",
        "grass",
        "--known",
        "shoes",
        "--given",
        "sprinkler=on",
        "--prior-select",
        "rain",
    ]
    assert build(network, *question).exit_code == 0
    deployment = load_deployment(network.parent / "out")
    assert [(each.name, each.kind) for each in deployment.variables] == [
        ("shoes", "sensor"),
        ("rain", "prior_select"),
    ]
    assert deployment.machine.prior_bits == 2


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "garden.bif is a network: say what is searched and known, such as --searched A --known B,C"),
        (
            ["--searched", "grass", "--known", "rain,sprinkler"],
            "rain and sprinkler are not independent given grass: rain -> sprinkler joins them; leave rain",
        ),
        (["--searched", "gras"], "garden has no variable 'gras'; it has rain, sprinkler, grass, shoes"),
        (["--searched", "rain,,grass"], "--searched rain,,grass: expected names with a comma between them"),
        (
            ["--searched", "rain", "--given", "grass"],
            "--given grass: expected KEY=VALUE, such as --given smoke=yes",
        ),
        (["--searched", "rain", "--given", "grass=damp"], "grass is never 'damp'; expected wet, dry"),
        (["--searched", "rain", "--set", "size=3"], "--set size: a network's file has no parameters"),
        (["--searched", "rain", "--prior-path", "x"], "add --prior-mode written"),
    ],
)
def test_questions_that_cannot_be_built(network, arguments, sentence):
    result = build(network, *arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert not (network.parent / "out").exists()


def test_a_question_to_a_folder(case):
    result = build(case, "--searched", "s")
    assert result.exit_code == 2
    assert "--searched asks a network's file, but" in result.stderr


@pytest.mark.parametrize(
    ("option", "value"), [("--uri", "robot:9090"), ("--topic", "a b"), ("--type", "x"), ("--output", "/a b")]
)
def test_a_wrong_target_is_refused_before_the_model_is_read(case, option, value):
    (case / "model.py").write_text("raise SystemExit('the model was read')")
    target = list(TARGET)
    if option in target:
        target[target.index(option) + 1] = value
    else:
        target += [option, value]
    result = build(case, target=target)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {option}: ")


@pytest.mark.parametrize("command", [[], ["build"], ["fit"], ["new"]])
def test_short_help(command):
    result = invoke(app, [*command, "-h"])
    assert result.exit_code == 0
    assert "Usage: " in result.stdout


def test_a_written_prior(case):
    result = build(case, "--prior-mode", "written", "--prior-path", "prior.data")
    assert result.exit_code == 0, result.stderr
    assert load_deployment(case.parent / "out").prior.path == "prior.data"


def test_a_question_is_a_model_too(case):
    (case / "model.py").write_text(
        "from toolchain.models.distribution import uniform\n"
        "from toolchain.models.joint import JointDistribution\n"
        "from toolchain.models.symbol import IntegerType, Symbol\n"
        "def model():\n"
        "    return JointDistribution('q', (uniform(Symbol('s', IntegerType(1, 6))),)).ask(['s'])\n"
    )
    assert build(case).exit_code == 0
    assert load_deployment(case.parent / "out").searched[0].value(0) == 1


def test_a_folder_without_a_model(tmp_path):
    result = build(tmp_path / "nowhere")
    assert result.exit_code == 2
    assert "is no folder; expected a case study's folder" in result.stderr


@pytest.mark.parametrize("missing", ["--uri", "--topic", "--type"])
def test_what_must_be_given(case, missing):
    at = TARGET.index(missing)
    result = build(case, target=TARGET[:at] + TARGET[at + 2 :])
    assert result.exit_code == 2
    assert missing in result.stderr


def test_a_folder_that_cannot_be_written(case):
    (case.parent / "out").write_text("a file in its place")
    result = build(case)
    assert result.exit_code == 2
    assert f"error: {case.parent / 'out'} can't be written: " in result.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_end_it_with_their_code(case, number, code):
    (case / "model.py").write_text(
        "import time\n\ndef model():\n    print('here', flush=True)\n    time.sleep(60)\n"
    )
    command = [Path(sys.executable).parent / "toolchain", "build", case, "-o", case.parent / "out", *TARGET]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "here\n"
        process.send_signal(number)
        _, sentences = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == code
    assert "Traceback" not in sentences


def test_the_installed_command_has_help_with_an_example():
    command = Path(sys.executable).parent / "toolchain"
    done = subprocess.run(
        [command, "build", "--help"],
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
        env={"COLUMNS": "200"},
    )
    assert "toolchain build casestudies/boat -o build/boat --partitions 4" in done.stdout


def test_help_loads_no_numpy():
    code = "import sys, toolchain.commands.main; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=240
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
    result = invoke(app, [*arguments, name])
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "File name too long" in result.stderr
