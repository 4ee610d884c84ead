"""The Dockerfile, by its linter and by the project's own rules."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
IGNORED = (ROOT / ".dockerignore").read_text().splitlines()


@pytest.mark.thorough
def test_linter_finds_nothing():
    hadolint = Path(sys.executable).with_name("hadolint")
    done = subprocess.run(
        [hadolint, "--no-color", ROOT / "Dockerfile"],
        capture_output=True,
        check=False,
        text=True,
        timeout=PROCESS_PATIENCE,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stdout


def test_builds_without_a_registry_for_its_syntax():
    assert "syntax=" not in DOCKERFILE
    assert "--mount" not in DOCKERFILE  # the builder without BuildKit knows none


def test_one_base_image_that_can_be_chosen():
    lines = [line for line in DOCKERFILE.splitlines() if line.startswith(("ARG", "FROM"))]
    assert lines == [
        "ARG PYTHON_IMAGE=python:3.11-slim-bookworm",
        "FROM ${PYTHON_IMAGE} AS build",
        "FROM ${PYTHON_IMAGE}",
    ]


def test_last_user_is_nobody_special():
    users = [line for line in DOCKERFILE.splitlines() if line.startswith("USER")]
    assert users == ["USER 10001:10001"]


def test_wheels_are_those_of_the_lock_file():
    assert "--require-hashes" in DOCKERFILE
    assert "--only-binary :all:" in DOCKERFILE


def test_all_packages_come_into_the_image_and_little_else():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = {each.rstrip("*") for each in project["tool"]["setuptools"]["packages"]["find"]["include"]}
    assert IGNORED[1] == "*"
    folders = {line.strip("!/") for line in IGNORED if line.startswith("!") and line.endswith("/")}
    assert folders == packages | {"wheelhouse"}
    files = {line[1:] for line in IGNORED if line.startswith("!") and not line.endswith("/")}
    assert all((ROOT / file).is_file() for file in files)
