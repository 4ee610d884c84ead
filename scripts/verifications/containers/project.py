"""The sources of the container image, the wheels of its lock file, and time limits for this machine."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

from scripts.running.patience import FACTOR, PRODUCT_LIMITS
from scripts.running.script import ROOT
from scripts.verifications.checks import DownloadError

FETCH_LIMIT: Final = 600.0 * FACTOR
STOP_GRACE: Final = 60 * FACTOR
"""Seconds after SIGTERM at which the engine kills a service that is still running (exit code 137)."""
PROBED: Final = (
    *("master", "subscriber", "publisher", "pcie-app", "boards"),
    *("hub", "boat-simulator", "boat-normaliser", "boat-viewer", "dashboard"),
)
PROBE: Final = {
    "interval": f"{15 * FACTOR:g}s",
    "timeout": f"{30 * FACTOR:g}s",
    "retries": 4,
    "start_period": f"{240 * FACTOR:g}s",
}
"""Settings of health checks. Probes take CPU time, so a slow machine makes fewer."""


def home() -> Path:
    """Return the folder of the engine, as scripts/container-engine determines it."""
    if given := os.environ.get("ROSBAYES_ENGINE_HOME"):
        return Path(given)
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path.home() / ".cache") / "rosbayes" / "engine"


def copy_project(folder: Path) -> None:
    """Copy the image's sources: the files known to git, and the wheels, because builds here have no network."""
    shutil.rmtree(folder, ignore_errors=True)
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.check_output(command, cwd=ROOT, timeout=60 * FACTOR).decode()
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    shutil.copytree(home() / "wheels", folder / "wheelhouse")
    # JSON is YAML; limits that a slow machine does not reach
    limits = {name: f"{limit:g}" for name, limit in PRODUCT_LIMITS.items()}
    limits |= {"BM_BOARD_TIMEOUT": f"{5 * FACTOR:g}", "BM_READY_TIMEOUT": f"{10 * FACTOR:g}"}
    services = {
        name: {
            "stop_grace_period": f"{STOP_GRACE:g}s",
            "environment": limits,
            "healthcheck": PROBE | {"start_interval": f"{(1 if name == 'hub' else 3) * FACTOR:g}s"},
        }
        for name in PROBED
    }
    (folder / "compose.override.yaml").write_text(json.dumps({"services": services}))


def fetch_wheels() -> None:
    """Download the wheels of the lock file for the image's Python, or raise a DownloadError; pip checks the hashes."""
    folder, lock = home() / "wheels", ROOT / "requirements-image.lock"
    made = folder / ".made"
    stamp = hashlib.sha256(lock.read_bytes()).hexdigest()
    if made.exists() and made.read_text() == stamp:
        return
    shutil.rmtree(folder, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    what = ["--require-hashes", "--no-deps", "--only-binary", ":all:", "--python-version", "3.11"]
    command = [*pip, *what, "--dest", str(folder), "--requirement", str(lock)]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=FETCH_LIMIT, check=False)
    if done.returncode:
        raise DownloadError(f"pip could not get the wheels of {lock.name}: {done.stderr.strip()[-500:]}")
    made.write_text(stamp)
