"""Messages to systemd over a real datagram socket: readiness, state, and signs of life only of a process that lives."""

import asyncio
import contextlib
import os
import socket

import pytest

from services.sockets import reporting
from services.sockets.reporting import ServiceManager, serve_status
from services.sockets.status import ProcessStatus
from tests.patience import PATIENCE


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
