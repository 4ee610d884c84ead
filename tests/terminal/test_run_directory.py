"""The run directory: private, locked by one run at a time, and free once the last of its processes has ended."""

import contextlib
import os
import socket
import stat
import subprocess
import sys
import tempfile
import time

import pytest

from terminal.errors import OutputError
from terminal.run_directory import (
    LockedRunDirectory,
    OccupiedError,
    default_run_directory,
    run_directory,
    status_directory,
)
from tests.patience import PROCESS_PATIENCE


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The folder of temporary files of this test, without a runtime directory."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("runtime", ["", ".", "relative", "/nonexistent", sys.executable, "/" + "x" * 60])
def test_a_runtime_directory_that_is_none_is_passed_over(place, monkeypatch, runtime):
    (place / "relative").mkdir()
    monkeypatch.chdir(place)
    monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
    made = run_directory(None)
    assert (made.parent, made.stat().st_mode & 0o777) == (place, 0o700)
    assert run_directory(None) == made  # it may exist


def test_the_runtime_directory_is_preferred(monkeypatch):
    # pytest's own folders may be too deep for a socket
    with tempfile.TemporaryDirectory(dir="/tmp") as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        assert str(default_run_directory()) == f"{runtime}/rosbayes"


@pytest.mark.parametrize("kind", ["link", "file", "open"])
def test_a_place_that_somebody_else_may_have_prepared_is_refused(place, kind, capsys):
    path = default_run_directory()
    (place / "target").mkdir(mode=0o700)
    if kind == "link":
        path.symlink_to(place / "target")
    elif kind == "file":
        path.touch()
    else:
        path.mkdir()
        path.chmod(0o755)
    with pytest.raises(OutputError):
        run_directory(None)
    assert status_directory(None, "hub") is None
    assert "hub: warning: " in capsys.readouterr().err


def test_a_named_directory_is_created_for_this_user_alone(tmp_path):
    LockedRunDirectory(tmp_path / "new").release()
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o700
    with pytest.raises(OutputError):
        LockedRunDirectory(tmp_path / "missing" / "new")
    tmp_path.chmod(0o750)
    with pytest.raises(OutputError):
        LockedRunDirectory(tmp_path)


def test_one_run_at_a_time_and_what_a_killed_one_left_is_removed(place):
    first = LockedRunDirectory(None)
    with pytest.raises(OccupiedError):
        LockedRunDirectory(None)
    LockedRunDirectory(place / "other").release()  # another run is possible elsewhere
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(first.path / "master.status.sock"))
    (first.path / "board0.sock").touch()
    first.release()
    assert [each.name for each in first.path.iterdir()] == ["board0.sock"]
    LockedRunDirectory(None).release()


@pytest.mark.process
def test_a_child_keeps_the_directory_of_a_killed_run_until_it_ends(place):
    run = LockedRunDirectory(None)
    code = "import sys; sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, pass_fds=[run.lock]) as child:
        os.close(run.lock)  # as the end of the run's own process does
        with pytest.raises(OccupiedError):
            LockedRunDirectory(None)
        child.stdin.close()
        deadline = time.monotonic() + PROCESS_PATIENCE
        while time.monotonic() < deadline:
            with contextlib.suppress(OccupiedError):
                LockedRunDirectory(None).release()
                return
            time.sleep(0.01)
    pytest.fail("the directory stays locked")
