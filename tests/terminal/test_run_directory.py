"""The run directory and the status sockets in it: private, locked by one run, with hostile clients and servers."""

import asyncio
import contextlib
import gc
import json
import os
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest
import uvloop

from services import ready
from terminal.errors import OutputError
from terminal.health import (
    ANSWER_LIMIT,
    NoHealthError,
    in_thread,
    is_ready,
    read_status,
    serve_health,
    status_socket,
)
from terminal.run_directory import (
    LockedRunDirectory,
    OccupiedError,
    default_run_directory,
    run_directory,
    status_directory,
)
from tests.patience import PATIENCE, PROCESS_PATIENCE


@contextlib.contextmanager
def serving(directory, status, name="board0"):
    """A process's health, served from a thread."""
    with in_thread(lambda: serve_health(directory, name, lambda: json.dumps(status).encode())):
        yield


def status(*, is_ready=True, why="programmed"):
    return {"ready": is_ready, "why": why}


def test_every_connection_gets_one_object(tmp_path):
    path = status_socket(tmp_path, "board0")
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(path)  # that of a killed process is replaced
    with serving(tmp_path, status()), contextlib.ExitStack() as stack:
        for _ in range(20):  # those that do not read keep nobody from asking
            stack.enter_context(socket.socket(socket.AF_UNIX)).connect(path)
        assert is_ready(path, PATIENCE) == (True, "programmed")
        assert json.loads(read_status(path, PATIENCE)) == status()
        assert stat.S_IMODE(Path(path).stat().st_mode) == 0o600
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("new_loop", [asyncio.new_event_loop, uvloop.new_event_loop])
def test_a_client_that_goes_away_leaves_no_error_behind(tmp_path, new_loop):
    path = status_socket(tmp_path, "board0")

    async def serve(size):
        async with serve_health(tmp_path, "board0", lambda: b"x" * size):
            for turns in range(8):
                with socket.socket(socket.AF_UNIX) as leaving:
                    leaving.setblocking(False)
                    leaving.connect(path)
                    for _ in range(turns):
                        await asyncio.sleep(0)
            assert len(await asyncio.to_thread(read_status, path, PATIENCE)) == size
            await asyncio.sleep(0)

    def failed_futures():
        ended = [each for each in gc.get_objects() if isinstance(each, asyncio.Future) and each.done()]
        return [each for each in ended if not each.cancelled() and each.exception() is not None]

    gc.collect()
    gc.disable()
    try:
        before = failed_futures()  # of other tests
        with asyncio.Runner(loop_factory=new_loop) as runner:
            for size in (10, ANSWER_LIMIT):
                runner.run(serve(size))
        failed = [each for each in failed_futures() if not any(each is other for other in before)]
    finally:
        gc.enable()
    assert not failed  # the collector would report them


def test_a_second_process_of_a_name_warns_and_leaves_it_to_the_first(tmp_path, capsys):
    path = status_socket(tmp_path, "board0")
    with serving(tmp_path, status(why="first")):
        with serving(tmp_path, status(why="second")):
            assert is_ready(path, PATIENCE)[1] == "first"
        assert is_ready(path, PATIENCE)[1] == "first"
    assert capsys.readouterr().err.count("warning") == 1


def test_nothing_is_served_without_a_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with serving(None, status()):
        assert not list(tmp_path.iterdir())


def test_the_thread_takes_no_signals(tmp_path):
    with serving(tmp_path, status()):
        thread = [each for each in threading.enumerate() if each.name == "status"][-1]  # others may end yet
        lines = Path(f"/proc/self/task/{thread.native_id}/status").read_text().splitlines()
        blocked = next(line.split()[1] for line in lines if line.startswith("SigBlk"))
    assert int(blocked, 16) & (1 << 14)  # SIGTERM is 15


@contextlib.contextmanager
def answering(path, data):
    """A process that answers one connection with some bytes."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path)
        listener.listen()

        def answer():
            connection, _ = listener.accept()
            with connection, contextlib.suppress(OSError):
                connection.sendall(data)

        thread = threading.Thread(target=answer)
        thread.start()
        yield
        thread.join(PATIENCE)


@pytest.mark.parametrize(
    "data",
    [b"", b"hello", b"{}", b"[" * 100_000, b'{"ready":true}', b"\xff\xfe", b" " * (ANSWER_LIMIT + 2), b"7"],
    ids=["nothing", "text", "no fields", "deep", "no reason", "no text", "endless", "number"],
)
def test_an_answer_that_is_not_a_status_is_not_ready(tmp_path, data):
    path = status_socket(tmp_path, "hub")
    with answering(path, data), pytest.raises(NoHealthError, match="version"):
        is_ready(path, PATIENCE)


def test_only_true_is_ready(tmp_path):
    path = status_socket(tmp_path, "hub")
    with answering(path, b'{"ready": 1, "why": "x"}'):
        assert is_ready(path, PATIENCE) == (False, "x")


def test_silence_has_a_reason(tmp_path):
    path = status_socket(tmp_path, "hub")

    def reason(timeout):
        with pytest.raises(NoHealthError) as silent:
            read_status(path, timeout)
        return str(silent.value)

    absent = reason(PATIENCE)
    with socket.socket(socket.AF_UNIX) as stuck:
        stuck.bind(path)
        stuck.listen()
        silent = reason(0.1)
    killed = reason(PATIENCE)
    # which of the three it is tells the user what to do
    assert ("not running" in absent, "within" in silent, "killed" in killed) == (True, True, True)


# --- python -m services.ready ----------------------------------------------------------------------


@pytest.mark.parametrize("is_ready", [True, False])
@pytest.mark.parametrize("flag", [["--run-directory", "{}"], ["--run-directory={}"], []])
def test_the_exit_code_is_the_health(tmp_path, capsys, monkeypatch, is_ready, flag):
    monkeypatch.setenv("BM_RUN_DIRECTORY", "" if flag else str(tmp_path))
    with serving(tmp_path, status(is_ready=is_ready, why="here"), "master"):
        assert ready.main([*(part.format(tmp_path) for part in flag), "master"]) == (not is_ready)
    assert capsys.readouterr().out == "master: here\n"


@pytest.mark.parametrize("arguments", [["hub"], [], ["a", "b"], ["../x"], ["--what"]])
@pytest.mark.parametrize("directory", [True, False])
def test_the_health_check_is_never_green_by_mistake(arguments, directory, monkeypatch, tmp_path):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path) if directory else "")
    assert ready.main(arguments) == 1


@pytest.mark.thorough
def test_the_health_check_imports_nothing_slow():
    slow = "{'msgspec','asyncio','typer','structlog','orjson','pydantic'}"
    code = f"import sys, services.ready; sys.exit(bool(set(sys.modules) & {slow}))"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PATIENCE).returncode == 0


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
