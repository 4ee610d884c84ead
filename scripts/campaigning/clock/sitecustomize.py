"""A clock that can be stepped, for processes that have this folder in PYTHONPATH.

libfaketime is not suitable: if it also changes the monotonic clock, waits change too; otherwise Python's
sleep fails.
"""

import os
import time
from pathlib import Path

_PATH = Path(os.environ["CAMPAIGN_CLOCK"])
_real_time_ns = time.time_ns


def _time_ns() -> int:
    """Return the time of day, moved by the seconds in the file."""
    return _real_time_ns() + int(_PATH.read_text()) * 10**9


def _time() -> float:
    return _time_ns() / 1e9


time.time_ns = _time_ns
time.time = _time
