"""Processes that a command starts: where its commands are looked for, their lines, and their end."""

import subprocess
import sys

import pytest

from terminal.errors import ProcessError
from terminal.processes import Process, own_command
from tests.patience import PROCESS_PATIENCE

SHELL = "/bin/sh"


def test_our_commands_are_never_those_of_other_software(tmp_path, monkeypatch):
    (tmp_path / "hub").touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "elsewhere" / "python"))
    assert own_command("hub") == [sys.executable, "-P", "-m", "rosbayes", "hub"]
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    assert own_command("hub") == [str(tmp_path / "hub")]
    assert own_command("./hub") == ["./hub"]


@pytest.mark.process
async def test_a_failed_process_is_named_with_its_last_line_and_its_exit_code(tmp_path):
    shown = []
    process = Process("sh", tmp_path / "log", show=shown.append)
    await process.start(SHELL, "-c", "echo ready; echo error: no luck >&2; exit 3")
    assert (await process.line("rea.y"))[0] == "ready"
    for failing in (process.succeed(), process.line("never")):
        with pytest.raises(ProcessError, match=r"^sh: no luck \(all that it said is in .*log\)$") as caught:
            await failing
        assert caught.value.exit_code == 3
    assert shown == ["ready"]
    assert (tmp_path / "log").read_text() == "ready\nerror: no luck\n"


@pytest.mark.process
async def test_a_process_that_is_ended_is_not_shown_any_more(tmp_path):
    shown = []
    process = Process("sh", tmp_path / "log", show=shown.append)
    await process.end()  # it has not started
    await process.start(
        SHELL, "-c", "trap 'echo terminated; exit 143' TERM; echo ready; while :; do sleep 0.1; done"
    )
    await process.line("ready")
    await process.end()
    assert (shown, await process.wait()) == (["ready"], 143)
    assert "terminated" in (tmp_path / "log").read_text()


FORKING = """
import asyncio, os, socket, sys, tempfile
from pathlib import Path
from terminal.processes import Process

async def main():
    folder = tempfile.TemporaryDirectory()
    ours, theirs = socket.socketpair()
    hub = Process("hub", Path(folder.name, "hub.log"), forks=True)
    await hub.start("hub", "--port", "0")
    await hub.line(r"ws://\\S+")
    words = Path(f"/proc/{hub.pid}/cmdline").read_bytes().split(b"\\0")
    theirs.close()
    ours.setblocking(False)
    assert ours.recv(1) == b"", "the fork has kept a descriptor"
    await hub.end()
    assert Path(folder.name).exists(), "the fork has done what this process does at its exit"
    print(Path(os.fsdecode(words[1])).name, hub._process.returncode)

asyncio.run(main())
"""


@pytest.mark.process
def test_a_forked_command_is_as_if_it_had_been_executed():
    done = subprocess.run(
        [sys.executable, "-c", FORKING, *("x" for _ in range(200))],
        capture_output=True,
        text=True,
        check=False,
        timeout=PROCESS_PATIENCE,
    )
    assert (done.stdout, done.stderr) == ("hub 143\n", "")
