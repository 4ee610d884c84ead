"""A host that cannot run a container engine gets a sentence, which is a failure where an engine is required."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).resolve().parents[2]
# a root that may make no namespaces, as in most containers; for others nothing needs to be taken away
POWERLESS = (
    ["setpriv", "--bounding-set", "-sys_admin", "--inh-caps", "-sys_admin", "--"] if os.geteuid() == 0 else []
)


@pytest.mark.thorough
@pytest.mark.skipif(bool(POWERLESS) and not shutil.which("setpriv"), reason="setpriv is not installed")
def test_says_why_containers_cannot_be_verified():
    verify = [ROOT / ".venv" / "bin" / "python", "-P", "-m", "scripts.verifications.containers"]
    done = subprocess.run(
        [*POWERLESS, *verify], capture_output=True, check=False, text=True, timeout=PROCESS_PATIENCE, cwd=ROOT
    )
    assert done.returncode == 4
    assert done.stderr.startswith("error: no container engine can run here: ")
    assert done.stdout.splitlines()[-1].startswith("CONTAINERS WERE NOT VERIFIED")
