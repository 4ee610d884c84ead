"""A client of a scheduler, as a process: squares of numbers, of which the later half waits for a file.

python -m tests.toolchain.cluster_client ADDRESS FOLDER

It appends each number to FOLDER/kept, and begins with those that are not there. The later half of them ends when
FOLDER/go exists, so that a test can do something in the middle.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

from terminal.ending import outcome
from toolchain.cluster import SchedulerOptions, runner

NUMBERS = 40


@dataclass(frozen=True)
class Squares:
    folder: Path

    def prepare(self):
        def square(number):
            while number >= NUMBERS // 2 and not (self.folder / "go").exists():
                time.sleep(0.02)
            return number * number

        return square


def kept(folder):
    """The numbers whose results were kept, in the order in which they were."""
    file = folder / "kept"
    return [int(line) for line in file.read_text().splitlines()] if file.exists() else []


def main(address, folder):
    done = kept(folder)
    with (folder / "kept").open("a", buffering=1) as file, runner(SchedulerOptions(scheduler=address)) as run:

        def keep(number, result):
            assert result == number * number
            file.write(f"{number}\n")

        run(Squares(folder), [number for number in range(NUMBERS) if number not in done], keep)


if __name__ == "__main__":
    from tests.toolchain import cluster_client  # a worker cannot import what is in __main__

    sys.exit(outcome(lambda: cluster_client.main(sys.argv[1], Path(sys.argv[2]))))
