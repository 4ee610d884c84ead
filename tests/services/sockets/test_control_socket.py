"""Orders to a master: one line in, one object out, and a refusal for anything else."""

import asyncio
import contextlib
import json
import stat

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.errors import ControlError, NotReloadedError, ReportedError, ShapeError
from services.sockets import control_socket
from services.sockets.control_socket import (
    ANSWER_LIMIT,
    CLIENTS,
    ReloadOrder,
    give_order,
    order_of,
    serve_control,
)
from terminal.errors import ExitCode
from tests.patience import PATIENCE


@pytest.fixture
def path(tmp_path):
    return control_socket.control_socket(tmp_path)


async def answer_to(path, data):
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(data)
    answer = await asyncio.wait_for(reader.read(), PATIENCE)
    writer.close()
    return json.loads(answer)


@given(st.text(max_size=60), st.binary(max_size=200))
def test_any_bytes_are_an_order_or_refused(folder, data):
    assert order_of(json.dumps({"order": "reload", "folder": folder}).encode()).folder == folder
    with contextlib.suppress(ControlError):
        order_of(data)


async def test_an_order_is_executed_and_answered(path):
    folders = []

    async def execute(order):
        folders.append(order.folder)
        if order.folder == "/other":
            raise ShapeError("another shape")
        return "done"

    async with serve_control(path.parent, execute):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert await give_order(path, ReloadOrder("/a"), timeout=PATIENCE) == "done"
        assert await give_order(path, ReloadOrder(), timeout=PATIENCE) == "done"
        with pytest.raises(ReportedError) as refused:
            await give_order(path, ReloadOrder("/other"), timeout=PATIENCE)
        assert (str(refused.value), refused.value.exit_code) == ("another shape", ExitCode.USAGE)
    assert folders == ["/a", "", "/other"]
    assert not path.exists()
    with pytest.raises(ControlError):
        await give_order(path, ReloadOrder(), timeout=PATIENCE)


@pytest.mark.parametrize(
    "data",
    [
        b"\n",
        b'{"order":"dance"}\n',
        b'{"order":"reload","folder":7}\n',
        b'{"order":"reload","folder":"/a","more":1}\n',
        b"[" * 9000 + b"\n",
        b"x" * 40_000,
        b'{"order"',
    ],
    ids=["nothing", "unknown", "no folder", "unknown field", "deep", "long", "unfinished"],
)
async def test_anything_else_is_refused(path, monkeypatch, data):
    monkeypatch.setattr(control_socket, "ORDER_TIME", 0.2)

    async def execute(_):
        raise AssertionError

    async with serve_control(path.parent, execute):
        answer = await answer_to(path, data)
    assert answer["exit_code"] == ExitCode.USAGE
    assert answer["sentence"]


async def test_too_many_clients_are_refused(path):
    free = asyncio.Event()

    async def execute(_):
        await free.wait()
        return "done"

    async with serve_control(path.parent, execute):
        order = b'{"order":"reload"}\n'
        clients = [asyncio.ensure_future(answer_to(path, order)) for _ in range(CLIENTS)]
        await asyncio.sleep(0)  # they connect first
        while (await answer_to(path, b"\n"))["exit_code"] != ExitCode.CHILD:
            pass  # until all of them are served
        free.set()
        assert {answer["exit_code"] for answer in await asyncio.gather(*clients)} == {0}


async def test_a_client_notices_that_the_master_ends(path):
    begun = asyncio.Event()

    async def execute(_):
        begun.set()
        await asyncio.Event().wait()

    async with serve_control(path.parent, execute):
        order = asyncio.ensure_future(give_order(path, ReloadOrder(), timeout=PATIENCE))
        await begun.wait()
    with pytest.raises(NotReloadedError):
        await order


@pytest.mark.parametrize(
    ("answer", "error"),
    [(b"what?", ControlError), (b" " * (ANSWER_LIMIT + 1), ControlError), (None, NotReloadedError)],
    ids=["nonsense", "endless", "silent"],
)
async def test_a_strange_master_is_refused(path, answer, error):
    writers = []

    async def serve(reader, writer):
        writers.append(writer)
        await reader.readline()
        if answer is not None:
            writer.write(answer)
            writer.close()

    server = await asyncio.start_unix_server(serve, path)
    with pytest.raises(error):
        await give_order(path, ReloadOrder(), timeout=0.3 if answer is None else PATIENCE)
    server.close()
    for writer in writers:
        writer.close()
