"""Regenerating one part of a deployment: it changes, the other bytes stay, and every file is reported."""

import shlex

import pytest

from tests.toolchain.running import TARGET, assert_refused, contents, done, toolchain
from toolchain.building.machine import MachinePlan
from toolchain.building.options import DeploymentEdits
from toolchain.building.regenerate import edited
from toolchain.deployment import load_deployment
from toolchain.errors import DamagedDeploymentError

MODEL = """
import numpy as np
from toolchain.models import *

def model(sigma: float = 1.0, values: int = 12, cells: int = 8, swapped: bool = False, other: str = "D2"):
    place = Symbol("x", IntervalType(0, 10, cells))
    one = Symbol("D1", IntegerType(0, values - 1), path="data[0]", on_range="clamp")
    two = Symbol(other, IntegerType(0, 11), path="data[1]", on_range="clamp")
    joint = JointDistribution("small", (
        uniform(place),
        conditional_normal(one, [place], mean=lambda x: x, sigma=sigma, floor=0.05),
        conditional_normal(two, [place], mean=lambda x: 10 - x, sigma=2.0, floor=0.05),
    ))
    return joint.ask(searched=[place], known=[two, one] if swapped else [one, two])
"""
OPTIONS = ("--partitions", "2", "--scale", "column", "--bits", "D1=6", "--prob-bits", "7")


def build(case, name, *arguments):
    out = case.parent / name
    done(toolchain("build", case, "-o", out, *TARGET, *arguments))
    return out


@pytest.fixture
def built(case):
    return build(case, "out", *OPTIONS)


def regenerate(part, built, *arguments, code=0):
    result = toolchain("regenerate", part, built, "--verbose", *arguments)
    assert result.exit_code == code, result.output
    return result


def changes(result):
    return {
        line.split()[1]: line.split()[0] for line in result.stdout.splitlines() if not line.startswith(" ")
    }


def test_memories_from_the_images(built):
    before = contents(built)
    folder = built / "bm_arch" / "Memory_MIFs"
    (folder / "board1_prior.mif").unlink()
    (folder / "board0_column1.mif").write_text("something else")
    (folder / "board7_column9.mif").write_text("from another build")
    (folder / "notes.txt").write_text("the user's")
    times = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    found = changes(regenerate("memories", built))
    prefix = "bm_arch/Memory_MIFs/"
    assert {name: change for name, change in found.items() if change != "unchanged"} == {
        prefix + "board1_prior.mif": "new",
        prefix + "board0_column1.mif": "changed",
        prefix + "board7_column9.mif": "removed",
    }
    assert set(found) == {name for name in before if name.startswith("bm_arch")} | {
        prefix + "board7_column9.mif"
    }
    assert contents(built) == before | {prefix + "notes.txt": b"the user's"}
    unchanged = folder / "board0_prior.mif"
    assert unchanged.stat().st_mtime_ns == times[unchanged]


def test_memories_from_the_model(case, built):
    """The tables are new, what a user has set in deployment.toml stays, and it is as if built so at once."""
    regenerate("deployment", built, "--topic", "/elsewhere", "--path", "D1=data[7]")
    path = built / "deployment.toml"
    text = path.read_text().replace("ws://robot:9090", "ws://other:1")
    text = text.replace('endpoint = ""', 'endpoint = "tcp://board:1"', 1).replace(
        "values =", 'unit = "m"\nvalues =', 1
    )
    path.write_text(f"{text}\n[topics]\npose = false\n")
    result = regenerate("memories", built, "--model", case, "--set", "sigma=0.5")
    found = changes(result)
    assert found["boards/board0.bm"] == found["deployment.toml"] == found["report.txt"] == "changed"
    assert found["bm_arch/Memory_MIFs/board0_column1.mif"] == "changed"
    assert found["bm_arch/Memory_MIFs/board0_column2.mif"] == "unchanged"
    deployment = load_deployment(built)
    assert deployment.sources[0].topic == "/elsewhere"
    assert deployment.sources[0].uri == "ws://other:1"
    assert [board.endpoint for board in deployment.boards] == ["tcp://board:1", ""]
    assert [variable.path for variable in deployment.variables] == ["data[7]", "data[1]"]
    assert [variable.unit for variable in deployment.variables] == ["m", ""]
    assert deployment.topics.pose is False
    assert [variable.bits for variable in deployment.variables] == [6, 4]
    once = build(case, "once", *OPTIONS, "--set", "sigma=0.5")
    same = contents(once)
    for name in ("deployment.toml", "report.txt"):  # topics and hashes differ, what was lost does not
        del same[name]
    lost = [(folder / "report.txt").read_text().split("\n\n")[3:5] for folder in (built, once)]
    assert lost[0] == lost[1]
    assert {name: content for name, content in contents(built).items() if name in same} == same
    regenerate("memories", built, "--model", case, "--set", "swapped=true")
    assert [(each.name, each.path, each.bits) for each in load_deployment(built).variables] == [
        ("D2", "data[1]", 4),
        ("D1", "data[7]", 6),
    ]


def test_a_wrong_order_of_readings_is_mended_without_touching_the_rest(built):
    before = contents(built)
    result = regenerate("deployment", built, "--order", "D2,D1")
    assert changes(result) == {"deployment.toml": "changed"}
    assert '-name = "D1"' in result.stdout
    after = contents(built)
    assert {name for name in before if before[name] != after[name]} == {"deployment.toml"}
    regenerate("deployment", built, "--order", "D1,D2")
    assert contents(built) == before


PLACES = ("--order", "D2,D1", "--path", "D1=data[7]")


def test_what_a_build_was_told_about_places_is_not_asked_again(case, built):
    """The flags mean the same in both commands, and new tables keep the order and paths, as readings go by them."""
    once = build(case, "once", *OPTIONS, *PLACES)
    regenerate("deployment", built, *PLACES)
    assert (once / "deployment.toml").read_bytes() == (built / "deployment.toml").read_bytes()
    assert "D2 (table of D1), D1 (table of D2)" in (once / "report.txt").read_text()
    before = contents(once)
    regenerate("memories", once, "--model", case)
    assert contents(once) == before
    regenerate("memories", once, "--model", case, "--set", "sigma=0.5")
    found = [(each.name, each.path, each.bits, each.table_of) for each in load_deployment(once).variables]
    assert found == [("D2", "data[1]", 6, "D1"), ("D1", "data[7]", 4, "D2")]
    regenerate("deployment", once, "--order", "D1,D2")
    assert [each.table_of for each in load_deployment(once).variables] == [None, None]


def test_how_the_model_was_read_is_not_asked_again(case, network):
    """Neither new tables nor an inspection needs the flags of the build, and a given one replaces its own alone."""
    out = build(case, "once", "--set", "sigma=0.5", "--set", "cells=6", "--bits", "D1=6")
    before = contents(out)
    regenerate("memories", out, "--model", case)
    assert contents(out) == before
    done(toolchain("inspect", out, "--model", case, "--frames", 2))
    regenerate("memories", out, "--model", case, "--set", "sigma=2.0")
    told = load_deployment(out).model
    assert (told.settings, told.bits) == (("sigma=2.0", "cells=6"), ("D1=6",))
    assert load_deployment(out).machine.lines == 6
    asked = shlex.split("--searched rain --known grass,shoes --given sprinkler=on --on-missing missing")
    out = build(network, "garden", *asked)
    before = contents(out)
    regenerate("memories", out, "--model", network)
    assert contents(out) == before
    done(toolchain("inspect", out, "--model", network, "--frames", 2))


@pytest.mark.parametrize("wrong", [("--order", "D1,D22"), ("--path", "D22=data[1]")])
def test_a_misspelt_variable_is_named_with_the_nearest_one(case, built, wrong, monkeypatch):
    """Before the tables are computed, which may take minutes."""
    monkeypatch.setattr(MachinePlan, "quantised", None)
    for result in (
        toolchain("build", case, "-o", case.parent / "new", *TARGET, *wrong),
        regenerate("deployment", built, *wrong, code=2),
    ):
        assert_refused(result, wrong[0], "did you mean 'D2'?")
        assert "Quantising" not in result.stderr
    assert not (case.parent / "new").exists()


def test_every_edit_of_the_deployment(built):
    regenerate(
        "deployment",
        built,
        *("--uri", "wss://a:1", "--topic", "/b", "--type", "c/D", "--output", "/e", "--path", "D2=f.g"),
        *("--target-count", 9, "--max-cycles", 99, "--stop", "own", "--queue", "all", "--tolerance", 0.5),
    )
    deployment = load_deployment(built)
    source, machine = deployment.sources[0], deployment.machine
    assert (source.uri, source.topic, source.type) == ("wss://a:1", "/b", "c/D")
    assert (deployment.outputs[0].topic, deployment.variables[1].path) == ("/e", "f.g")
    assert (machine.target_count, machine.max_cycles, machine.stop) == (9, 99, "own")
    assert (deployment.queue, deployment.tolerance_s) == ("all", 0.5)


def test_an_edit_by_hand_is_kept_where_the_images_agree(built):
    path = built / "deployment.toml"
    path.write_text(path.read_text().replace("max_cycles = 131072", "max_cycles = 7"))
    with pytest.raises(DamagedDeploymentError, match="toolchain regenerate deployment"):
        load_deployment(built)
    regenerate("deployment", built)
    assert load_deployment(built).machine.max_cycles == 7


def test_the_same_model_changes_nothing(case):
    out = build(case, "again")
    before = contents(out)
    for _ in range(2):
        assert set(changes(regenerate("memories", out, "--model", case)).values()) == {"unchanged"}
    assert contents(out) == before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("bits = 6", "bits = 5"),
        ("prob_bits = 7", "prob_bits = 6"),
        ('interface = "', 'interface = "1'),
        ("steps_per_clock = 8", "steps_per_clock = 1"),
        ("boards/board0.bm", "boards/board1.bm"),
        ("kind = ", "knid = "),
    ],
)
def test_an_edit_by_hand_that_the_images_contradict(built, old, new):
    path = built / "deployment.toml"
    path.write_text(path.read_text().replace(old, new, 1))
    before = contents(built)
    regenerate("deployment", built, code=2)
    assert contents(built) == before


def test_a_column_takes_the_source_of_the_variable_that_it_reads(built):
    deployment = load_deployment(built)
    one, two = deployment.variables
    sources = (deployment.sources[0], deployment.sources[0].replace(topic="/other"))
    deployment = deployment.replace(sources=sources, variables=(one, two.replace(source=1, path="data[1]")))
    changed = edited(deployment, DeploymentEdits(order=f"{two.name},{one.name}")).variables
    assert [(each.name, each.source, each.path) for each in changed] == [
        (two.name, 1, "data[1]"),
        (one.name, 0, one.path),
    ]
    assert [each.bits for each in changed] == [one.bits, two.bits]


def test_the_project(case, built):
    before = contents(built)
    (built / "bm1.qpf").unlink()
    (built / "bm1_board5.qsf").touch()
    assert changes(regenerate("project", built)) == {
        "bm1.qpf": "new",
        "bm1.tcl": "unchanged",
        "bm1_board0.qsf": "unchanged",
        "bm1_board1.qsf": "unchanged",
        "bm1_board5.qsf": "removed",
    }
    assert contents(built) == before
    result = regenerate("project", build(case, "emulated", "--rng", "ideal"))
    assert result.stdout == ""
    assert "there is no project" in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["deployment", "--order", "D1"],
        ["deployment", "--order", "D1,D1"],
        ["deployment", "--path", "D3=x"],
        ["deployment", "--path", "D1=a..b"],
        ["deployment", "--uri", "robot"],
        ["deployment", "--target-count", "256"],
        ["memories", "--set", "sigma=1"],
        ["memories", "--model", "{case}", "--set", "cells=9"],
        ["memories", "--model", "{case}", "--set", "other=D3"],
        ["memories", "--model", "{case}", "--set", "values=99"],
        ["memories", "--model", "{case}/none"],
    ],
)
def test_mistakes_change_nothing(case, built, arguments):
    before = contents(built)
    part, *rest = (argument.format(case=case) for argument in arguments)
    result = regenerate(part, built, *rest, code=2)
    assert result.stderr.startswith("error: ")
    assert contents(built) == before
