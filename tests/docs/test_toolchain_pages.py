"""The toolchain's pages: every key, option, check and constant is described, and the examples run."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel
from typer.main import get_command

from tests.toolchain.running import TARGET, assert_refused, toolchain
from toolchain.building.build import assemble
from toolchain.building.machine import plan_machine
from toolchain.building.options import BuildOptions, read_sources
from toolchain.checks.finding import Check
from toolchain.commands.main import app
from toolchain.deployment import DeploymentFile, Variable
from toolchain.errors import ModelError
from toolchain.models.case_study import load_model
from toolchain.models.model import Known, Model, dimension
from toolchain.outputs.vhdl_parameters import parameters_vhd

DOCS = Path(__file__).parents[2] / "docs"
DEPLOYMENT = (DOCS / "reference" / "deployment.md").read_text()
TOOLCHAIN = (DOCS / "reference" / "toolchain.md").read_text()


def documented(text, heading):
    section = re.split(r"\n##+ ", text.split(f"\n## {heading}", 1)[1], maxsplit=1)[0]
    return [
        key
        for row in re.findall(r"^\| (`.+?) \|", section, re.MULTILINE)
        for key in re.findall(r"`([^`]+)`", row)
    ]


def sections():
    plain = []
    for name, field in DeploymentFile.model_fields.items():
        inner = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [each for each in inner if isinstance(each, type) and issubclass(each, BaseModel)]
        key = str(field.validation_alias or name)
        if models:
            single = inner[0] is models[0] or type(None) in inner
            header = f"`[{key}]`" if single else f"`[[{key}]]`"
            yield pytest.param(header, list(models[0].model_fields), id=key)
        else:
            plain.append(key)
    yield pytest.param("Top level", plain, id="top")


@pytest.mark.parametrize(("heading", "keys"), list(sections()))
def test_every_key_of_the_deployment(heading, keys):
    assert sorted(documented(DEPLOYMENT, heading)) == sorted(keys)


def options_of(*path):
    command = get_command(app)
    for name in path:
        command = command.commands[name]
    names = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return {name for name in names if name.startswith("-")} - {"--help", "-h"}


@pytest.mark.parametrize(
    ("command", "page", "heading"),
    [("build", "reference/toolchain.md", "Options"), ("fit", "how-to/models.md", "6. Learning the tables")],
)
def test_every_option_of_a_command(command, page, heading):
    described = documented((DOCS / page).read_text(), heading)
    assert {key.split(" ")[0] for key in described} == options_of(command)


@pytest.mark.parametrize("part", ["memories", "project", "deployment"])
def test_every_option_of_regenerate(part):
    section = TOOLCHAIN.split("\n## One part again", 1)[1].split("\n## ", 1)[0]
    question = {"--set", "--searched", "--known", "--given", "--prior-select", "--on-missing"}
    for name in options_of("regenerate", part) - question:
        assert name in section


def test_the_example_is_a_model(tmp_path):
    example = re.search(r"```python\n(.*?)```", TOOLCHAIN, re.DOTALL)[1]
    (tmp_path / "model.py").write_text(example)
    model = load_model(tmp_path, {"cells": "7"})
    assert model.lines == 7
    assert [known.name for known in model.known] == ["range", "door"]


MODELS = (DOCS / "how-to" / "models.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", MODELS, re.DOTALL)


def use_fit(path, printed):
    """Change a model as a page prints it: imports and the head of `model()` before its `...`, and its last line."""
    imports, signature, last = re.fullmatch(
        r"(.*?)\n\n\n(def .*?\n)    \.\.\.\n(.*)", printed, re.DOTALL
    ).groups()
    text = path.read_text()
    for old, new in ((r"def model\(.*\n", signature), (r"    return joint\.ask\(.*\n", last)):
        text, found = re.subn(old, lambda _, new=new: new, text)
        assert found == 1
    path.write_text(text.replace("\nimport numpy", f"\n{imports}\nimport numpy", 1))


def test_the_models_page_works_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    models = tmp_path / "models"
    for name in ("mymodel", "boiler"):
        (models / name).mkdir(parents=True)
    for name, language in (("garden.bif", "bif"), ("mymodel/walks.csv", "csv")):
        (text,) = blocks(language)
        (models / name).write_text(text)
    boiler, fitting = blocks("python")
    (models / "boiler" / "model.py").write_text(boiler)
    commands = re.findall(r"^    (toolchain .*)$", MODELS, re.MULTILINE)
    assert len(commands) == 8
    for command in commands:
        if "fit=" in command:
            use_fit(models / "mymodel" / "model.py", fitting)
        result = toolchain(*shlex.split(command)[1:])
        assert result.exit_code == 0, f"{command}\n{result.stderr}"
    fitted = load_model(models / "mymodel", {"fit": "models/mymodel/walks.toml"})
    assert fitted.known[0].normal.sigma.max() < 0.2


def test_the_boiler_is_a_question_with_the_printed_refusal(tmp_path):
    example, _ = blocks("python")
    (tmp_path / "model.py").write_text(example)
    model = load_model(tmp_path, {"gauge_sigma": "0.3"})
    assert [dimension.label for dimension in model.searched] == ["pressure", "inside"]
    (tmp_path / "model.py").write_text(example.replace("searched=[pressure, inside]", "searched=[pressure]"))
    with pytest.raises(ModelError) as caught:
        load_model(tmp_path, {})
    assert f"error: {caught.value}\n" in MODELS


def test_every_check_is_described():
    described = documented(TOOLCHAIN, "Checks before anything runs")
    assert set(described) == set(Check) - {Check.RNG}


def test_every_constant_of_the_parameters():
    text = parameters_vhd(*built_for_the_documentation())
    constants = set(re.findall(r"^  constant (\w+)", text, re.MULTILINE))
    assert set(documented((DOCS / "reference" / "outputs.md").read_text(), "bm1_parameters.vhd")) == constants


def built_for_the_documentation():
    known = Known(name="K", table=np.full((2, 2), 0.5))
    model = Model(name="m", searched=(dimension("s", size=2),), known=(known,))
    built = assemble(plan_machine(model, BuildOptions(uri="ws://robot:9090", topic="/readings", type="a/B")))
    return built.deployment, built.images


def test_the_sources_of_the_deployment_page(tmp_path):
    (example,) = re.findall(r"^```toml\n(.*?)^```", DEPLOYMENT, re.MULTILINE | re.DOTALL)
    (tmp_path / "sources.toml").write_text(example)
    file = read_sources(tmp_path / "sources.toml", "ws://robot:9090")
    names = ("ahead", "colour", "left", "near", "turn")
    placed = file.place(tuple(Variable(name=name, bits=3, values=4) for name in names))
    assert [(each.source, each.path) for each in placed] == [
        (1, "ranges[0]"),
        (3, "data[2]"),
        (1, "ranges[90]"),
        (0, "range"),
        (2, "angular_velocity.z"),
    ]
    assert file.sources[1].uri == "ws://lidar-computer:9090"


@pytest.mark.parametrize("mode", ["cell", "threshold"])
def test_inspect_explains_the_disparity_model(tmp_path, mode):
    (example,) = re.findall(r"```python\n(# disparity/model\.py.*?)```", TOOLCHAIN, re.DOTALL)
    model, out = tmp_path / "disparity", tmp_path / "out"
    model.mkdir()
    (model / "model.py").write_text(example)
    built = toolchain("build", model, "-o", out, *TARGET, "--sensor-mode", mode, "--replicas", 3)
    assert built.exit_code == 0, built.output
    looked = toolchain("inspect", out, "--frames", 5)
    if mode == "threshold":
        assert_refused(looked, "--model")
    else:
        assert looked.exit_code == 0, looked.output
        assert "5 frames of readings for 3 replicas, drawn from" in looked.stdout
    named = toolchain("inspect", out, "--frames", 5, "--model", model, "--json")
    assert named.exit_code == 0, named.output
    # lines that all read the same would have nothing to be wrong about
    assert 0.001 < json.loads(named.stdout)["accuracy"]["machine"]["total_variation"]["value"] < 0.1
    assert_refused(toolchain("inspect", out, "--readings", tmp_path / "r.csv"), "r.csv")
