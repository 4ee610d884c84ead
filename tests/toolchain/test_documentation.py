"""The pages of documentation say what the code does: every key, every option, and an example that runs."""

import re
from pathlib import Path

import pytest
import typer
from pydantic import BaseModel

from toolchain.case_study import load_model
from toolchain.command import app
from toolchain.deployment import DeploymentFile

DOCS = Path(__file__).parents[2] / "docs"


def documented(text, heading):
    section = text.split(f"\n## {heading}", 1)[1].split("\n## ", 1)[0]
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
    assert sorted(documented((DOCS / "deployment.md").read_text(), heading)) == sorted(keys)


def test_every_option_of_the_build():
    build = typer.main.get_command(app).commands["build"]
    options = {
        name for each in build.params for name in each.opts if name.startswith("-") and each.name != "help"
    }
    described = documented((DOCS / "toolchain.md").read_text(), "Options")
    assert {key.split(" ")[0] for key in described} == options


def test_the_example_is_a_model(tmp_path):
    example = re.search(r"```python\n(.*?)```", (DOCS / "toolchain.md").read_text(), re.DOTALL)[1]
    (tmp_path / "model.py").write_text(example)
    model = load_model(tmp_path, {"cells": "7"})
    assert model.lines == 7
    assert [known.name for known in model.known] == ["range", "door"]
