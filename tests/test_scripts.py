"""Every script prints its usage, and none is silent for long."""

import asyncio
import contextlib
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from scripts.running import processes
from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = sorted(path for path in (ROOT / "scripts").iterdir() if path.is_file() and os.access(path, os.X_OK))


PARTS = {
    "bench": ("bridge", "cycle", "load", "mrclam"),
    "verify": ("conformance", "containers", "hdl", "networks", "resources", "rosbridge"),
}


@pytest.mark.thorough
def test_every_script_prints_its_usage(tmp_path):
    for script, part in [(path, part) for path in SCRIPTS for part in ("", *PARTS.get(path.name, ()))]:
        command = [script, *part.split(), "--help"]
        done = subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, timeout=PROCESS_PATIENCE, check=False
        )
        assert (done.returncode, done.stderr) == (0, ""), command
        assert script.name in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("terminal", [False, True])
async def test_a_screen_says_what_it_waits_for_when_nothing_else_comes(terminal, capsys, monkeypatch):
    now = [0.0]

    async def sleep(seconds):
        until = now[0] + seconds
        while now[0] < until:
            await asyncio.sleep(0)

    async def wait(seconds):
        now[0] += seconds
        for _ in range(3):  # the screen notices, speaks, and sleeps again
            await asyncio.sleep(0)

    monkeypatch.setattr(processes, "SILENCE", 2.0)
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(processes, "asyncio", SimpleNamespace(sleep=sleep))
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    screen = processes.Screen()
    saying = asyncio.create_task(screen.say_what_it_waits_for())
    for work in ("building", "drawing"):
        screen.waits_for = work
        for _ in range(4):
            screen.show("frame")
            await wait(1.0)
        assert capsys.readouterr().out == "frame\n" * 4
        for _ in range(5):
            await wait(2.0)
        screen.show("done")
        said = capsys.readouterr().out
        if terminal:
            assert said.count(work) == 5
            assert said.count("\n") == 1
        else:
            assert said.splitlines() == [f"... {work} .......", "done"]
    saying.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await saying
