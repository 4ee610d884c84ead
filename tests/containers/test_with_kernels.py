"""The image's entry point: the machine code that it selects for numba."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "with-kernels"
SHOW = ["sh", "-c", 'echo "$NUMBA_CPU_NAME|$NUMBA_CPU_FEATURES|$NUMBA_CACHE_DIR|$*"', "sh", "two words"]


@pytest.fixture
def machine(tmp_path):
    """Runs the script on a machine of an architecture, with kernels for some baselines."""

    def run(architecture, baselines, command=SHOW, temporary=None):
        commands = tmp_path / "bin"
        commands.mkdir()
        (commands / "uname").write_text(f"#!/bin/sh\necho {architecture}\n")
        (commands / "uname").chmod(0o755)
        for baseline in baselines:
            (tmp_path / "kernels" / baseline).mkdir(parents=True)
            (tmp_path / "kernels" / baseline / "kernel.nbc").write_text(baseline)
        temporary = temporary or tmp_path / "scratch"
        environment = {
            "PATH": f"{commands}:{os.environ['PATH']}",
            "ROSBAYES_KERNELS": str(tmp_path / "kernels"),
            "TMPDIR": str(temporary),
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
def test_generic_code_for_aarch64(machine, tmp_path):
    done = machine("aarch64", ["generic"])
    assert done.stdout == f"generic||{tmp_path}/scratch/kernels|two words\n"
    assert (tmp_path / "scratch" / "kernels" / "kernel.nbc").read_text() == "generic"
    assert not done.stderr


@pytest.mark.thorough
def test_the_best_baseline_that_this_processor_runs(machine):
    flags = Path("/proc/cpuinfo").read_text()
    best = "x86-64-v3" if " avx2 " in flags and " fma " in flags else "x86-64-v2"
    assert machine("x86_64", ["x86-64-v2", "x86-64-v3"]).stdout.split("|")[0] == best


@pytest.mark.thorough
def test_an_image_that_was_built_on_a_lesser_processor(machine):
    assert machine("x86_64", ["x86-64-v2"]).stdout.split("|")[0] == "x86-64-v2"


@pytest.mark.thorough
def test_exit_code_is_the_commands_own(machine):
    assert machine("aarch64", ["generic"], ["sh", "-c", "exit 143"]).returncode == 143


@pytest.mark.thorough
def test_runs_without_a_place_for_kernels(machine):
    done = machine("aarch64", ["generic"], temporary=Path("/proc/nowhere"))
    assert done.stdout.startswith("generic|")
    assert "kernels are compiled at every start" in done.stderr
