"""Boards that a user starts: they report that they are listening, that one was restarted, and how they ended."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

BOARD = str(Path(sys.executable).parent / "board")


@pytest.fixture
def start(tmp_path):
    started = []

    def start(*arguments, **environment):
        process = subprocess.Popen(
            [BOARD, *arguments],
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": str(tmp_path), **environment},
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_several_keep_their_places_and_say_once_that_they_are_there_and_that_one_is_back(start, tmp_path):
    boards = start("--boards", "3", "--directory", str(tmp_path))
    assert (
        boards.stderr.readline()
        == f"3 boards listen at unix:{tmp_path}/board0.sock ... unix:{tmp_path}/board2.sock\n"
    )
    second = start("--boards", "2", "--directory", str(tmp_path))
    _, refused = second.communicate(timeout=120)
    assert (second.returncode, refused.count("\n"), refused[:7]) == (2, 1, "error: ")
    assert len(list(tmp_path.glob("*.sock"))) == 6  # those of the first are left alone
    children = psutil.Process(boards.pid).children()
    assert len(children) == 3
    children[1].kill()
    assert re.fullmatch(r"board \d was killed by SIGKILL; restarting it\n", boards.stderr.readline())
    assert re.fullmatch(r"board \d listens again at unix:.*/board\d\.sock\n", boards.stderr.readline())
    boards.send_signal(signal.SIGINT)
    _, rest = boards.communicate(timeout=120)
    assert (boards.returncode, rest) == (130, "interrupted (Ctrl-C)\n")


@pytest.mark.parametrize("flags", ["--boards 1 --directory {}", "--listen unix:{}/board0.sock"])
def test_one_alone(start, tmp_path, flags):
    board = start(*flags.format(tmp_path).split())
    assert board.stderr.readline() == f"board 0 listens at unix:{tmp_path}/board0.sock\n"
    board.send_signal(signal.SIGTERM)
    board.communicate(timeout=120)
    assert board.returncode == 143


def test_a_masters_boards_say_nothing(start, tmp_path):
    boards = start("--boards", "2", "--directory", str(tmp_path), ROSBAYES_PARENT=str(os.getpid()))
    while len(list(tmp_path.glob("board*.sock"))) < 4:
        assert boards.poll() is None
        time.sleep(0.02)
    boards.send_signal(signal.SIGTERM)
    _, said = boards.communicate(timeout=120)
    assert said == ""


def test_a_second_signal_close_behind_the_first_changes_nothing(start, tmp_path):
    for _ in range(3):
        boards = start("--boards", "2", "--directory", str(tmp_path))
        boards.stderr.readline()
        boards.send_signal(signal.SIGINT)
        boards.send_signal(signal.SIGTERM)
        _, rest = boards.communicate(timeout=120)
        assert boards.returncode in {130, 143}
        assert rest.count("\n") == 1
