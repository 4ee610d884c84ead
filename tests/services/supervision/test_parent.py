"""Children of a killed master: they end, and the last one removes the private directory."""

import contextlib
import os
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from services.supervision.parent import DIRECTORY_VARIABLE, leave_private_directory
from tests.patience import PROCESS_PATIENCE


@pytest.mark.process
def test_a_child_ends_when_its_parent_is_killed(tmp_path):
    child_code = (
        "import time; from services.supervision.parent import end_with_parent; end_with_parent();"
        f"open({str(tmp_path / 'up')!r}, 'w').close(); time.sleep(1000)"
    )
    parent_code = f"""
import asyncio, sys, time
from services.supervision.child import Child

async def main():
    one = Child("tester", [sys.executable, "-c", {child_code!r}])
    await one.start()
    print(one.pid, flush=True)
    await asyncio.sleep(1000)

asyncio.run(main())
"""
    with subprocess.Popen([sys.executable, "-c", parent_code], stdout=subprocess.PIPE, text=True) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        deadline = time.monotonic() + PROCESS_PATIENCE
        while not (tmp_path / "up").exists():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        parent.kill()
    try:
        assert select.select([child], [], [], PROCESS_PATIENCE)[0], "the child outlived its parent"
    finally:
        os.close(child)


KILLED_IN_PART = '''
import ctypes, os, platform, socket, subprocess, sys, threading, time
from services.supervision.parent import DIRECTORY_VARIABLE
from terminal.logs import PARENT_VARIABLE
from terminal.private_directory import PrivateDirectory
directory = PrivateDirectory().path
listener = socket.socket(socket.AF_UNIX)
listener.bind(str(directory / "master.status.sock"))
listener.listen()
variables = {PARENT_VARIABLE: str(os.getpid()), DIRECTORY_VARIABLE: str(directory)}
code = """
import time
from services.supervision.parent import end_with_parent
from terminal.signals import raise_on_signals
raise_on_signals()
end_with_parent()
print(flush=True)
time.sleep(100)
"""
child = subprocess.Popen([sys.executable, "-c", code], env=os.environ | variables, stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, directory, flush=True)
threading.Thread(target=lambda: (time.sleep(1), os._exit(0))).start()
exit_of_this_thread = {"x86_64": 60, "aarch64": 93}[platform.machine()]
ctypes.CDLL(None).syscall(exit_of_this_thread, 0)
'''


@pytest.fixture
def place():
    # a socket's path has 107 bytes at most: pytest's own folders may be too deep
    with tempfile.TemporaryDirectory(dir="/tmp") as place:
        yield Path(place)


@pytest.mark.thorough
def test_a_parent_with_a_dying_thread_is_awaited(place):
    done = subprocess.run(
        [sys.executable, "-c", KILLED_IN_PART],
        env=os.environ | {"TMPDIR": str(place), "XDG_RUNTIME_DIR": ""},
        stdout=subprocess.PIPE,
        text=True,
        timeout=PROCESS_PATIENCE,
        check=True,
    )
    child_pid = int(done.stdout.split()[0])
    deadline = time.monotonic() + PROCESS_PATIENCE
    with contextlib.suppress(psutil.NoSuchProcess):
        while psutil.Process(child_pid).status() != psutil.STATUS_ZOMBIE:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert list(place.iterdir()) == []


def test_a_directory_that_another_child_removes_meanwhile_is_left(tmp_path, monkeypatch):
    directory = tmp_path / "rosbayes-run"
    directory.mkdir()
    listed = os.scandir

    def vanish(path):
        directory.rmdir()
        return listed(path)

    monkeypatch.setenv(DIRECTORY_VARIABLE, str(directory))
    monkeypatch.setattr(os, "scandir", vanish)
    leave_private_directory()
    monkeypatch.undo()
    assert not directory.exists()
