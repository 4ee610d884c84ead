"""A host that cannot run a container engine gets a sentence, which is a failure where an engine is required."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).resolve().parents[2]
ENGINE = ROOT / "scripts" / "container-engine"

# a root that may make no namespaces, as in most containers; for others nothing needs to be taken away
POWERLESS = (
    ["setpriv", "--bounding-set", "-sys_admin", "--inh-caps", "-sys_admin", "--"] if os.geteuid() == 0 else []
)
needs_setpriv = pytest.mark.skipif(
    bool(POWERLESS) and not shutil.which("setpriv"), reason="setpriv is not installed"
)


def run(*command):
    return subprocess.run(
        [*POWERLESS, *command],
        capture_output=True,
        check=False,
        text=True,
        timeout=PROCESS_PATIENCE,
        cwd=ROOT,
    )


@needs_setpriv
def test_says_why_it_is_not_able():
    done = run(ENGINE, "able")
    assert done.returncode == 4
    assert done.stderr.startswith("error: no container engine can run here: ")


@needs_setpriv
def test_not_verified_is_loud():
    done = run(ROOT / ".venv" / "bin" / "python", "-P", "-m", "scripts.verifications.containers")
    assert done.returncode == 4
    assert done.stdout.splitlines()[-1].startswith("CONTAINERS WERE NOT VERIFIED")


@pytest.mark.parametrize("arguments", [(), ("run",), ("fly",)])
def test_usage(arguments):
    done = subprocess.run(
        [ENGINE, *arguments], capture_output=True, check=False, text=True, timeout=PROCESS_PATIENCE
    )
    assert done.returncode == 2
    assert done.stderr.startswith("usage: scripts/container-engine")
