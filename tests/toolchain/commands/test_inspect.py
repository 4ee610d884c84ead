"""`toolchain inspect`: its report, with and without the model, and its refusals."""

import json

import pytest

from tests.toolchain.running import TARGET, assert_refused, done, toolchain
from toolchain.analysis import with_unit
from toolchain.deployment import load_deployment


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


def test_the_overflow_is_explained_as_the_stop_rule(case, deployment):
    assert "a count reaches 255: this overflow is the stop rule" in done(look(deployment)).stdout
    own = case.parent / "own"
    done(toolchain("build", case, "-o", own, *TARGET, "--partitions", 2, "--stop", "own"))
    assert "this overflow stops that board alone (stop = own); boards without one end" in look(own).stdout


def test_json(case, deployment):
    found = json.loads(look(deployment, "--model", str(case), "--json").stdout)
    assert (found["lines"], found["columns"], found["boards"], found["clock_hz"]) == (12, 3, 2, 100e6)
    assert found["accuracy"]["frames"] == 20
    assert 0 < found["accuracy"]["machine"]["total_variation"]["value"] < 0.2
    assert [loss["name"] for loss in found["losses"]] == ["prior", "range", "loud"]
    assert all(each["fits"] for each in found["resources"])
    assert found["energy_model"]["dynamic_j"] > 0


def test_cycles_have_intervals(case, deployment):
    cycles = json.loads(look(deployment, "--json").stdout)["accuracy"]["cycles"]["percentile_95"]
    assert cycles["low"] <= cycles["value"] <= cycles["high"]
    row = next(row for row in look(deployment).stdout.splitlines() if row.startswith("  95 %"))
    assert row.endswith(f"   {cycles['low']:,.0f}..{cycles['high']:,.0f}")


LOSSY = """
from tests.toolchain.builders import posts

def model(count: int = 12):
    return posts(count)
"""


def test_lost_frames_are_said_by_build_check_and_inspect(case):
    (case / "model.py").write_text(LOSSY)
    report = build(case, "--max-cycles", 1000).stdout
    (warning,) = [row for row in report.splitlines() if "get no posterior" in row]
    assert warning.startswith("Warning: ")
    assert "(then " in warning
    rows = look(case.parent / "out", "--model", case, "--banks", 1).stdout.splitlines()
    every, alone = (
        float(row.split()[5]) for row in rows if row.startswith("  the machine against the model")
    )
    assert alone < 0.35  # the honest one is first
    assert every > 0.4
    checked = done(toolchain("check", case, "--max-cycles", 1000)).stdout
    assert warning.removeprefix("Warning: ").removesuffix(".") in checked
    assert "get no posterior" not in build(case, "--set", "count=3").stdout


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
        (["--clock", "0"], ["--clock", "greater"]),
        (["--clock", "1e13"], ["--clock", "less"]),
        (["--device", "d9"], ["--device d9", "proce-v-d8"]),
        (["--reading", "range=a"], ["--reading range=a", "--readings FILE"]),
        (["--banks", "0"], ["--banks", "greater"]),
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
    assert {value: with_unit(value, "s") for value in values} == values
    assert with_unit(100e6, "Hz") == "100 MHz"
