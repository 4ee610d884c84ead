"""The rules of tests/conftest.py: a test says that it starts processes, and leaves nothing behind."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).parents[1]

TESTS = """
import asyncio, socket, subprocess, threading
import pytest
import uvloop

held = []

@pytest.fixture(scope="module")
def wide():
    held.append(socket.socket())
    yield
    held.pop().close()

def test_starts_a_process():
    subprocess.run(["true"])

def test_hides_that_it_starts_a_process():
    try:
        subprocess.run(["true"])
    except Exception:
        pass

def test_starts_a_process_by_uvloop():
    async def start():
        await (await asyncio.create_subprocess_exec("true")).wait()

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(start())

@pytest.mark.process
def test_may_start_a_process():
    subprocess.run(["true"])

@pytest.mark.thorough
def test_leaves_a_process():
    held.append(subprocess.Popen(["sleep", "3600"]))

def test_leaves_a_thread():
    event = threading.Event()
    held.append(event)
    threading.Thread(target=event.wait).start()

def test_leaves_a_socket():
    held.append(socket.socket())

async def test_leaves_a_task():
    held.append(asyncio.create_task(asyncio.sleep(3600)))

async def test_cancels_its_task():
    asyncio.create_task(asyncio.sleep(3600)).cancel()

def test_uses_a_wide_fixture(wide):
    pass

@pytest.mark.thorough
def test_ends_all():
    for each in held:
        if isinstance(each, subprocess.Popen):
            each.kill()
            each.wait()
        elif isinstance(each, threading.Event):
            each.set()
        elif isinstance(each, socket.socket):
            each.close()
"""


@pytest.mark.process
def test_who_breaks_a_rule_fails_and_is_told_which(tmp_path):
    (tmp_path / "test_all.py").write_text(TESTS)
    command = [
        sys.executable,
        *["-m", "pytest", "-p", "tests.conftest", "-o", "asyncio_mode=auto", "-q", "-rfE"],
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TEST_PATIENCE": "0.02", "COLUMNS": "1000"}
    ran = subprocess.run(
        command,
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PROCESS_PATIENCE,
        check=False,
    )
    told = dict(re.findall(r"^(?:FAILED|ERROR) test_all\.py::test_(\w+) - (.*)", ran.stdout, re.MULTILINE))
    assert set(told) == {
        "starts_a_process",
        "hides_that_it_starts_a_process",
        "starts_a_process_by_uvloop",
        "leaves_a_process",
        "leaves_a_thread",
        "leaves_a_socket",
        "leaves_a_task",
    }, ran.stdout
    for name, sentence in told.items():
        assert ("is not marked process or thorough" if "starts" in name else f"leaves {name[9:]}") in sentence
