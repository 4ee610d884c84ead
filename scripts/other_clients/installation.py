"""Installation of other projects' clients: roslibpy from PyPI and roslib from npm, pinned by hash."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

from services.errors import SettingsError

HERE = Path(__file__).resolve().parent
LOCK = HERE / "roslibpy.lock"
PACKAGES = HERE / "roslib"
HOME_VARIABLE = "ROSBAYES_CONFORMANCE_HOME"
LAYOUT = "1"
"""Version of the installed folders, incremented when their content changes for the same locks."""
DOWNLOAD_LIMIT = 600
OLDEST_NODE = 20


def home() -> Path:
    """Return the folder in which the clients are installed."""
    if chosen := os.environ.get(HOME_VARIABLE):
        return Path(chosen).expanduser().absolute()
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache).absolute() / "rosbayes" / "conformance"


def installed(name: str, *locks: Path) -> tuple[Path, bool]:
    """Return the folder for the packages of these lock files, and whether it is complete."""
    digest = hashlib.sha256(LAYOUT.encode() + b"".join(lock.read_bytes() for lock in locks)).hexdigest()[:12]
    folder = home() / f"{name}-{digest}"
    return folder, (folder / ".complete").exists()


def run(*command: str | Path, cwd: Path | None = None) -> None:
    """Run an installer.

    Raises:
        SettingsError: It fails or does not end in time.
    """
    shown = " ".join(str(word) for word in command[:4])
    try:
        subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True, timeout=DOWNLOAD_LIMIT)
    except subprocess.TimeoutExpired as error:
        raise SettingsError(f"`{shown} ...` did not end within {DOWNLOAD_LIMIT} s; try again") from error
    except subprocess.CalledProcessError as error:
        lines = [line for line in error.stderr.splitlines() if re.match(r"(ERROR|npm error)", line)]
        said = (lines or error.stderr.splitlines() or [f"exit code {error.returncode}"])[0]
        raise SettingsError(f"`{shown} ...` failed: {said}") from error


def begin(folder: Path, what: str) -> None:
    """Create an empty folder for an installation, and print a line about it."""
    print(f"installing {what} into {folder} (once) ...", file=sys.stderr)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)


def install_roslibpy() -> Path:
    """Return the folder with roslibpy's environment (venv) and source package (source), installed if missing."""
    folder, complete = installed("roslibpy", LOCK)
    if complete:
        return folder
    begin(folder, "roslibpy")
    run(sys.executable, "-m", "venv", folder / "venv")
    pip = (folder / "venv" / "bin" / "python", "-m", "pip", "-q", "--disable-pip-version-check")
    run(*pip, "install", "--require-hashes", "--no-deps", "-r", LOCK)
    # only the block of roslibpy, whose hashes are those of the wheel and of the source package
    block = re.search(r"^roslibpy==(?:.*\\\n)+.*\n", LOCK.read_text(), re.MULTILINE)
    assert block is not None
    (folder / "source.lock").write_text(block[0])
    run(
        *(*pip, "download", "--require-hashes", "--no-deps", "--no-binary", ":all:", "--no-build-isolation"),
        *("-r", folder / "source.lock", "-d", folder),
    )
    (archive,) = folder.glob("roslibpy-*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    (unpacked,) = (path for path in folder.glob("roslibpy-*") if path.is_dir())
    unpacked.rename(folder / "source")
    (folder / ".complete").touch()
    return folder


def install_roslib() -> Path:
    """Return the module of roslib, installed if missing.

    Raises:
        SettingsError: Node is missing or too old.
    """
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        raise SettingsError(
            f"roslib needs Node {OLDEST_NODE} or later with npm, which are not on PATH: install them (Debian: apt-get install nodejs npm), or use --only roslibpy"
        )
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True, timeout=30)
    if int(re.sub(r"^v(\d+).*\n", r"\1", version.stdout)) < OLDEST_NODE:
        raise SettingsError(
            f"roslib needs Node {OLDEST_NODE} or later, this is {version.stdout.strip()}: install a newer one, or use --only roslibpy"
        )
    locks = (PACKAGES / "package.json", PACKAGES / "package-lock.json")
    folder, complete = installed("roslib", *locks)
    if not complete:
        begin(folder, "roslib")
        for lock in locks:
            shutil.copy(lock, folder)
        run(npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", cwd=folder)
        (folder / ".complete").touch()
    return folder / "node_modules" / "roslib" / "dist" / "RosLib.js"
