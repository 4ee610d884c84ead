"""Fixtures and rules for all tests: their kinds, their limits, and what they may leave behind."""

import asyncio
import atexit
import contextlib
import gc
import os
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from asyncio import runners
from pathlib import Path

import psutil
import pytest
import uvloop
from hypothesis import HealthCheck, settings

from tests.patience import PATIENCE, PROCESS_TEST_LIMIT, TEST_LIMIT

# pytest-timeout reads it when pytest has loaded this file
os.environ["PYTEST_TIMEOUT"] = str(TEST_LIMIT)

# A shell that starts the tests in the background has Ctrl-C ignored for them, and so for every process that they start
# and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Masters of these tests do not share a run directory with those of other tests, or of the user.
os.environ["XDG_RUNTIME_DIR"] = tempfile.mkdtemp(prefix="rb-")
atexit.register(shutil.rmtree, os.environ["XDG_RUNTIME_DIR"], ignore_errors=True)

# Every run tries the same examples, and what one takes says something of the machine's load and not of the code.
# `--hypothesis-profile=search` tries others each time.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("steady", settings.get_profile("search"), derandomize=True)
settings.load_profile("steady")


def _end_with_children(number: int, _frame: object) -> None:
    """End all processes that the tests have started: many have a session of their own, which no signal reaches."""
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            child.kill()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


signal.signal(signal.SIGTERM, _end_with_children)


# Kinds: a test that starts a process is marked `process` (run one at a time) or `thorough` (only with --all).

_STARTS = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system"}
_PID = os.getpid()
_unmarked: str | None = None
"""The running test, if it may not start a process."""
_started: list[str] = []
"""Processes that it tried to start."""


def _refuse_processes(event: str, arguments: tuple) -> None:
    if event in _STARTS and _unmarked is not None and os.getpid() == _PID:
        what = f"{event}{arguments[:2]!r:.200}"
        _started.append(what)
        raise RuntimeError(f"{_unmarked} is not marked process or thorough, and starts a process: {what}")


sys.addaudithook(_refuse_processes)


def _may_start_processes(item: pytest.Item) -> bool:
    return any(item.get_closest_marker(kind) for kind in ("process", "thorough"))


def _is_second_loop(item: pytest.Item) -> bool:
    """Return whether a test runs on asyncio's loop too (`pytest_asyncio_loop_factories` in tests/bridge)."""
    parameters = (
        item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
    )
    is_chosen = any("loop_factories" in marker.kwargs for marker in item.iter_markers("asyncio"))
    return parameters.get("_asyncio_loop_factory") is uvloop.new_event_loop and not is_chosen


@pytest.hookimpl(tryfirst=True)  # before pytest selects by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if _is_second_loop(item):
            item.add_marker(pytest.mark.thorough)
        if _may_start_processes(item) and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(PROCESS_TEST_LIMIT))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    global _unmarked  # noqa: PLW0603  # an audit hook cannot be removed, so it reads what holds now
    _started.clear()
    _unmarked = None if _may_start_processes(item) else item.nodeid
    try:
        return (yield)
    finally:
        _unmarked = None


# Leaks: after each test and its fixtures, this process has no more children, threads, sockets and tasks than before.

_pending: set[str] = set()
"""Tasks that still ran when the event loop of a test was closed."""
_cancel_all_tasks = runners._cancel_all_tasks


def _note_pending_tasks(loop: asyncio.AbstractEventLoop) -> None:
    """Note the tasks that a test leaves, where asyncio cancels them; those that are about to end may do so."""
    deadline = time.monotonic() + PATIENCE
    left = asyncio.all_tasks(loop)
    while left and all(task.cancelling() for task in left) and time.monotonic() < deadline:
        loop.run_until_complete(asyncio.sleep(0))
        left = asyncio.all_tasks(loop)
    _pending.update(f"task {task.get_coro()}" for task in left)
    _cancel_all_tasks(loop)


runners._cancel_all_tasks = _note_pending_tasks


def _held() -> set[str]:
    """Children, threads and sockets of this process, from /proc: a walk of all processes would cost a minute."""
    held = {f"thread {thread.name} ({thread.ident})" for thread in threading.enumerate()}
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            held.update(f"process {pid}" for pid in (task / "children").read_text().split())
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            target = str(descriptor.readlink())
            if target.startswith("socket:"):
                held.add(target)
    return held


def _ended_children() -> int:
    """A number that grows with each child that has ended."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_minflt


@pytest.fixture(autouse=True)
def nothing_is_left(request: pytest.FixtureRequest):
    """Fail a test that leaves a process, a thread, a socket or a task.

    Fixtures of a wider scope are made before this one, so what they hold is not held against a test.
    """
    before, ended = _held(), _ended_children()
    _pending.clear()
    yield
    left = _held() - before
    if left:
        gc.collect()  # the collector closes unreachable sockets, and their warnings fail the test
    # a stopping thread, or a socket that its peer has closed, may take a moment
    deadline = time.monotonic() + PATIENCE / 5
    while (left := _held() - before) and time.monotonic() < deadline:
        time.sleep(0.01)
    left |= _pending
    assert not left, f"{request.node.name} leaves {', '.join(sorted(left))}"
    if not _may_start_processes(request.node) and _ended_children() != ended:
        _started.append("one that only the kernel has seen, as uvloop starts them")
    assert not _started, f"{request.node.name} is not marked process or thorough, and starts {_started}"
