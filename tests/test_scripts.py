"""Every script prints its usage."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = sorted(path for path in (ROOT / "scripts").iterdir() if path.is_file() and os.access(path, os.X_OK))


PARTS = {
    "bench": (
        *("bridge", "cluster", "cycle", "dashboard", "kernel", "link", "load", "mrclam", "networks", "start"),
        *("thesis", "topics"),
    ),
    "verify": ("conformance", "containers", "hdl", "networks", "resources", "rosbridge", "tools", "wheel"),
}


@pytest.mark.thorough
def test_every_script_prints_its_usage(tmp_path):
    for script, part in [(path, part) for path in SCRIPTS for part in ("", *PARTS.get(path.name, ()))]:
        command = [script, *part.split(), "--help"]
        done = subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, timeout=PROCESS_PATIENCE, check=False
        )
        assert (done.returncode, done.stderr) == (0, ""), command
        assert script.name in done.stdout
    assert not list(tmp_path.iterdir())
