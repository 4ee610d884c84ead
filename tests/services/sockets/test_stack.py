"""The processes of a run: found, queried in parallel, and shown by the command `status`."""

import asyncio
import contextlib
import io
import socket
import sys

import msgspec
import pytest
from rich.console import Console

from services.errors import SettingsError
from services.output.status_screen import screen, show
from services.sockets import status
from services.sockets.reporting import serve_status
from services.sockets.status import (
    BoardStatus,
    ConnectionStatus,
    FrameCounts,
    HubStatus,
    PeerStatus,
    ProcessStatus,
)
from tests.patience import PROCESS_PATIENCE


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """Give answers more time than a busy machine needs."""
    monkeypatch.setattr(status, "ANSWER_TIME", 30.0)


def process(*, is_ready=True, why="fine", **more):
    return ProcessStatus(ready=is_ready, why=why, **more)


def listener(directory, name):
    """The socket of a process that answers nothing: it was killed, or listens and is stuck."""
    silent = socket.socket(socket.AF_UNIX)
    silent.bind(str(directory / f"{name}.status.sock"))
    return silent


@contextlib.asynccontextmanager
async def served(directory, **processes):
    async with contextlib.AsyncExitStack() as stack:
        for name, told in processes.items():
            await stack.enter_async_context(
                serve_status(directory, name.replace("_", "-"), lambda told=told: told)
            )
        yield


def shown(stack, width=140):
    out = io.StringIO()
    Console(file=out, width=width).print(screen(stack))
    return out.getvalue()


FRAMES = FrameCounts(
    received=120, completed=100, lost={"passed over": 19}, last_number=100, last_age_s=0.2, rate=10.0
)


async def test_everyone_is_asked_and_says_what_it_waits_for(tmp_path):
    peers = [
        PeerStatus(name="pcie-app", endpoint="unix:/run/pcie-app.sock", pid=0, restarts=0, ready=False),
        PeerStatus(name="hub", endpoint="unix:/run/hub.sock", pid=0, restarts=0, ready=True),
    ]
    listener(tmp_path, "subscriber").close()
    async with served(
        tmp_path,
        master=process(peers=peers),
        publisher=process(is_ready=False, why="waiting for ws://robot:9090"),
        board10=process(),
        board2=process(),
    ):
        stack = await status.ask_stack(tmp_path)
    assert not stack.ready
    assert [each.name for each in stack.processes] == ["master", "publisher", "board2", "board10"]
    assert [each.name for each in stack.silent] == ["subscriber", "pcie-app"]
    assert "unix:/run/pcie-app.sock" in stack.silent[1].why  # it has no socket at all
    assert [why.split(":")[0] for why in stack.why] == ["publisher", "subscriber", "pcie-app"]
    assert "publisher: waiting for ws://robot:9090" in shown(stack)


async def test_silent_processes_are_asked_at_the_same_time(tmp_path):
    silent = ("subscriber", "publisher", "pcie-app", "board0")
    together = asyncio.Barrier(len(silent))

    async def end_together(_reader, writer):
        await together.wait()  # otherwise the first one would not end within its time
        writer.close()

    async with contextlib.AsyncExitStack() as sockets:
        for name in silent:
            path = tmp_path / f"{name}.status.sock"
            await sockets.enter_async_context(await asyncio.start_unix_server(end_together, path))
        async with served(tmp_path, master=process()):
            stack = await status.ask_stack(tmp_path)
    assert [each.name for each in stack.processes] == ["master"]
    assert tuple(each.name for each in stack.silent) == silent
    assert [each.why for each in stack.silent if "within" in each.why] == []


async def test_thousands_of_silent_sockets_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(status, "ANSWER_TIME", 0.2)
    with contextlib.ExitStack() as sockets:
        sockets.enter_context(listener(tmp_path, "board0")).listen()  # it lives, and does not answer
        for number in range(1, 1000):
            listener(tmp_path, f"board{number}").close()
        with pytest.raises(SettingsError) as caught:
            await show(tmp_path, needs_master=False, watch=False, json=False)
    monkeypatch.setattr(status, "ANSWER_TIME", 30.0)  # now all have been killed, and the master answers
    async with served(tmp_path, master=process()):
        text = shown(await status.ask_stack(tmp_path))
    sentence = str(caught.value)
    assert "board0: it does not answer" in sentence
    assert "board1: it was killed" in sentence
    assert "997 more" in sentence
    assert len(sentence) < 1000
    assert text.count("980 more") == 2
    assert text.count("\n") < 80


async def test_one_screen_has_services_boards_rates_and_losses(tmp_path):
    board = BoardStatus(
        index=1, endpoint="tcp://10.0.0.2:7000", state="programmed", image="ab" * 32, last_cycles=512
    )
    own = BoardStatus(index=1, endpoint="tcp://10.0.0.2:7000", state="blank", restarts=3)
    async with served(
        tmp_path,
        publisher=process(frames=FRAMES, connections=[ConnectionStatus("ws://robot:9090", "connected", 2)]),
        pcie_app=process(boards=[board]),
        board1=process(boards=[own]),
        hub=process(hub=HubStatus(3, 5, 7)),
    ):
        text = shown(await status.ask_stack(tmp_path))
    words = (
        "hub: 3 clients, 5 topics, 7 services",
        "100, 0.2 s ago",
        "19 passed over",
        "ws://robot:9090",
        "512",
    )
    assert [each for each in words if each not in text] == []
    row = next(line.split() for line in text.splitlines() if "tcp://" in line)
    assert row[:4] == ["1", "programmed", "abababababab", "3"]


@pytest.mark.parametrize(
    ("uri", "names"), [("ws://localhost:9091", ["hub", "publisher"]), ("ws://localhost:9090", ["publisher"])]
)
async def test_a_hub_that_no_service_uses_is_of_another_run(tmp_path, uri, names):
    publisher = process(connections=[ConnectionStatus(uri, "connected", 0)])
    async with served(tmp_path, publisher=publisher, hub=process(hub=HubStatus(3, 5, 7, 9091))):
        stack = await status.ask_stack(tmp_path, shared=True)
        named = await status.ask_stack(tmp_path)
    assert [each.name for each in stack.processes] == names
    assert len(named.processes) == 2


def test_every_process_has_its_cpu_time():
    """Those of the boat report no recent one."""
    boat = process(name="boat-simulator", version="", cpu_s=3.0, uptime_s=40.0)
    hub = process(name="hub", version="1", cpu_percent=2.5, cpu_s=9.0, uptime_s=40.0)
    stack = status.StackStatus(directory="here", ready=True, why=[], processes=[boat, hub], silent=[])
    rows = {line.split()[0]: line.split() for line in shown(stack, 200).splitlines() if line[:1].isalpha()}
    assert "7.5" in rows["boat-simulator"]
    assert "2.5" in rows["hub"]


async def test_what_a_process_says_can_not_write_over_the_terminal(tmp_path):
    sly = process(is_ready=False, why="[red]\x1b[2Jgone\r\nall ready" + "x" * 10_000)
    async with served(tmp_path, hub=sly):
        text = shown(await status.ask_stack(tmp_path))
    assert "\x1b" not in text
    assert "[red]?[2Jgone??all" in text
    assert len(text) < 3000


async def test_a_user_s_own_run_needs_a_master(tmp_path, capsys):
    async with served(tmp_path, hub=process(hub=HubStatus(3, 5, 7))):
        assert await show(tmp_path, needs_master=False, watch=False, json=False) == 0
        assert f"{tmp_path}: hub is ready" in capsys.readouterr().out
        with pytest.raises(SettingsError, match="no master runs in .*, only hub; start one"):
            await show(tmp_path, needs_master=True, watch=False, json=False)
        assert not capsys.readouterr().out
        async with served(tmp_path, master=process()):
            assert await show(tmp_path, needs_master=True, watch=False, json=True) == 0
    assert '"clients":3' in capsys.readouterr().out


@pytest.mark.process
async def test_watching_prints_a_line_every_second_until_it_is_ended(tmp_path):
    async with served(tmp_path, master=process()):
        watching = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "services.commands.status", "--watch", "--json"),
            *("--run-directory", str(tmp_path)),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        found = 0
        async with asyncio.timeout(PROCESS_PATIENCE):
            while found < 2:  # on a busy machine an answer may come too late for a line
                line = await watching.stdout.readline()
                found += msgspec.json.decode(line, type=status.StackStatus).ready
        watching.terminate()
        assert await asyncio.wait_for(watching.wait(), PROCESS_PATIENCE) == 143
        assert b"Traceback" not in await watching.stderr.read()
