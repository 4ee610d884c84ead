"""Fixtures and rules for all tests."""

import contextlib
import os
import signal

import psutil
from hypothesis import HealthCheck, settings

# A shell that starts the tests in the background has Ctrl-C ignored for them, and so for every process that they start
# and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Every run tries the same examples, and what one takes says something of the machine's load and not of the code.
# `--hypothesis-profile=search` tries others each time.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("steady", settings.get_profile("search"), derandomize=True)
settings.load_profile("steady")


def _end_with_children(number: int, _frame: object) -> None:
    """End all processes that the tests have started: many have a session of their own, which no signal reaches."""
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            child.kill()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


signal.signal(signal.SIGTERM, _end_with_children)
