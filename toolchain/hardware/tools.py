"""Runs of hardware tools, such as GHDL and Verilator."""

import shutil
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from toolchain.errors import ToolchainError

_LIMIT_S: Final = 1200.0
_LAST_OUTPUT: Final = 1500  # characters


class HardwareToolError(ToolchainError):
    """A tool is missing or failed; the sentence names it and ends with its output."""


def missing(tools: Iterable[str]) -> list[str]:
    """Return the tools that are not installed."""
    return [tool for tool in tools if shutil.which(tool) is None]


def run_tool(
    command: Sequence[str],
    folder: Path,
    environment: Mapping[str, str] | None = None,
    *,
    separate: bool = False,
) -> str:
    """Run a tool in a folder and return its output, without its warnings if `separate` is True.

    Raises:
        HardwareToolError: It is not installed, failed, or did not end in time.
    """
    if missing(command[:1]):
        raise HardwareToolError(f"{command[0]} is not installed (Debian: apt-get install {command[0]})")
    try:
        done = subprocess.run(
            command, check=True, cwd=folder, env=environment, capture_output=True, text=True, timeout=_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        raise HardwareToolError(f"{command[0]} did not end within {_LIMIT_S:.0f} s") from None
    except subprocess.CalledProcessError as error:
        output = (error.stdout + error.stderr).strip()[-_LAST_OUTPUT:]
        raise HardwareToolError(f"{command[0]} failed: {output}") from None
    return done.stdout if separate else done.stdout + done.stderr
