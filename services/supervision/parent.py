"""Exit of a child together with its parent, without leaving files behind."""

import atexit
import contextlib
import ctypes
import os
import signal
import time
from pathlib import Path

from terminal.logs import PARENT_VARIABLE
from terminal.private_directory import remove_stale_sockets
from terminal.signals import stopped_error

DIRECTORY_VARIABLE = "ROSBAYES_DIRECTORY"
"""Environment variable with the private directory of the run, which the last process to exit removes."""

_PR_SET_PDEATHSIG = 1
_DYING_TIME = 5.0
"""Seconds to wait for the last threads of a killed parent."""


def ask_for_end_with_parent() -> None:
    """Make the kernel send SIGTERM to this process when its parent exits; this survives an exec."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def end_with_parent() -> None:
    """In a child: exit with the parent, even after SIGKILL, and then remove the run directory.

    Does nothing in a process without a rosbayes parent.

    Raises:
        StoppedError: The parent has already ended.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not parent.isdigit():
        return
    # the last child to exit removes what a killed master has left
    atexit.register(leave_private_directory)
    ask_for_end_with_parent()
    # the parent may have exited before the request to the kernel
    if os.getppid() != int(parent):
        raise stopped_error(signal.SIGTERM)


def leave_private_directory() -> None:
    """In an exiting child: remove the private directory if its master is gone, or if it is empty.

    Every child does so, and the last one finds no sockets of others. Does nothing in a process without a
    rosbayes parent.
    """
    name = os.environ.get(DIRECTORY_VARIABLE)
    if not name:
        return
    directory = Path(name)
    outlive_parent()
    # such as the directory's absence: another child may remove it meanwhile
    with contextlib.suppress(OSError):
        remove_stale_sockets(directory)
        directory.rmdir()


def outlive_parent() -> None:
    """Wait for the last threads of a killed parent: the sockets that they hold still accept connections."""
    deadline = time.monotonic() + _DYING_TIME
    while _has_dying_threads(os.environ.get(PARENT_VARIABLE, "")) and time.monotonic() < deadline:
        time.sleep(0.001)


def _has_dying_threads(process: str) -> bool:
    """Return whether a killed process still has threads, until whose end it keeps its locks and sockets."""
    try:
        zombie = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
        return zombie and len(list(Path(f"/proc/{process}/task").iterdir())) > 1
    except OSError:
        return False
