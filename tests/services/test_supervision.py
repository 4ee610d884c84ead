"""Children: their errors kept, their other lines passed on, their ends found out, whatever the parent's end."""

import asyncio
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from services.errors import ExitCode, ServiceError
from services.supervision import RESTARTS, Child, end_all, make_private_directory


def child(code: str) -> Child:
    return Child("tester", [sys.executable, "-c", code])


async def ended(one: Child) -> None:
    await asyncio.wait_for(one.ended(), 10)


async def test_its_error_is_its_sentence_and_code(capsys):
    one = child(
        "import sys; print('starting', file=sys.stderr); print('error: no luck', file=sys.stderr); sys.exit(3)"
    )
    one.start()
    await ended(one)
    failure = one.failure()
    assert (str(failure), failure.exit_code) == ("no luck", 3)
    assert capsys.readouterr().err == "starting\n"


async def test_a_kill_is_told_with_its_signal():
    one = child("import time; time.sleep(60)")
    one.start()
    os.kill(one.pid, signal.SIGKILL)
    await ended(one)
    failure = one.failure()
    assert (str(failure), failure.exit_code) == ("tester was killed by SIGKILL", ExitCode.CHILD)


async def test_a_stubborn_child_is_killed_and_named():
    one = child(
        "import signal, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', file=sys.stderr, flush=True); time.sleep(60)"
    )
    one.start()
    await asyncio.sleep(0.3)
    assert await end_all([one], 0.2) == ["tester"]
    assert one.exit_code() == -signal.SIGKILL


async def test_a_willing_child_ends_without_a_kill():
    one = child("import time; time.sleep(60)")
    one.start()
    assert await end_all([one], 5) == []


def test_restarts_are_bounded():
    one = child("")
    assert [one.may_restart() for _ in range(RESTARTS + 1)] == [True] * RESTARTS + [False]


def test_a_command_that_is_not_there_is_one_sentence():
    with pytest.raises(ServiceError, match="can't start tester"):
        Child("tester", ["/nonexistent/command"]).start()


def test_the_private_directory_is_private(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path)[:39])
    directory = make_private_directory()
    try:
        assert directory.stat().st_mode & 0o777 == 0o700
    finally:
        directory.rmdir()


def test_a_child_ends_when_its_parent_is_killed(tmp_path):
    child_code = (
        "import time; from services.supervision import end_with_parent; end_with_parent();"
        f"open({str(tmp_path / 'up')!r}, 'w').close(); time.sleep(60)"
    )
    parent_code = f"""
import sys, time
from services.supervision import Child
one = Child("tester", [sys.executable, "-c", {child_code!r}])
one.start()
print(one.pid, flush=True)
time.sleep(60)
"""
    parent = subprocess.Popen([sys.executable, "-c", parent_code], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    deadline = time.monotonic() + 10
    while not (tmp_path / "up").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    parent.kill()
    parent.wait(5)
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline, "the child outlived its parent"
        time.sleep(0.02)
