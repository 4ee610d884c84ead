""".ci/run: its stages and their exit codes, with stand-ins for the commands that it runs."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

RUN = Path(__file__).parents[1] / ".ci" / "run"
COMMANDS = (
    *("scripts/environment", "scripts/container-engine", "scripts/docs", "scripts/test", "scripts/verify"),
    *("scripts/campaign", "bin/apt-get", "bin/ruff", "bin/mypy", "bin/lint-imports", "bin/sleep"),
)
STAND_IN = """#!/bin/bash
echo "$(basename "$0") $*" >>"{calls}"
[ "$(basename "$0") $*" != "$FAILS" ] || {{ echo "FAILED this::one - why"; exit "$WITH"; }}
"""


@pytest.mark.process
def test_each_stage_has_its_exit_code_and_names_what_failed(tmp_path):
    (tmp_path / ".ci").mkdir()
    shutil.copy(RUN, tmp_path / ".ci")
    calls = tmp_path / "calls"
    for command in COMMANDS:
        path = tmp_path / command
        path.parent.mkdir(exist_ok=True)
        path.write_text(STAND_IN.format(calls=calls))
        path.chmod(0o755)
    (tmp_path / "scripts/environment").write_text('[ "$FAILS" != environment ] || exit 2\n')

    def run(fails: str = "", code: int = 1) -> tuple[int, str]:
        calls.write_text("")
        path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", ".ci/run"],
            cwd=tmp_path,
            env=os.environ | {"PATH": path, "FAILS": fails, "WITH": str(code)},
            capture_output=True,
            text=True,
            timeout=PROCESS_PATIENCE,
            check=False,
        )
        return done.returncode, done.stdout

    assert run()[0] == 0
    for fails, expected in {
        "environment": 10,
        "container-engine install": 10,
        "verify containers --fetch": 10,
        "ruff format --check .": 11,
        "ruff check .": 11,
        "mypy ": 11,
        "lint-imports ": 11,
        "docs ": 12,
        "test ": 20,
        "verify containers --short": 30,
        "campaign --short": 40,
    }.items():
        code, said = run(fails)
        assert code == expected, said
        assert expected == 10 or any("FAILED this::one" in line for line in said.splitlines()[-20:-1])
    run("container-engine install")
    assert calls.read_text().count("container-engine install") == 3
    assert run("verify containers --short", 3)[0] == 10  # a download within a later stage
    code, said = run("container-engine able", 4)
    assert (code, "containers: skipped" in said, "verify" in calls.read_text()) == (0, True, False)
