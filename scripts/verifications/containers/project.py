"""The sources of the image: the project's files, and the wheels of the lock file."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

from scripts.running.processes import ROOT
from scripts.verifications.checks import expect

FETCH_LIMIT: Final = 600.0


def copy_project(folder: Path, wheels: Path) -> None:
    """Copy the image's sources: the files known to git, and the wheels, because builds here have no network."""
    shutil.rmtree(folder, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        check=True,
        timeout=60,
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    shutil.copytree(wheels, folder / "wheelhouse")


def fetch_wheels(folder: Path) -> None:
    """Download the wheels of the lock file, with hashes checked, for the image's Python.

    Raises:
        CheckError: pip cannot download them.
    """
    lock = ROOT / "requirements.lock"
    made = folder / ".made"
    stamp = hashlib.sha256(lock.read_bytes()).hexdigest()
    if made.exists() and made.read_text() == stamp:
        return
    shutil.rmtree(folder, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    what = ["--require-hashes", "--no-deps", "--only-binary", ":all:", "--python-version", "3.11"]
    done = subprocess.run(
        [*pip, *what, "--dest", str(folder), "--requirement", str(lock)],
        stderr=subprocess.PIPE,
        text=True,
        timeout=FETCH_LIMIT,
        check=False,
    )
    expect(done.returncode == 0, f"pip could not get the wheels of {lock.name}: {done.stderr.strip()[-500:]}")
    made.write_text(stamp)
