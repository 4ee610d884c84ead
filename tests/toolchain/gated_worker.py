"""Preloaded by a dask worker: later pieces of its jobs wait for a file, so that a test can kill somebody in the middle.

In the worker's folder: `computed` has the number of each piece that was computed, `waiting.PID` says that this worker
waits, and `go` lets all pieces pass.
"""

import os
import time
from pathlib import Path

from toolchain.analysis.replay import Replay
from toolchain.analysis.sweep import SweepJob

FIRST = 6
"""Pieces that never wait: a batch each for two workers, before it is known how long a piece takes."""


def gated(prepare):
    def prepare_gated(job):
        work = prepare(job)

        def compute(number):
            while number >= FIRST and not Path("go").exists():
                Path(f"waiting.{os.getpid()}").touch()
                time.sleep(0.02)
            result = work(number)
            with Path("computed").open("a") as file:
                file.write(f"{number}\n")
            return result

        return compute

    return prepare_gated


for kind in (Replay, SweepJob):
    kind.prepare = gated(kind.prepare)
