"""Installation of Debian's programs that a verification needs."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping

_LIMIT_S = 600.0


class MissingToolError(Exception):
    """A program is missing and cannot be installed here; the text says what to do."""


def install(packages: Mapping[str, str]) -> None:
    """Install the Debian packages of the programs that are missing.

    Args:
        packages: The package of each program.

    Raises:
        MissingToolError: This is not Debian, the user may not install packages, or apt-get failed.
    """
    absent = [program for program in packages if shutil.which(program) is None]
    if not absent:
        return
    names = sorted({packages[program] for program in absent})
    wanted = f"{' and '.join(absent)} not found; install {' '.join(names)} (Debian: apt-get install {' '.join(names)})"
    if shutil.which("apt-get") is None:
        raise MissingToolError(wanted)
    command = ["apt-get"]
    if os.geteuid() != 0:
        if shutil.which("sudo") is None:
            raise MissingToolError(f"{wanted} as root")
        command = ["sudo", "-n", "apt-get"]
    print(f"installing {' '.join(names)} (once) ...", flush=True)
    try:
        for arguments in (["update", "-qq"], ["install", "-qq", "-y", "--no-install-recommends", *names]):
            subprocess.run(
                [*command, *arguments], check=True, capture_output=True, text=True, timeout=_LIMIT_S
            )
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
        raise MissingToolError(f"{wanted}: apt-get could not do it") from None
    still = [program for program in absent if shutil.which(program) is None]
    if still:
        raise MissingToolError(f"{' and '.join(still)} not found though {' '.join(names)} was installed")
