"""The image: its Dockerfile, and the machine code that its entry point selects for numba."""

import os
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
    patterns = project["tool"]["setuptools"]["packages"]["find"]["include"]
    packages = {each.partition(".")[0].rstrip("*") for each in patterns}
    assert IGNORED[1] == "*"
    folders = {line.strip("!/") for line in IGNORED if line.startswith("!") and line.endswith("/")}
    assert folders == packages | {"wheelhouse"}
    files = {line[1:] for line in IGNORED if line.startswith("!") and not line.endswith("/")}
    assert all((ROOT / file).is_file() for file in files)


SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "with-kernels"
SHOW = ["sh", "-c", 'echo "$NUMBA_CPU_NAME|$NUMBA_CPU_FEATURES|$NUMBA_CACHE_DIR|$*"', "sh", "two words"]


@pytest.fixture
def machine(tmp_path):
    """Runs the script on a machine of an architecture, with kernels for some baselines."""

    def run(architecture, baselines, command=SHOW, temporary=None):
        commands = tmp_path / f"{architecture} {baselines}"
        commands.mkdir(exist_ok=True)
        (commands / "uname").write_text(f"#!/bin/sh\necho {architecture}\n")
        (commands / "uname").chmod(0o755)
        for baseline in baselines:
            (commands / "kernels" / baseline).mkdir(parents=True, exist_ok=True)
            (commands / "kernels" / baseline / "kernel.nbc").write_text(baseline)
        environment = {
            "PATH": f"{commands}:{os.environ['PATH']}",
            "ROSBAYES_KERNELS": str(commands / "kernels"),
            "TMPDIR": str(temporary or commands),
        }
        return subprocess.run(
            [SCRIPT, *command],
            env=environment,
            capture_output=True,
            check=False,
            text=True,
            timeout=PROCESS_PATIENCE,
        )

    return run


@pytest.mark.process
def test_generic_code_for_aarch64(machine):
    done = machine("aarch64", ["generic"])
    name, features, folder, words = done.stdout.rstrip().split("|")
    assert (name, features, words, done.stderr) == ("generic", "", "two words", "")
    assert (Path(folder) / "kernel.nbc").read_text() == "generic"
    assert machine("aarch64", ["generic"], ["sh", "-c", "exit 143"]).returncode == 143


@pytest.mark.thorough
def test_the_best_baseline_that_this_processor_and_the_image_have(machine):
    flags = Path("/proc/cpuinfo").read_text()
    best = "x86-64-v3" if " avx2 " in flags and " fma " in flags else "x86-64-v2"
    for baselines, used in ((["x86-64-v2", "x86-64-v3"], best), (["x86-64-v2"], "x86-64-v2")):
        assert machine("x86_64", baselines).stdout.split("|")[0] == used


@pytest.mark.thorough
def test_runs_without_a_place_for_kernels(machine):
    done = machine("aarch64", ["generic"], temporary=Path("/proc/nowhere"))
    assert done.stdout.startswith("generic|")
    assert "kernels are compiled at every start" in done.stderr
