"""The parts of a status that every process adds: its identity, and the current frame rate."""

import os
import socket
import time

import pytest

from services.errors import SettingsError
from services.sockets import reporting
from services.sockets.records import VERSION
from services.sockets.reporting import Report, ServiceManager, serve_status, serve_status_in_thread
from services.sockets.status import FrameCounts, ProcessStatus, read_process_status
from terminal.health import NoHealthError, in_thread, serve_health, status_socket
from terminal.run_directory import remove_stale_sockets
from tests.patience import PATIENCE


def counts(completed):
    return FrameCounts(
        received=completed, completed=completed, lost={"passed over": 2}, last_number=None, last_age_s=None
    )


def get_status():
    return ProcessStatus(ready=True, why="all is well", frames=counts(7))


async def test_a_process_identifies_itself_and_says_what_it_uses(tmp_path):
    with serve_status_in_thread(tmp_path, "pcie-app", get_status):
        found = await read_process_status(status_socket(tmp_path, "pcie-app"), PATIENCE)
    assert (found.name, found.pid, found.version) == ("pcie-app", os.getpid(), VERSION)
    assert (found.ready, found.why, found.frames) == (True, "all is well", counts(7))
    assert found.cpu_s > 0
    assert 10e6 < found.memory_bytes < 10e9
    assert not list(tmp_path.iterdir())


async def test_a_process_that_makes_no_progress_is_not_ready(tmp_path):
    with serve_status_in_thread(tmp_path, "pcie-app", get_status, is_alive=lambda: False):
        found = await read_process_status(status_socket(tmp_path, "pcie-app"), PATIENCE)
    assert (found.alive, found.ready) == (False, False)


async def test_a_status_of_another_version_is_refused(tmp_path):
    with (
        in_thread(lambda: serve_health(tmp_path, "hub", lambda: b'{"ready":true,"why":3}')),
        pytest.raises(NoHealthError, match="version"),
    ):
        await read_process_status(status_socket(tmp_path, "hub"), PATIENCE)


async def test_a_process_that_accepts_nobody_is_silent(tmp_path):
    path = status_socket(tmp_path, "hub")
    with socket.socket(socket.AF_UNIX) as stuck, socket.socket(socket.AF_UNIX) as queued:
        stuck.bind(path)
        stuck.listen(0)
        queued.connect(path)  # the backlog is full
        with pytest.raises(NoHealthError, match="within"):
            await read_process_status(path, 0.1)


async def test_a_directory_that_is_not_there_is_the_users_mistake(tmp_path):
    with pytest.raises(SettingsError):
        await serve_status(tmp_path / "missing", "hub", get_status).__aenter__()
    with pytest.raises(SettingsError), serve_status_in_thread(tmp_path / "missing", "hub", get_status):
        pass


def test_stale_sockets_are_removed_and_live_ones_stay(tmp_path):
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(status_socket(tmp_path, "master"))
    (tmp_path / "board0.sock").touch()
    with serve_status_in_thread(tmp_path, "board0", get_status):
        remove_stale_sockets(tmp_path)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["board0.sock", "board0.status.sock"]


@pytest.mark.parametrize(
    ("completed", "rate"),
    [
        ([30] * 20 + [5] * 6, 5),  # it is slower now, and the past does not count any more
        ([0, 0, 0, 10, 10], 10),  # nor does the time before the first result
    ],
)
def test_a_rate_is_of_the_last_seconds(monkeypatch, completed, rate):
    now = [100.0]
    monkeypatch.setattr(reporting.time, "monotonic", lambda: now[0])
    done = [0]
    report = Report("pcie-app", lambda: ProcessStatus(ready=True, why="", frames=counts(done[0])))
    for a_second in completed:
        report.sample(ServiceManager())
        now[0] += 1
        done[0] += a_second
    found = report.status()
    assert (found.frames.rate, found.uptime_s) == (rate, len(completed))


def test_the_age_of_nothing_is_none():
    assert FrameCounts.of(0, 0, {}, (0, 0)).last_age_s is None
    assert FrameCounts.of(1, 1, {}, (1, time.monotonic_ns() - 2_000_000_000)).last_age_s >= 2
