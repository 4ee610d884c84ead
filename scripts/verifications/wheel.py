"""Checks of the wheel of this commit, in a new environment without the project's folder (scripts/verify wheel).

scripts/wheel --> pip install, with dependencies --> commands in an empty folder, without PATH
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR, PRODUCT_LIMITS
from scripts.running.script import ROOT
from scripts.verifications.checks import Tally, expect
from scripts.verifications.installation import PIP, run

LIMIT: Final = 300.0 * FACTOR
"""Time limit of a command, in seconds."""
BOAT: Final = ("--uri", "ws://localhost:9090", "--topic", "/boat/sensors", "--type", "boat_msgs/Sensors")


class Installed:
    """An environment with the wheel alone, and an empty folder in which its commands run."""

    def __init__(self, folder: Path) -> None:
        run(ROOT / "scripts" / "wheel", folder)
        run(sys.executable, "-m", "venv", folder / "venv")
        (wheel,) = folder.glob("rosbayes-*.whl")
        run(folder / "venv" / "bin" / "python", *PIP, "install", wheel)
        self.commands = folder / "venv" / "bin"
        self.out = folder / "empty"
        (folder / "run").mkdir(mode=0o700)
        self.out.mkdir()
        limits = {name: str(limit) for name, limit in PRODUCT_LIMITS.items()}
        self._environment = {"HOME": str(folder), "BM_RUN_DIRECTORY": str(folder / "run"), **limits}

    def run(self, *command: str, code: int = 0) -> str:
        """Run a command of the environment, without PATH, and return what it prints, or raise a CheckError."""
        done = subprocess.run(
            [self.commands / command[0], *command[1:]],
            cwd=self.out,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LIMIT,
            check=False,
        )
        said = (done.stdout.splitlines() or ["nothing"])[-1]
        expect(done.returncode == code, f"{' '.join(command)} ended with {done.returncode} and said: {said}")
        return done.stdout


def pictures(installed: Installed, folder: str, *names: str) -> None:
    """Expect pictures in a folder."""
    for name in names:
        picture = installed.out / folder / name
        expect(picture.is_file() and picture.read_bytes().startswith(b"\x89PNG"), f"{picture} is no picture")


def check_demo(installed: Installed) -> None:
    """Run the boat on four boards, and look for its pictures."""
    said = installed.run("rosbayes", "demo", "--count", "5")
    expect("5 results published" in said, f"it did not publish 5 results: {said}")
    pictures(installed, "out", "figure-4.4.png", "figure-4.5.png", "figure-4.5-projected.png")


def check_sprinkler(installed: Installed) -> None:
    """Run the sprinkler on two boards, with another output folder."""
    installed.run("rosbayes", "demo", "--sprinkler", "--count", "3", "--out", "rain")
    pictures(installed, "rain", "sprinkler.png")


def check_disparity(installed: Installed) -> None:
    """Run binocular disparity on a board of 160 machines."""
    installed.run("rosbayes", "demo", "--disparity", "--count", "1", "--out", "depth")
    pictures(installed, "depth", "disparity.png")


def check_page(installed: Installed) -> None:
    """Check that `demo --dashboard` does not start without the dashboard's packages, and prints how to install them."""
    said = installed.run("rosbayes", "demo", "--dashboard", "--out", "page", code=2)
    expect("pip install 'rosbayes[dashboard]'" in said, f"it does not say what to install: {said}")
    expect(not (installed.out / "page").exists(), "it has started")


def check_toolchain(installed: Installed) -> None:
    """Build, check and explain the installed model, and build the template."""
    said = installed.run("rosbayes", "build", "boat", "-o", "boat", "--partitions", "4", *BOAT)
    expect("1024 lines" in said, f"it is not the boat's report: {said}")
    built = installed.out / "boat"
    expect((built / "bm_arch" / "bm1_parameters.vhd").is_file(), "it has no VHDL")
    installed.run("rosbayes", "check", "boat")
    installed.run("rosbayes", "inspect", "boat", "--model", "boat", "--frames", "5")
    installed.run("rosbayes", "new", "corridor")
    installed.run("toolchain", "build", "corridor", "-o", "built", *BOAT)


def check_files(installed: Installed) -> None:
    """Look for the VHDL that boards and simulated boards need, and the boat's world."""
    code = "from toolchain.hardware import HDL, SOURCES; print(*(HDL / each for each in SOURCES))"
    sources = [Path(each) for each in installed.run("python", "-c", code).split()]
    (packages,) = {each.parents[1] for each in sources}
    for each in (*sources, packages / "casestudies" / "boat" / "world.sdf"):
        expect(each.is_file() and not each.is_relative_to(ROOT), f"{each} is not in the wheel")


def check_commands(installed: Installed) -> None:
    """Let each command print its help, by itself and below `rosbayes`."""
    code = "from rosbayes.start import COMMANDS; print(*COMMANDS)"
    names = installed.run("python", "-c", code).split()
    for name in names:
        installed.run("rosbayes", name, "--help")
        if (installed.commands / name).exists():
            installed.run(name, "--help")


CHECKS: Final[dict[str, Callable[[Installed], None]]] = {
    "rosbayes demo": check_demo,
    "rosbayes demo --sprinkler": check_sprinkler,
    "rosbayes demo --disparity": check_disparity,
    "rosbayes demo --dashboard": check_page,
    "rosbayes build boat": check_toolchain,
    "files": check_files,
    "every command": check_commands,
}


def verify(arguments: argparse.Namespace) -> int:
    """Install the wheel, and check it."""
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix="wheel-rosbayes-") as folder:
        print("installing the wheel ...", flush=True)
        installed = Installed(Path(folder))
        for name, check in CHECKS.items():
            if arguments.only in name:
                with tally.check(name, OSError, subprocess.TimeoutExpired):
                    check(installed)
    return tally.end()


if __name__ == "__main__":
    parser = ScriptParser("scripts/verify wheel", __doc__)
    parser.flag("--only", "checks with this in their names", "")
    parser.run_at_once(verify)
