"""How a process with one blocking thread takes a signal, wherever it stands."""

import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from services.supervision.parent import DIRECTORY_VARIABLE
from services.supervision.private_directory import COPY_PREFIX
from terminal.errors import ExitCode

_STANDS = {
    "in a function that C code calls back": """
import ctypes
callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGTERM))
callback()
""",
    "in a finaliser": """
class Held:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)
Held()
""",
    "where whatever goes wrong is caught": """
try:
    signal.raise_signal(signal.SIGTERM)
except Exception:
    pass
""",
    "in a wait": "import os, threading; threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()",
}


@pytest.mark.parametrize("stands", _STANDS)
def test_a_signal_ends_a_process_wherever_it_stands(stands):
    code = f"""
import signal, time
from terminal.running import ends_well, make_app, raise_on_signals
app = make_app("wait")

@app.command()
@ends_well
def wait():
    raise_on_signals()
    exec({_STANDS[stands]!r})
    time.sleep(20)

app()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=240
    )
    assert (ended.returncode, ended.stderr) == (ExitCode.TERMINATED, "asked to end (SIGTERM)\n")


def test_a_child_that_ends_before_it_has_anything_open_tidies_up_after_a_killed_master():
    # a socket's path has 107 bytes at most: pytest's own folders may be too deep
    left = Path(tempfile.mkdtemp(dir="/tmp"))
    (left / f"{COPY_PREFIX}1").mkdir()
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(left / "master.status.sock"))
    code = """
import signal
from terminal.running import ends_well, make_app, raise_on_signals
app = make_app("wait")

@app.command()
@ends_well
def wait():
    raise_on_signals()
    signal.raise_signal(signal.SIGTERM)

app()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        env=os.environ | {DIRECTORY_VARIABLE: str(left)},
        timeout=240,
    )
    assert (ended.returncode, left.exists()) == (ExitCode.TERMINATED, False)


def test_another_exception_that_is_dropped_is_told_as_ever():
    code = """
from terminal.running import raise_on_signals
raise_on_signals()
class Held:
    def __del__(self):
        raise ValueError("lost")
Held()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=240
    )
    assert ended.returncode == 0
    assert "ValueError: lost" in ended.stderr


@pytest.mark.parametrize("printed", ["print(1)", "print(1, flush=True)", "put_json(1)", "Console().print(1)"])
def test_an_output_that_takes_nothing_more_is_one_sentence(printed):
    code = f"""
from rich.console import Console
from terminal.running import ends_well, make_app
from terminal.logs import put_json
app = make_app("print")

@app.command()
@ends_well
def say():
    {printed}

app()
"""
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-c", code],
            check=False,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=240,
        )
    assert (ended.returncode, ended.stderr) == (
        ExitCode.USAGE,
        "error: the output can't be written: No space left on device; free some space, or send it elsewhere\n",
    )


def test_too_few_files_that_may_be_open_are_one_sentence():
    code = """
import resource
from terminal.running import ends_well, make_app, run_async
app = make_app("wait")

async def work():
    return 0

@app.command()
@ends_well
def wait():
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))
    run_async(work())

app()
"""
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], check=False, capture_output=True, text=True, timeout=240
    )
    assert ended.returncode == ExitCode.USAGE
    assert "Traceback" not in ended.stderr
    assert ended.stderr.endswith(
        "error: this process can't open what it needs: Too many open files; allow more (ulimit -n), or end what holds them\n"
    )
