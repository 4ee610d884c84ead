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


def test_one_base_image_an_unprivileged_user_and_the_wheels_of_the_lock_file():
    assert [line for line in DOCKERFILE.splitlines() if line.startswith(("ARG", "FROM", "USER"))] == [
        "ARG PYTHON_IMAGE=python:3.11-slim-bookworm",
        "FROM ${PYTHON_IMAGE} AS build",
        "FROM ${PYTHON_IMAGE}",
        "USER 10001:10001",
    ]
    # a builder without BuildKit and without a registry for its syntax knows neither of the first two
    found = [each in DOCKERFILE for each in ("syntax=", "--mount", "--require-hashes", "--only-binary :all:")]
    assert found == [False, False, True, True]


def test_all_packages_come_into_the_image_and_little_else():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = {each.rstrip("*") for each in project["tool"]["setuptools"]["packages"]["find"]["include"]}
    assert IGNORED[1] == "*"
    folders = {line.strip("!/") for line in IGNORED if line.startswith("!") and line.endswith("/")}
    assert folders == packages | {"wheelhouse"}
    files = {line[1:] for line in IGNORED if line.startswith("!") and not line.endswith("/")}
    assert all((ROOT / file).is_file() for file in files)
