"""What a process adds to its status: who it is, and how fast frames are lately."""

import os
import socket
import time

import msgspec
import pytest

from services.errors import SettingsError
from services.sockets import status
from services.sockets.records import VERSION
from services.sockets.status import (
    FrameCounts,
    ProcessStatus,
    read_process_status,
    seconds_since,
    serve_status,
    serve_status_in_thread,
)
from services.supervision.private_directory import remove_stale_sockets
from terminal.health import NoHealthError, Silence, serve_health_in_thread, status_socket

PATIENCE = 60.0


def counts(completed):
    return FrameCounts(
        received=completed, completed=completed, lost={"passed over": 2}, last_number=None, last_age_s=None
    )


def get_status():
    return ProcessStatus(ready=True, why="all is well", frames=counts(7))


def test_a_process_says_who_it_is(tmp_path):
    with serve_status_in_thread(tmp_path, "pcie-app", get_status):
        found = read_process_status(status_socket(tmp_path, "pcie-app"), PATIENCE)
    assert (found.name, found.pid, found.version) == ("pcie-app", os.getpid(), VERSION)
    assert (found.ready, found.why, found.frames) == (True, "all is well", counts(7))
    assert not list(tmp_path.iterdir())


def test_a_status_of_another_version_is_refused(tmp_path):
    with (
        serve_health_in_thread(tmp_path, "hub", lambda: b'{"ready":true,"why":3}', lambda: None),
        pytest.raises(NoHealthError) as silent,
    ):
        read_process_status(status_socket(tmp_path, "hub"), PATIENCE)
    assert silent.value.reason is Silence.NOT_OURS


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


def test_a_rate_is_of_the_last_seconds(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(status.time, "monotonic", lambda: now[0])
    done = [0]
    answerer = status._Answerer("pcie-app", lambda: ProcessStatus(ready=True, why="", frames=counts(done[0])))
    for seconds, a_second in ((20, 30), (6, 5)):  # it is slower now, and the past does not count any more
        for _ in range(seconds):
            answerer.sample()
            now[0] += 1
            done[0] += a_second
    found = msgspec.json.decode(answerer.answer(), type=ProcessStatus)
    assert (found.frames.rate, found.uptime_s) == (5, 26)


def test_the_age_of_nothing_is_none():
    assert seconds_since(0) is None
    assert seconds_since(time.monotonic_ns() - 2_000_000_000) >= 2
