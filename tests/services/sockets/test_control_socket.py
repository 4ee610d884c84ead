"""Orders to a master: one line in, one object out, and one sentence for whatever is no order."""

import asyncio
import json
import stat

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.errors import ControlError, NotReloadedError, ReportedError, ShapeError
from services.sockets import control_socket
from services.sockets.control_socket import (
    ANSWER_LIMIT,
    CALLERS,
    ReloadOrder,
    control_served,
    give_order,
    order_of,
)


@pytest.fixture
def directory(tmp_path_factory):
    return tmp_path_factory.mktemp("run")


async def said(directory, data):
    """What is answered to some bytes."""
    reader, writer = await asyncio.open_unix_connection(control_socket.control_socket(directory))
    writer.write(data)
    answer = await asyncio.wait_for(reader.read(), 120)
    writer.close()
    return json.loads(answer)


@given(st.text(max_size=60))
def test_a_folder_is_an_order(folder):
    assert order_of(json.dumps({"order": "reload", "folder": folder}).encode()).folder == folder


@given(st.binary(max_size=200))
def test_any_bytes_are_an_order_or_refused(data):
    try:
        order_of(data)
    except ControlError as error:
        assert str(error).startswith("that is no order")


async def test_an_order_is_obeyed_and_answered(directory):
    heard = []

    async def obey(order):
        heard.append(order.folder)
        return "done so"

    async with control_served(directory, obey):
        path = control_socket.control_socket(directory)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert await give_order(path, ReloadOrder("/a"), timeout=120) == "done so"
        assert await give_order(path, ReloadOrder(), timeout=120) == "done so"
    assert heard == ["/a", ""]
    assert not path.exists()
    with pytest.raises(ControlError, match="no master takes orders at .*is a master --loop running"):
        await give_order(path, ReloadOrder(), timeout=120)


async def test_a_refusal_keeps_its_sentence_and_code(directory):
    async def obey(_):
        msg = "another shape"
        raise ShapeError(msg)

    async with control_served(directory, obey):
        with pytest.raises(ReportedError, match="^another shape$") as refused:
            await give_order(control_socket.control_socket(directory), ReloadOrder(), timeout=120)
    assert refused.value.exit_code == 2


async def test_what_is_no_order_gets_a_sentence(directory, monkeypatch):
    monkeypatch.setattr(control_socket, "ORDER_TIME", 0.2)

    async def obey(_):
        raise AssertionError

    async with control_served(directory, obey):
        for data, sentence in (
            (b"\n", "that is no order"),
            (b'{"order":"dance"}\n', "that is no order"),
            (b'{"order":"reload","folder":"/a","more":1}\n', "that is no order"),
            (b"[" * 9000 + b"\n", "that is no order"),
            (b"x" * 40_000, "an order has 16384 bytes at most"),
            (b'{"order"', "no order came within 0.2 s"),
        ):
            answer = await said(directory, data)
            assert answer["exit_code"] == 2
            assert answer["sentence"].startswith(sentence)


async def test_too_many_callers_are_turned_away(directory):
    free = asyncio.Event()

    async def obey(_):
        await free.wait()
        return "done"

    async with control_served(directory, obey):
        order = b'{"order":"reload"}\n'
        calling = [asyncio.ensure_future(said(directory, order)) for _ in range(CALLERS)]
        while True:  # until all of them are inside
            answer = asyncio.ensure_future(said(directory, b"\n"))
            if "others give orders already" in (await answer)["sentence"]:
                break
        free.set()
        assert {answer["exit_code"] for answer in await asyncio.gather(*calling)} == {0}


async def test_an_end_in_the_middle_is_told(directory):
    begun = asyncio.Event()

    async def obey(_):
        begun.set()
        await asyncio.Event().wait()

    async with control_served(directory, obey):
        ordering = asyncio.ensure_future(
            give_order(control_socket.control_socket(directory), ReloadOrder(), timeout=120)
        )
        await begun.wait()
    with pytest.raises(NotReloadedError, match="ended before it was done"):
        await ordering


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (b"what?", "is no master of rosbayes"),
        (b" " * (ANSWER_LIMIT + 1), "says more than 1048576 bytes"),
        (None, "did not answer within 0.3 s"),
    ],
)
async def test_a_strange_master(directory, answer, error):
    async def serve(reader, writer):
        await reader.readline()
        if answer is not None:
            writer.write(answer)
            writer.close()

    path = control_socket.control_socket(directory)
    server = await asyncio.start_unix_server(serve, path)
    timeout = 0.3 if answer is None else 20
    with pytest.raises((ControlError, NotReloadedError), match=error):
        await give_order(path, ReloadOrder(), timeout=timeout)
    server.close()
