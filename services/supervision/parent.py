"""Exit of a child together with its parent."""

import ctypes
import os
import signal

from terminal.logs import PARENT_VARIABLE
from terminal.signals import stopped_error

_PR_SET_PDEATHSIG = 1


def ask_for_end_with_parent() -> None:
    """Make the kernel send SIGTERM to this process when its parent exits; this survives an exec."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def end_with_parent() -> None:
    """In a child: exit with the parent, even after SIGKILL.

    Does nothing in a process without a rosbayes parent.

    Raises:
        StoppedError: The parent has already ended.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not parent.isdigit():
        return
    ask_for_end_with_parent()
    # the parent may have exited before the request to the kernel
    if os.getppid() != int(parent):
        raise stopped_error(signal.SIGTERM)
