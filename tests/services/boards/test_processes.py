"""Boards that a user starts: they report that they are listening, that one was restarted, and how they ended."""

import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import psutil
import pytest

from machines.kind import FrameInput
from pcie_shim.endpoint import Endpoint
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.wires import LinkRate
from services.boards import processes
from services.boards.processes import BoardProcesses
from services.child import ForkedChild
from services.errors import BoardFailedError, SettingsError
from services.settings import Settings
from services.sockets.reporting import STUCK_S
from tests.patience import PROCESS_PATIENCE, PRODUCT_LIMITS
from tests.pcie_shim.boards import images

BOARD = str(Path(sys.executable).parent / "board")


@pytest.fixture
def start(tmp_path):
    started = []

    def start(*arguments, **environment):
        process = subprocess.Popen(
            [BOARD, *arguments],
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ
            | {name: str(value) for name, value in PRODUCT_LIMITS.items()}
            | {"TMPDIR": str(tmp_path)}
            | environment,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.process
def test_several_keep_their_places_and_say_once_that_they_are_there_and_that_one_is_back(start, tmp_path):
    boards = start("--boards", "3", "--directory", str(tmp_path))
    assert (
        boards.stderr.readline()
        == f"3 boards listen at unix:{tmp_path}/board0.sock ... unix:{tmp_path}/board2.sock\n"
    )
    children = psutil.Process(boards.pid).children()
    assert len(children) == 3
    children[1].kill()
    assert re.fullmatch(r"board \d was killed by SIGKILL; restarting it\n", boards.stderr.readline())
    assert re.fullmatch(r"board \d listens again at unix:.*/board\d\.sock\n", boards.stderr.readline())
    boards.send_signal(signal.SIGINT)
    _, rest = boards.communicate(timeout=PROCESS_PATIENCE)
    assert (boards.returncode, rest) == (130, "interrupted (Ctrl-C)\n")
    assert list(tmp_path.glob("*.sock")) == []


@pytest.mark.thorough
def test_boards_leave_the_sockets_of_others_alone(start, tmp_path):
    boards = start("--boards", "3", "--directory", str(tmp_path))
    boards.stderr.readline()
    second = start("--boards", "2", "--directory", str(tmp_path))
    _, refused = second.communicate(timeout=PROCESS_PATIENCE)
    assert (second.returncode, refused.count("\n"), refused[:7]) == (2, 1, "error: ")
    assert len(list(tmp_path.glob("*.sock"))) == 6


@pytest.mark.thorough
@pytest.mark.parametrize("flags", ["--boards 1 --directory {}", "--listen unix:{}/board0.sock"])
def test_one_alone(start, tmp_path, flags):
    board = start(*flags.format(tmp_path).split())
    assert board.stderr.readline() == f"board 0 listens at unix:{tmp_path}/board0.sock\n"
    board.send_signal(signal.SIGTERM)
    board.communicate(timeout=PROCESS_PATIENCE)
    assert board.returncode == 143


@pytest.mark.thorough
def test_a_masters_boards_say_nothing(start, tmp_path):
    boards = start("--boards", "2", "--directory", str(tmp_path), ROSBAYES_PARENT=str(os.getpid()))
    while len(list(tmp_path.glob("board*.sock"))) < 4:
        assert boards.poll() is None
        time.sleep(0.02)
    boards.send_signal(signal.SIGTERM)
    _, said = boards.communicate(timeout=PROCESS_PATIENCE)
    assert said == ""


@pytest.mark.thorough
def test_a_second_signal_close_behind_the_first_changes_nothing(start, tmp_path):
    for _ in range(3):
        boards = start("--boards", "2", "--directory", str(tmp_path))
        boards.stderr.readline()
        boards.send_signal(signal.SIGINT)
        boards.send_signal(signal.SIGTERM)
        _, rest = boards.communicate(timeout=PROCESS_PATIENCE)
        assert boards.returncode in {130, 143}
        assert rest.count("\n") == 1


@pytest.mark.process
def test_a_slower_link_changes_no_counts(start, tmp_path):
    parts = images(5, [4, 4, 3])
    frame = FrameInput(addresses=(3, 4), target_count=200, max_cycles=1 << 14, bank=0, stop="slices")
    found = {}
    for rate in LinkRate:
        places = [f"unix:{tmp_path}/{rate}/board{at}.sock" for at in range(len(parts))]
        boards = start("--boards", "3", "--directory", str(tmp_path / rate), BM_LINK_RATE=rate)
        assert boards.stderr.readline().startswith("3 boards listen")
        with MiniCluster.open(places, parts, timeout=PROCESS_PATIENCE, slack=PROCESS_PATIENCE) as cluster:
            output = cluster.run(frame)
        assert output.slices > 1
        found[rate] = [(each.words, each.cycles, each.reason) for each in output.boards]
    assert found[LinkRate.JTAG] == found[LinkRate.PCIE_GEN2] == found[LinkRate.NONE]


@pytest.mark.process
def test_the_service_manager_hears_one_process_when_all_boards_listen(start, tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        manager.settimeout(PROCESS_PATIENCE)
        watched = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "60000000"}
        boards = start("--boards", "3", "--directory", str(tmp_path / "b"), **watched)
        heard = []
        while not ("READY=1" in heard and heard.count("WATCHDOG=1") > 1):
            text, ancillary, _, _ = manager.recvmsg(1 << 12, 1 << 10)
            assert struct.unpack("3i", ancillary[0][2])[0] == boards.pid
            heard += text.decode().split("\n")
            if "READY=1" in heard:
                for at in range(3):
                    with socket.socket(socket.AF_UNIX) as client:
                        client.connect(str(tmp_path / "b" / f"board{at}.sock"))
        assert heard.count("READY=1") == 1
        assert "STATUS=3 of 3 boards listen" in heard
        boards.terminate()
        while "STOPPING=1" not in heard:
            heard += manager.recv(1 << 12).decode().split("\n")
        assert heard.count("STOPPING=1") == 1


def test_a_stuck_board_is_no_sign_of_life_of_its_parent(tmp_path, monkeypatch):
    reports = []
    boards = BoardProcesses(tmp_path, 2, 0, Settings())
    monkeypatch.setattr(
        boards._manager, "report", lambda _status, *, ready, alive: reports.append((ready, alive))
    )
    for at in range(2):
        boards._hear(at, listens=True)
    boards._report()
    boards._heard[1] -= STUCK_S + 1
    boards._report()
    boards._hear(1, listens=False)
    boards._report()
    assert reports == [(True, True), (True, False), (True, True)]


async def test_boards_may_end_seldom_and_their_limit_is_common(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])

    class Ending(ForkedChild):
        """A board that ends with exit code 1, each time after so many seconds."""

        exit_code = 1

        def __init__(self, *seconds):
            super().__init__("a board", int, ends=boards._ends)
            self.seconds = list(seconds)

        async def start(self):
            pass

        async def wait(self):
            now[0] += self.seconds.pop(0)

    boards = BoardProcesses(tmp_path, 2, 1, Settings(restart_window=5))
    boards._children = [Ending(1, 5.1, 5.0), Ending(5.1, 5.0)]
    for at in range(2):
        with pytest.raises(BoardFailedError, match="exit code 1, 2 exits of boards within 5 s$"):
            await boards._keep(at)
        assert boards._children[at].seconds == []


@pytest.mark.process
async def test_a_forked_child_says_why_it_failed_and_shares_what_is_loaded(capfd):
    def fail():
        os.write(2, f"Ctrl-C reaches it: {os.getpgrp() != os.getpid()}\n".encode())
        raise SettingsError(f"no luck with {shared}")

    shared = {"loaded": 1}
    child = ForkedChild("board 7", fail, ends=deque(maxlen=1))
    await child.start()
    await child.wait()
    assert (child.exit_code, child.is_running) == (2, False)
    assert str(child.failure()) == "board 7: no luck with {'loaded': 1}"
    assert capfd.readouterr().err == "Ctrl-C reaches it: False\n"
    assert not child.may_restart(60.0)


@pytest.mark.process
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGKILL, -9)])
async def test_signals_reach_a_forked_child_alone(number, code):
    child = ForkedChild("board 7", lambda: signal.pause() or 0, ends=deque(maxlen=1))
    await child.start()
    os.kill(child.pid, number)
    await child.wait()
    assert child.exit_code == code


def test_boards_of_a_killed_process_have_time_to_end(tmp_path, monkeypatch):
    endpoint = Endpoint(path=str(tmp_path / "board0.sock"))
    now = [0.0]
    with socket.socket(socket.AF_UNIX) as former, socket.socket(socket.AF_UNIX) as queued:
        former.bind(endpoint.path)
        former.listen(0)
        queued.connect(endpoint.path)  # a second one would wait

        def ends_later(seconds):
            now[0] += seconds
            if now[0] > 1:
                former.close()

        monkeypatch.setattr(processes.time, "monotonic", lambda: now[0])
        monkeypatch.setattr(processes.time, "sleep", ends_later)
        with pytest.raises(SettingsError, match=r"another process listens.*board0"):
            processes._await_free(endpoint, 0.0)
        assert now == [0.0]
        with pytest.raises(SettingsError):
            processes._await_free(endpoint, 0.5)
        assert 0.5 <= now[0] < 0.6
        processes._await_free(endpoint, 5.0)
    assert now[0] > 1
