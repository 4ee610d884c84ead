"""The pages of documentation say what the code does: every key, every option, and an example that runs."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import typer
from pydantic import BaseModel

from tests.command_runner import invoke
from toolchain.building.build import assemble
from toolchain.building.options import BuildOptions
from toolchain.building.sources_file import read_sources
from toolchain.checks.finding import Check
from toolchain.commands.main import app
from toolchain.deployment import DeploymentFile, Variable
from toolchain.errors import ModelError
from toolchain.models.case_study import load_model
from toolchain.models.model import Known, Model, dimension
from toolchain.outputs.vhdl_parameters import parameters_vhd

DOCS = Path(__file__).parents[2] / "docs"


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
    assert sorted(documented((DOCS / "reference/deployment.md").read_text(), heading)) == sorted(keys)


def test_every_option_of_the_build():
    build = typer.main.get_command(app).commands["build"]
    options = {
        name
        for each in build.params
        for name in (*each.opts, *each.secondary_opts)
        if name.startswith("-") and each.name != "help"
    }
    described = documented((DOCS / "reference/toolchain.md").read_text(), "Options")
    assert {key.split(" ")[0] for key in described} == options


def test_the_example_is_a_model(tmp_path):
    example = re.search(r"```python\n(.*?)```", (DOCS / "reference/toolchain.md").read_text(), re.DOTALL)[1]
    (tmp_path / "model.py").write_text(example)
    model = load_model(tmp_path, {"cells": "7"})
    assert model.lines == 7
    assert [known.name for known in model.known] == ["range", "door"]


MODELS = (DOCS / "how-to/models.md").read_text()


def test_every_option_of_the_fit():
    command = typer.main.get_command(app).commands["fit"]
    options = {name for each in command.params for name in each.opts if name.startswith("-")} - {"--help"}
    described = documented(MODELS, "6. Learning the tables")
    assert {key.split(" ")[0] for key in described} == options


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", MODELS, re.DOTALL)


def test_the_models_page_works_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "build").mkdir()
    for name, language in (("garden.bif", "bif"), ("walks.csv", "csv")):
        (text,) = blocks(language)
        (tmp_path / "build" / name).write_text(text)
    (boiler,) = blocks("python")
    (tmp_path / "build" / "boiler").mkdir()
    (tmp_path / "build" / "boiler" / "model.py").write_text(boiler)
    commands = re.findall(r"^    (toolchain .*)$", MODELS, re.MULTILINE)
    assert len(commands) == 7
    for command in commands:
        result = invoke(app, shlex.split(command)[1:])
        assert result.exit_code == 0, f"{command}\n{result.stderr}"
    text = (tmp_path / "mymodel" / "model.py").read_text()
    text = text.replace("    return joint.ask(searched=[place], known=[distance, door])\n", "")
    (hook,) = re.findall(r"^    (return with_fit.*)$", MODELS, re.MULTILINE)
    text = text.replace("sigma: float = 0.3) -> Question:", "sigma: float = 0.3, fit: Path | None = None):")
    (tmp_path / "mymodel" / "model.py").write_text(
        "from pathlib import Path\nfrom toolchain.learning.fitted import with_fit\n" + text + f"    {hook}\n"
    )
    fitted = load_model(tmp_path / "mymodel", {"fit": "build/walks.toml"})
    assert fitted.known[0].normal.sigma.max() < 0.2


def test_the_boiler_is_a_question_and_the_printed_refusal_is_said(tmp_path):
    (example,) = blocks("python")
    (tmp_path / "model.py").write_text(example)
    model = load_model(tmp_path, {"gauge_sigma": "0.3"})
    assert [dimension.label for dimension in model.searched] == ["pressure", "inside"]
    (tmp_path / "model.py").write_text(example.replace("searched=[pressure, inside]", "searched=[pressure]"))
    with pytest.raises(ModelError) as caught:
        load_model(tmp_path, {})
    assert f"error: {caught.value}\n" in MODELS


def test_every_check_is_described():
    described = documented((DOCS / "reference/toolchain.md").read_text(), "What is wrong, before anything runs")
    assert set(described) == set(Check) - {Check.RNG}


def test_every_constant_of_the_parameters():
    text = parameters_vhd(*built_for_the_documentation())
    constants = set(re.findall(r"^  constant (\w+)", text, re.MULTILINE))
    assert set(documented((DOCS / "reference/outputs.md").read_text(), "bm1_parameters.vhd")) == constants


def built_for_the_documentation():
    model = Model(
        name="m",
        searched=(dimension("s", size=2),),
        known=(Known(name="K", table=np.full((2, 2), 0.5)),),
    )
    built = assemble(model, BuildOptions(uri="ws://robot:9090", topic="/readings", type="a/B"))
    return built.deployment, built.images


@pytest.mark.parametrize("part", ["memories", "project", "deployment"])
def test_every_option_of_regenerate(part):
    text = (DOCS / "reference/toolchain.md").read_text()
    section = text.split("\n## One part again", 1)[1].split("\n## ", 1)[0]
    question = {"--set", "--searched", "--known", "--given", "--prior-select", "--on-missing", "--help", "-h"}
    command = typer.main.get_command(app).commands["regenerate"].commands[part]
    for name in {name for each in command.params for name in each.opts if name.startswith("-")} - question:
        assert name in section


def test_the_sources_of_the_deployment_page(tmp_path):
    page = (DOCS / "reference/deployment.md").read_text()
    (example,) = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
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
def test_inspect_explains_such_a_deployment(tmp_path, mode):
    page = (DOCS / "reference/toolchain.md").read_text()
    (example,) = re.findall(r"```python\n(# disparity/model\.py.*?)```", page, re.DOTALL)
    (tmp_path / "disparity").mkdir()
    (tmp_path / "disparity/model.py").write_text(example)

    flags = ["--uri", "ws://localhost:9090", "--topic", "/costs", "--type", "stereo/Costs"]
    flags += ["--sensor-mode", mode, "--replicas", "3"]
    out = tmp_path / "out"
    built = invoke(app, ["build", str(tmp_path / "disparity"), "-o", str(out), *flags])
    assert built.exit_code == 0, built.output
    looked = invoke(app, ["inspect", str(out), "--frames", "5"])
    if mode == "threshold":
        assert looked.exit_code == 2
        assert "--model" in looked.stderr
    else:
        assert looked.exit_code == 0, looked.output
        assert "Each board holds 3 of these machines around the same generators" in looked.stdout
        assert "5 frames of readings for 3 replicas, drawn from" in looked.stdout
        assert "A frame is 3 posteriors and ends with the last of them" in looked.stdout
    named = invoke(
        app, ["inspect", str(out), "--frames", "5", "--model", str(tmp_path / "disparity"), "--json"]
    )
    assert named.exit_code == 0, named.output
    # lines that all read the same would have nothing to be wrong about
    assert 0.001 < json.loads(named.stdout)["accuracy"]["machine"]["total_variation"]["value"] < 0.1
    recorded = invoke(app, ["inspect", str(out), "--readings", str(tmp_path / "r.csv")])
    assert recorded.exit_code == 2
