"""Log lines: one frame is found by its number, and nothing is written below the level."""

import subprocess
import sys

import pytest

LINES = """
from terminal.logs import get_logger
log = get_logger("pcie-app", {level!r})
log.debug("computed", frame=17, cycles=512)
log.debug("computed", frame=170, cycles=512)
log.info("4 boards programmed")
log.warning("board 2 is gone", frame=17, why='closed "now"')
"""


def written(level):
    done = subprocess.run(
        [sys.executable, "-c", LINES.format(level=level)],
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
    )
    return [line.split(" ", 1)[1] for line in done.stderr.splitlines()]


def test_a_frame_is_found_by_its_number():
    lines = written("debug")
    assert [line for line in lines if "frame=17 " in line] == [
        "pcie-app: debug: frame=17 computed cycles=512",
        r'pcie-app: warning: frame=17 board 2 is gone why="closed \"now\""',
    ]


@pytest.mark.parametrize(("level", "count"), [("debug", 4), ("info", 2), ("warning", 1)])
def test_nothing_is_written_below_the_level(level, count):
    assert len(written(level)) == count


def test_an_information_has_no_level():
    assert "pcie-app: 4 boards programmed" in written("info")
