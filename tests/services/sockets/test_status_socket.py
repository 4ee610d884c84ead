"""The status socket: one JSON object, then the end; nobody else may ask; what is left behind is taken away."""

import asyncio
import os
import socket
import stat
import threading
import time
from pathlib import Path

import msgspec
import pytest

from services.errors import SettingsError
from services.sockets import status_socket
from services.sockets.status_socket import (
    FrameCounts,
    ProcessStatus,
    reasons,
    seconds_since,
    status_served,
    status_thread,
)
from services.supervision.private_directory import remove_stale_sockets


def counts(completed, lost=None):
    return FrameCounts(
        received=completed,
        completed=completed,
        lost=lost or {},
        last_number=completed or None,
        last_age_s=0.5,
    )


def asked(path):
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(60)
        connection.connect(str(path))
        data = b""
        while part := connection.recv(65536):
            data += part
    return msgspec.json.decode(data, type=ProcessStatus)


def tell():
    return ProcessStatus(ready=True, why="all is well", frames=counts(7, {"passed over": 2}))


async def test_one_object_is_told_and_the_connection_ends(tmp_path):
    async with status_served(tmp_path, "publisher", tell):
        status = await asyncio.to_thread(asked, tmp_path / "publisher.status.sock")
    assert (status.name, status.pid, status.ready, status.why) == (
        "publisher",
        os.getpid(),
        True,
        "all is well",
    )
    assert status.frames.lost == {"passed over": 2}
    assert status.version
    assert not list(tmp_path.iterdir())


def test_a_blocking_process_answers_from_a_thread_of_its_own(tmp_path):
    with status_thread(tmp_path, "pcie-app", tell):
        assert asked(tmp_path / "pcie-app.status.sock").name == "pcie-app"
        assert asked(tmp_path / "pcie-app.status.sock").frames.completed == 7
    assert not list(tmp_path.iterdir())


def test_the_thread_takes_no_signals(tmp_path):
    with status_thread(tmp_path, "board0", tell):
        status = [each for each in threading.enumerate() if each.name == "status"][-1]  # others may end yet
        blocked = next(
            line.split()[1]
            for line in Path(f"/proc/self/task/{status.native_id}/status").read_text().splitlines()
            if line.startswith("SigBlk")
        )
    assert int(blocked, 16) & (1 << 14)  # SIGTERM is 15


def test_only_its_owner_may_ask(tmp_path):
    with status_thread(tmp_path, "board0", tell):
        mode = stat.S_IMODE((tmp_path / "board0.status.sock").stat().st_mode)
    assert mode == 0o600


def test_without_a_directory_nothing_is_served(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with status_thread(None, "board0", tell):
        assert not list(tmp_path.iterdir())


async def test_a_directory_that_is_none_is_the_users_mistake(tmp_path):
    with pytest.raises(SettingsError, match="BM_RUN_DIRECTORY: .*missing is no folder"):
        async with status_served(tmp_path / "missing", "hub", tell):
            pass


async def test_a_name_that_is_taken_is_a_warning_and_the_first_keeps_it(tmp_path, capfd):
    async with status_served(tmp_path, "hub", lambda: ProcessStatus(ready=True, why="the first")):
        async with status_served(tmp_path, "hub", lambda: ProcessStatus(ready=True, why="the second")):
            assert (await asyncio.to_thread(asked, tmp_path / "hub.status.sock")).why == "the first"
        assert (await asyncio.to_thread(asked, tmp_path / "hub.status.sock")).why == "the first"
    assert "hub: warning: its status can't be shown" in capfd.readouterr().err


def test_the_socket_of_a_killed_process_is_taken_over(tmp_path):
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(tmp_path / "board0.status.sock"))
    with status_thread(tmp_path, "board0", tell):
        assert asked(tmp_path / "board0.status.sock").ready


def test_dead_sockets_are_removed_and_live_ones_stay(tmp_path):
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(tmp_path / "master.status.sock"))
    (tmp_path / "board0.sock").touch()
    with status_thread(tmp_path, "board0", tell):
        remove_stale_sockets(tmp_path)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["board0.sock", "board0.status.sock"]


def test_who_asks_and_does_not_read_keeps_nobody_from_asking(tmp_path):
    with status_thread(tmp_path, "board0", tell):
        idle = [socket.socket(socket.AF_UNIX) for _ in range(20)]
        for each in idle:
            each.connect(str(tmp_path / "board0.status.sock"))
        assert asked(tmp_path / "board0.status.sock").ready
        for each in idle:
            each.close()
        assert asked(tmp_path / "board0.status.sock").ready


def test_a_rate_is_of_the_last_seconds(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(status_socket.time, "monotonic", lambda: now[0])
    done = [0]
    answerer = status_socket._Answerer(
        "pcie-app", lambda: ProcessStatus(ready=True, why="", frames=counts(done[0]))
    )
    for _ in range(20):
        answerer.sample()
        now[0] += 1
        done[0] += 30
    for _ in range(6):  # it is slower now, and the past does not count any more
        answerer.sample()
        now[0] += 1
        done[0] += 5
    status = msgspec.json.decode(answerer.answer(), type=ProcessStatus)
    assert status.frames.rate == 5
    assert status.uptime_s == 26


def test_reasons_that_did_not_occur_are_not_told():
    assert reasons({"passed over": 0, "failed on a board": 3}) == {"failed on a board": 3}


def test_the_age_of_nothing_is_none():
    assert seconds_since(0) is None
    age = seconds_since(time.monotonic_ns() - 2_000_000_000)
    assert age is not None
    assert age >= 2
