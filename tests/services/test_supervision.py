"""Children: their errors kept, their other lines passed on, their ends found out, whatever the parent's end."""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from services.errors import ServiceError
from services.supervision import KEPT, RESTARTS, Child, PrivateDirectory, end_all, make_private_directory
from terminal.errors import ExitCode

PATIENCE = 50.0


def child(code: str) -> Child:
    return Child("tester", [sys.executable, "-c", code])


async def ended(one: Child) -> None:
    await asyncio.wait_for(one.ended(), PATIENCE)


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


async def test_a_stubborn_child_is_killed_and_named(tmp_path):
    one = child(
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
        f"open({str(tmp_path / 'up')!r}, 'w').close(); time.sleep(60)"
    )
    one.start()
    deadline = time.monotonic() + PATIENCE
    while not (tmp_path / "up").exists():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)
    assert await end_all([one], 0.2) == ["tester"]
    assert one.exit_code() == -signal.SIGKILL


async def test_a_willing_child_ends_without_a_kill():
    one = child("import time; time.sleep(60)")
    one.start()
    assert await end_all([one], PATIENCE) == []


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


@pytest.mark.parametrize("runtime", ["", ".", "relative", "/nonexistent", sys.executable, "/" + "x" * 60])
def test_a_runtime_directory_that_is_none_is_passed_over(tmp_path, monkeypatch, runtime):
    (tmp_path / "relative").mkdir()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "other"))
    assert make_private_directory().parent == tmp_path / "other"


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
    deadline = time.monotonic() + PATIENCE
    while not (tmp_path / "up").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    parent.kill()
    parent.wait(PATIENCE)
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline, "the child outlived its parent"
        time.sleep(0.02)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Where runs have their directories, in this test."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def left_by_a_killed_master(place, name, *, mode=0o700):
    """What is there after a SIGKILL: a socket that nobody listens on, and a deployment's copy."""
    directory = place / name
    directory.mkdir()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(directory / "b.sock"))
    (directory / f"{KEPT}0" / "boards").mkdir(parents=True)
    (directory / f"{KEPT}0" / "boards" / "board0.bm").write_bytes(b"x")
    directory.chmod(mode)
    return directory


def test_what_killed_masters_left_goes_with_the_next_start(place):
    empty = make_private_directory()
    full = left_by_a_killed_master(place, "rosbayes-abcdefg1")
    made = PrivateDirectory()
    assert [each.name for each in place.iterdir()] == [made.path.name]
    assert not empty.exists()
    assert not full.exists()
    made.remove()
    assert not list(place.iterdir())


def test_what_no_killed_master_left_stays(place):
    alive = PrivateDirectory()
    others = [
        left_by_a_killed_master(place, "rosbayes-open0000", mode=0o755),
        left_by_a_killed_master(place, "rosbayes-of-mine"),
        left_by_a_killed_master(place, "elsewhere"),
    ]
    work = left_by_a_killed_master(place, "rosbayes-mywork00")
    (work / "thesis.md").write_text("three years")
    linked = left_by_a_killed_master(place, "rosbayes-linking0")
    (linked / f"{KEPT}7").symlink_to(others[2])
    (place / "rosbayes-alink000").symlink_to(others[2])
    (place / "rosbayes-file0000").write_text("no folder")
    before = {each: sorted(each.rglob("*")) for each in place.iterdir()}
    made = PrivateDirectory()
    made.remove()
    assert {each: sorted(each.rglob("*")) for each in place.iterdir()} == before
    alive.remove()


def test_a_directory_that_is_taken_for_an_abandoned_one_while_it_is_made_is_made_again(place, monkeypatch):
    made = []

    def make():
        made.append(make_private_directory())
        if len(made) < 3:  # another master starts before this one has its lock
            made[-1].rmdir()
        return made[-1]

    monkeypatch.setattr("services.supervision.make_private_directory", make)
    private = PrivateDirectory()
    assert private.path == made[-1]
    assert len(made) == 3
    assert private.path.is_dir()
    private.remove()


KILLED_IN_PART = """
import ctypes, os, platform, socket, subprocess, sys, threading, time
from services.supervision import DIRECTORY_VARIABLE, KEPT, PARENT_VARIABLE, PrivateDirectory
directory = PrivateDirectory().path
(directory / f"{KEPT}3").mkdir()
listener = socket.socket(socket.AF_UNIX)
listener.bind(str(directory / "master.status.sock"))
listener.listen()
variables = {PARENT_VARIABLE: str(os.getpid()), DIRECTORY_VARIABLE: str(directory)}
code = "import time; from services.supervision import end_with_parent; end_with_parent(); print(flush=True); time.sleep(100)"
child = subprocess.Popen([sys.executable, "-c", code], env=os.environ | variables, stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, directory, flush=True)
threading.Thread(target=lambda: (time.sleep(1), os._exit(0))).start()
exit_of_this_thread = {"x86_64": 60, "aarch64": 93}[platform.machine()]
ctypes.CDLL(None).syscall(exit_of_this_thread, 0)
"""


def test_a_parent_of_which_a_thread_still_dies_is_waited_for():
    # a socket's path has 107 bytes at most: pytest's own folders may be too deep
    with tempfile.TemporaryDirectory(dir="/tmp") as place:
        _leave_when_the_last_thread_is_dead(Path(place))


def _leave_when_the_last_thread_is_dead(place: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", KILLED_IN_PART],
        env=os.environ | {"TMPDIR": str(place), "XDG_RUNTIME_DIR": ""},
        stdout=subprocess.PIPE,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    child_pid = int(done.stdout.split()[0])
    deadline = time.monotonic() + PATIENCE
    with contextlib.suppress(psutil.NoSuchProcess):
        while psutil.Process(child_pid).status() != psutil.STATUS_ZOMBIE:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert list(place.iterdir()) == []
