"""The status socket: one JSON object per connection, only for its user, with hostile clients and servers.

is_ready, read_status ──▶ NAME.status.sock ◀── serve_health, in_thread of a blocking process
"""

import asyncio
import contextlib
import gc
import json
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import uvloop

from services import ready
from terminal.health import (
    ANSWER_LIMIT,
    NoHealthError,
    in_thread,
    is_ready,
    read_status,
    serve_health,
    status_socket,
)
from tests.patience import PATIENCE


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
        thread = [each for each in threading.enumerate() if each.name == "event loop"][
            -1
        ]  # others may end yet
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
    slow = "{'msgspec','asyncio','typer','numpy','orjson','pydantic'}"
    code = f"import sys, services.ready; sys.exit(bool(set(sys.modules) & {slow}))"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PATIENCE).returncode == 0
