"""A link with a rate: frames between host and emulated board take the time that they would take on PCIe or USB/JTAG.

    frame ──▶ waits until the wire is free ──▶ occupies it for bits / rate ──▶ latency ──▶ arrives

The board's process delays the frames that it receives and the frames that it sends. The process really waits, in
addition to the time that the socket takes. The delay changes no counts, and is not part of COMPUTE_NS. Frames on the
programming port are not delayed.
"""

import fcntl
import mmap
import os
import time
from collections.abc import Callable
from typing import Final

from pcie_shim.wires import WIRES, LinkFigures, LinkRate

_SPIN_NS: Final = 150_000
"""Length of the last part of a wait, in which the CPU spins, because Linux wakes a process some 60 us late."""


def wait_until(tick_ns: int) -> None:
    """Wait until a time of the monotonic clock, accurate to a few microseconds. Sleep during most of a long wait."""
    while (left := tick_ns - time.monotonic_ns()) > 0:
        if left > _SPIN_NS:
            time.sleep((left - _SPIN_NS) / 1e9)


class LinkModel:
    """A simulated wire to one board, or to several boards.

    If `wire.shared` is set, all board processes that this process forks afterwards share one wire.
    """

    def __init__(self, wire: LinkFigures, wait: Callable[[int], None] = wait_until) -> None:
        self._wire = wire
        self._wait = wait

        # Monotonic time at which the last transfer leaves the wire. For a shared wire it is in memory that forks share,
        # under a lock, which the kernel releases if its owner is killed.
        self._free_ns = memoryview(mmap.mmap(-1, 8) if wire.shared else bytearray(8)).cast("q")
        self._lock = os.memfd_create("wire") if wire.shared else None

    def carry(self, size: int, sent_ns: int) -> None:
        """Wait until a transfer of `size` bytes would have arrived. `sent_ns` is the monotonic time of sending."""
        if self._lock is not None:
            fcntl.lockf(self._lock, fcntl.LOCK_EX)
        leaves_ns = max(sent_ns, self._free_ns[0]) + round(8e3 * size / self._wire.mbps)
        self._free_ns[0] = leaves_ns
        if self._lock is not None:
            fcntl.lockf(self._lock, fcntl.LOCK_UN)
        # the next transfer may begin meanwhile: latency does not occupy the wire
        self._wait(leaves_ns + round(1e3 * self._wire.latency_us))


def link_model(rate: LinkRate) -> LinkModel | None:
    """Return a model of a link with the given rate, or None if the rate is `NONE`."""
    return None if rate is LinkRate.NONE else LinkModel(WIRES[rate])
