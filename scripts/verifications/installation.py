"""Installation of other software for verifications: packages of PyPI and npm, pinned by hash, and Debian's programs."""

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from services.errors import SettingsError

HERE: Final = Path(__file__).resolve().parent
ROSLIBPY: Final = HERE / "conformance" / "roslibpy.lock"
OLDEST_NODE: Final = 20
LIMIT: Final = 600.0
"""Time limit of one installer, in seconds."""
PIP: Final = ("-m", "pip", "-q", "--disable-pip-version-check")
PINNED: Final = ("--no-deps", "--require-hashes", "--only-binary", ":all:")
"""Flags with which pip installs only the wheels of a lock file."""


def run(*command: str | Path, cwd: Path | None = None) -> None:
    """Run an installer. Raises a SettingsError if the installer fails or does not end in time."""
    shown = " ".join(Path(word).name for word in command[:4])
    try:
        subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        raise SettingsError(f"`{shown} ...` did not end within {LIMIT:.0f} s; try again") from None
    except subprocess.CalledProcessError as error:
        lines = error.stderr.splitlines() or [f"exit code {error.returncode}"]
        said = next((line for line in lines if re.match(r"ERROR|E:|npm error", line)), lines[-1])
        raise SettingsError(f"`{shown} ...` failed: {said}") from None


def cached(name: str, locks: tuple[Path, ...], make: Callable[[Path], None]) -> Path:
    """Return the folder in $XDG_CACHE_HOME/rosbayes for these lock files, after `make` has filled it once."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "rosbayes"
    digest = hashlib.sha256(sys.version.encode() + b"".join(lock.read_bytes() for lock in locks))
    folder = home / f"{name}-{digest.hexdigest()[:12]}"
    try:
        home.mkdir(parents=True, exist_ok=True)
        with (home / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / ".complete").exists():
                print(f"installing {name} into {folder} (once) ...", file=sys.stderr)
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                (folder / ".complete").touch()
    except OSError as error:
        raise SettingsError(
            f"{error.filename or folder} cannot be written ({error.strerror}); set XDG_CACHE_HOME to another folder"
        ) from error
    return folder


def use_packages(name: str, lock: Path) -> Path:
    """Make the packages of a lock file importable, and return the folder that contains only these packages.

    The packages are installed at the first call, without their dependencies.
    """

    def make(folder: Path) -> None:
        run(sys.executable, *PIP, "install", *PINNED, "-r", lock, "--target", folder / "packages")

    packages = cached(name, (lock,), make) / "packages"
    sys.path.append(str(packages))  # last, so that all other packages come from this environment
    return packages


def install_roslibpy() -> Path:
    """Return the folder with roslibpy's environment (`venv`) and source (`source`). The first call installs both."""

    def make(folder: Path) -> None:
        run(sys.executable, "-m", "venv", folder / "venv")
        python = folder / "venv" / "bin" / "python"
        run(python, *PIP, "install", *PINNED, "-r", ROSLIBPY)
        # only the block of roslibpy, whose hashes are those of the wheel and of the source package
        block = re.search(r"^roslibpy==(?:.*\\\n)+.*\n", ROSLIBPY.read_text(), re.MULTILINE)
        assert block is not None
        (folder / "source.lock").write_text(block[0])
        source = ("--require-hashes", "--no-deps", "--no-binary", ":all:", "--no-build-isolation")
        run(python, *PIP, "download", *source, "-r", folder / "source.lock", "-d", folder)
        (archive,) = folder.glob("roslibpy-*.tar.gz")
        with tarfile.open(archive) as tar:
            tar.extractall(folder, filter="data")
        (folder / archive.name.removesuffix(".tar.gz")).rename(folder / "source")

    return cached("roslibpy", (ROSLIBPY,), make)


def install_node_packages(name: str, folder: Path) -> Path:
    """Install the packages of a folder's package-lock.json once, and return the folder `node_modules`.

    Raises a SettingsError if npm is missing or Node is older than `OLDEST_NODE`.
    """
    node, npm = shutil.which("node"), shutil.which("npm")
    version = subprocess.run([node, "-v"], capture_output=True, text=True, check=True).stdout if node else ""
    if npm is None or int(re.sub(r"\D*(\d*).*\n?", r"\1", version) or 0) < OLDEST_NODE:
        raise SettingsError(
            f"{name} needs npm and Node {OLDEST_NODE} or later, and Node is {version.strip() or 'absent'}; "
            "install them (Debian: apt-get install nodejs npm)"
        )
    locks = (folder / "package.json", folder / "package-lock.json")

    def make(folder: Path) -> None:
        for lock in locks:
            shutil.copy(lock, folder)
        run(str(npm), "ci", "--ignore-scripts", "--no-audit", "--no-fund", cwd=folder)

    return cached(name, locks, make) / "node_modules"


def install_programs(packages: Mapping[str, str]) -> None:
    """Install the Debian package of each program or path that is missing; raise a SettingsError if that fails."""

    def absent_ones() -> list[str]:
        return [each for each in packages if shutil.which(each) is None and not Path("/", each).exists()]

    absent = absent_ones()
    if not absent:
        return
    names = sorted({packages[program] for program in absent})
    wanted = f"{' and '.join(absent)} not found; install {' '.join(names)} (Debian: apt-get install {' '.join(names)})"
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        raise SettingsError(f"{wanted} as root")
    print(f"installing {' '.join(names)} (once) ...", flush=True)
    run("apt-get", "update", "-qq")
    run("apt-get", "install", "-qq", "-y", "--no-install-recommends", *names)
    if absent_ones():
        raise SettingsError(wanted)
