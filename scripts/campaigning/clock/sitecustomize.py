"""A clock that can be stepped, for processes that have this folder in PYTHONPATH.

libfaketime is not suitable in either of its modes. If it also changes the monotonic clock, waits change their length.
If it changes only the time of day, Python's sleep fails. The offset of the clock is read from shared memory, because a
process without free descriptors must also be able to read the time.
"""

import mmap
import os
import struct
import time

_file = os.open(os.environ["CAMPAIGN_CLOCK"], os.O_RDONLY)
_shared = mmap.mmap(_file, 0, prot=mmap.PROT_READ)
os.close(_file)
_real_time_ns = time.time_ns


def _time_ns() -> int:
    """Return the time of day, shifted by the shared offset."""
    seconds: int = struct.unpack("<q", _shared[:8])[0]
    return _real_time_ns() + seconds * 10**9


def _time() -> float:
    return _time_ns() / 1e9


time.time_ns = _time_ns
time.time = _time
