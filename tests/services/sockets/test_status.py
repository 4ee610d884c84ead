"""The parts of a status that every process adds, and messages to systemd over a real datagram socket."""

import asyncio
import contextlib
import os
import socket
import time

import pytest

from services.errors import SettingsError
from services.sockets import reporting
from services.sockets.records import VERSION
from services.sockets.reporting import Report, ServiceManager, serve_status, serve_status_in_thread
from services.sockets.status import FrameCounts, ProcessStatus, read_process_status, seconds_since
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
    assert seconds_since(0) is None
    assert seconds_since(time.monotonic_ns() - 2_000_000_000) >= 2


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path, monkeypatch):
    """The receiving socket of a service manager, which expects a sign of life every 60 s."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@rosbayes-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(name.replace("@", "\0", 1))
        receiver.settimeout(PATIENCE)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        monkeypatch.setenv("WATCHDOG_USEC", "60000000")
        monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
        yield receiver


def messages_to(receiver):
    """The assignments of the datagrams so far."""
    receiver.setblocking(False)
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found += receiver.recv(1 << 16).decode().split("\n")
    return found


def test_readiness_is_sent_once_and_a_state_when_it_changes(manager):
    service = ServiceManager()
    assert {"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"}.isdisjoint(os.environ)  # not for children
    service.report("waiting", ready=False, alive=True)
    service.report("waiting", ready=False, alive=True)
    assert messages_to(manager) == ["STATUS=waiting", "WATCHDOG=1", "WATCHDOG=1"]
    service.report("results\nREADY=0", ready=True, alive=True)
    service.report("results\nREADY=0", ready=True, alive=False)
    assert messages_to(manager) == ["READY=1", r"STATUS=results\nREADY=0", "WATCHDOG=1"]
    service.stopping()
    assert messages_to(manager) == ["STOPPING=1"]


def test_messages_refused_by_a_full_queue_are_sent_again(manager):
    service = ServiceManager()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other, contextlib.suppress(BlockingIOError):
        other.setblocking(False)
        while True:
            other.sendto(b"FDSTORE=1", manager.getsockname())
    service.report("fine", ready=True, alive=True)
    assert "READY=1" not in messages_to(manager)
    service.report("fine", ready=True, alive=True)
    assert messages_to(manager) == ["READY=1", "STATUS=fine", "WATCHDOG=1"]


@pytest.mark.parametrize("value", ["\u00b2", "-1", "1e6", "9" * 5000])
def test_an_odd_interval_of_the_watchdog_is_none(manager, monkeypatch, value):
    monkeypatch.setenv("WATCHDOG_USEC", value)
    ServiceManager().report("fine", ready=True, alive=True)
    assert messages_to(manager) == ["READY=1", "STATUS=fine"]


def test_a_watchdog_of_another_process_is_not_ours(manager, monkeypatch):
    monkeypatch.setenv("WATCHDOG_PID", str(os.getppid()))
    ServiceManager().report("", ready=False, alive=True)
    assert messages_to(manager) == []


def test_without_a_service_manager_nothing_is_sent(monkeypatch):
    for value in (None, "", "/nonexistent/socket"):
        monkeypatch.delenv("NOTIFY_SOCKET", raising=False) if value is None else monkeypatch.setenv(
            "NOTIFY_SOCKET", value
        )
        ServiceManager().report("fine", ready=True, alive=True)


async def test_a_process_reports_and_one_that_is_stuck_gives_no_sign_of_life(manager, monkeypatch):
    monkeypatch.setattr(reporting, "_SAMPLE_EVERY", 0.0)
    alive, why = [True], ["fine"]

    async def told():
        """Return the messages up to and including that of its current state."""
        found = []
        async with asyncio.timeout(PATIENCE):
            while f"STATUS={why[0]}" not in found:
                await asyncio.sleep(0)
                found += messages_to(manager)
        return found

    async with serve_status(
        None, "hub", lambda: ProcessStatus(ready=True, why=why[0]), is_alive=lambda: alive[0]
    ):
        assert await told() == ["READY=1", "STATUS=fine", "WATCHDOG=1"]
        alive[0], why[0] = False, "stuck"
        assert await told() == ["STATUS=stuck"]
        why[0] = "still stuck"
        assert await told() == ["STATUS=still stuck"]
        alive[0], why[0] = True, "fine again"
        assert await told() == ["STATUS=fine again", "WATCHDOG=1"]
        alive[0] = False
    assert messages_to(manager)[-1] == "STOPPING=1"
