"""Children: their errors are kept, their other lines forwarded, and their ends noticed."""

import asyncio
import os
import select
import signal
import subprocess
import sys
import time

import pytest
import uvloop

from services.child import LONGEST_LINE, RESTARTS, Child, _Pipe, end_all
from services.errors import StackError
from terminal.errors import ExitCode
from tests.patience import PATIENCE, PROCESS_PATIENCE


@pytest.fixture(
    params=[
        pytest.param(asyncio.new_event_loop, id="asyncio"),
        pytest.param(uvloop.new_event_loop, id="uvloop", marks=pytest.mark.thorough),
    ]
)
def run(request):
    """Run a coroutine on each of the event loops that a parent may have."""

    def run(coroutine):
        with asyncio.Runner(loop_factory=request.param) as runner:
            return runner.run(asyncio.wait_for(coroutine, PATIENCE))

    return run


def child(code):
    return Child("tester", [sys.executable, "-c", code])


async def failure_of(code, number=0):
    one = child(code)
    await one.start()
    if number:
        os.kill(one.pid, number)
    await one.wait()
    assert not one.is_running
    one.close()
    return one.failure()


def ended(run, capsys, code, number=0):
    """The failure of a child, its exit code, and what was passed on."""
    failure = run(failure_of(f"import os, sys, time; from terminal.output import *; {code}", number))
    return str(failure), failure.exit_code, capsys.readouterr().err.splitlines()


@pytest.mark.process
def test_an_end_is_an_error_with_the_childs_own_sentence_and_code(run, capsys):
    code = "print('starting', file=sys.stderr); say_error('no\\n luck'); sys.exit(3)"
    assert ended(run, capsys, code) == ("no\n luck", 3, ["starting"])


HALF_A_REPORT = "os.write(int(os.environ[ERROR_DESCRIPTOR]), b'{\"error\"')"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("code", "number", "sentence", "lines"),
    [
        ("print('one', file=sys.stderr)", 0, "ended by itself with exit code 0", ["one"]),
        (
            f"print('error: half', file=sys.stderr, end=''); {HALF_A_REPORT}",
            0,
            "ended by itself with exit code 0",
            ["error: half"],
        ),
        ("time.sleep(1000)", signal.SIGKILL, "was killed by SIGKILL", []),
        ("time.sleep(1000)", signal.SIGRTMIN + 1, "was killed by signal 35", []),
    ],
    ids=["silent", "no report", "killed", "nameless signal"],
)
def test_an_end_without_a_report_is_described(run, capsys, code, number, sentence, lines):
    assert ended(run, capsys, code, number) == (f"tester {sentence}", ExitCode.CHILD, lines)


@pytest.mark.thorough
def test_a_line_is_passed_on_while_the_child_runs(run, capsys):
    async def until_said():
        one = child("import sys, time; print('ready', file=sys.stderr, flush=True); time.sleep(1000)")
        await one.start()
        while "ready\n" not in capsys.readouterr().err:
            await asyncio.sleep(0.01)
        assert await end_all([one], PATIENCE) == []

    run(until_said())


async def test_output_without_an_end_of_line_is_passed_on_in_pieces():
    pieces = []
    pipe = _Pipe(pieces.append)
    for _ in range(2 * LONGEST_LINE // 4096 + 1):
        os.write(pipe.writer, bytes(4096).replace(b"\0", b"x"))
        pipe.read()
    assert [len(piece) for piece in pieces] == [LONGEST_LINE] * 2
    pipe.read(last=True)
    assert pieces[2:] == ["x" * 4096]
    os.close(pipe.writer)
    pipe.close()


@pytest.mark.thorough
def test_an_end_is_noticed_though_a_grandchild_holds_standard_error(run, tmp_path):
    grandchild = tmp_path / "pid"
    code = (
        "import os, pathlib, subprocess; from terminal.output import say_error;"
        "one = subprocess.Popen(['sleep', '1000'], close_fds=False);"
        f"pathlib.Path({str(grandchild)!r}).write_text(str(one.pid)); say_error('gone'); os._exit(5)"
    )
    assert run(failure_of(code)).exit_code == 5
    os.kill(int(grandchild.read_text()), signal.SIGKILL)


@pytest.mark.parametrize(
    ("ignores", "killed"),
    [
        pytest.param(True, ["tester"], marks=pytest.mark.process),
        pytest.param(False, [], marks=pytest.mark.thorough),
    ],
)
def test_a_stubborn_child_is_killed_and_named(run, tmp_path, ignores, killed):
    up = tmp_path / "up"

    async def end():
        one = child(
            f"import signal, time; signal.signal(signal.SIGTERM, signal.{'SIG_IGN' if ignores else 'SIG_DFL'});"
            f"open({str(up)!r}, 'w').close(); time.sleep(1000)"
        )
        await one.start()
        while not up.exists():
            await asyncio.sleep(0.02)
        assert await end_all([child(""), one], 0.2 if ignores else PATIENCE) == killed
        assert one.exit_code == (-signal.SIGKILL if ignores else -signal.SIGTERM)

    run(end())


def test_restarts_are_bounded(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("services.child.time.monotonic", lambda: now[0])
    one = child("")
    assert [one.may_restart(5.0) for _ in range(RESTARTS + 1)] == [True] * RESTARTS + [False]
    now[0] += 5.1
    assert one.may_restart(5.0)
    assert one.restarts == RESTARTS + 2


@pytest.mark.thorough
def test_a_command_that_is_not_there(run):
    with pytest.raises(StackError) as refused:
        run(Child("tester", ["/nonexistent/command"]).start())
    assert refused.value.exit_code == ExitCode.USAGE


@pytest.mark.process
def test_a_child_ends_when_its_parent_is_killed(tmp_path):
    child_code = (
        "import time; from services.child import end_with_parent; end_with_parent();"
        f"open({str(tmp_path / 'up')!r}, 'w').close(); time.sleep(1000)"
    )
    parent_code = f"""
import asyncio, sys, time
from services.child import Child

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


@pytest.mark.process
def test_the_boards_of_a_run_do_not_wait_for_the_imports_of_its_master():
    slow = "{'bridge.client', 'numba', 'numpy', 'posteriors', 'rich'}"
    code = f"import sys, services.commands.master; print(*(set(sys.modules) & {slow}))"
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, timeout=PROCESS_PATIENCE
    )
    assert found.stdout == b"\n"
