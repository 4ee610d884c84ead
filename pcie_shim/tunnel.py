"""TLS for links over TCP: a tunnel between the network socket and a local socket pair.

One thread with an event loop forwards the bytes of all tunnels of a process. Links without TLS do not use it.
"""

import asyncio
import functools
import socket
import ssl
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from contextlib import suppress
from typing import Final

HANDSHAKE_S: Final = 10.0
"""Seconds that a TLS handshake may take."""
_PIECE: Final = 64 * 1024
_carrying: set[asyncio.Task[None] | None] = set()
"""The tunnels' tasks: an event loop alone does not keep its tasks alive."""


def tunnel_to_board(
    connection: socket.socket, context: ssl.SSLContext, host: str, timeout: float
) -> socket.socket:
    """Begin TLS as a host, and return the socket to use instead of the connection.

    Raises:
        ssl.SSLError: The handshake failed, or the board's certificate is not trusted.
        OSError: The connection ended.
        TimeoutError: The handshake took longer than `timeout` seconds.
    """
    ours, theirs = socket.socketpair()
    opened: Future[None] = Future()
    _run(_carry(connection, theirs, context, opened, host=host, handshake_s=timeout))
    try:
        opened.result(timeout + 1)
    except BaseException:
        ours.close()
        raise
    return ours


def tunnel_to_host(connection: socket.socket, context: ssl.SSLContext) -> socket.socket:
    """Begin TLS as a board, and return the socket to use instead of the connection; it ends if the handshake fails."""
    ours, theirs = socket.socketpair()
    _run(_carry(connection, theirs, context, Future(), host=None, handshake_s=HANDSHAKE_S))
    return ours


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="TLS", daemon=True).start()
    return loop


def _run(carrying: Coroutine[None, None, None]) -> None:
    asyncio.run_coroutine_threadsafe(carrying, _loop())


async def _carry(
    connection: socket.socket,
    plain: socket.socket,
    context: ssl.SSLContext,
    opened: Future[None],
    *,
    host: str | None,
    handshake_s: float,
) -> None:
    """Carry bytes both ways until one side ends; then end the other."""
    writers: list[asyncio.StreamWriter] = []
    task = asyncio.current_task()
    _carrying.add(task)
    try:
        connection.setblocking(False)
        plain.setblocking(False)
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=_PIECE)
        protocol = asyncio.StreamReaderProtocol(reader)
        if host is None:
            transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, connection, ssl=context, ssl_handshake_timeout=handshake_s
            )
        else:
            transport, _ = await loop.create_connection(
                lambda: protocol,
                sock=connection,
                ssl=context,
                server_hostname=host,
                ssl_handshake_timeout=handshake_s,
            )
        writers.append(asyncio.StreamWriter(transport, protocol, reader, loop))
        plain_reader, plain_writer = await asyncio.open_unix_connection(sock=plain, limit=_PIECE)
        writers.append(plain_writer)
        opened.set_result(None)
        ways = [
            asyncio.ensure_future(_copy(reader, plain_writer)),
            asyncio.ensure_future(_copy(plain_reader, writers[0])),
        ]
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in ways:
            way.cancel()
    except Exception as error:  # the thread that waits raises it
        if not opened.done():
            opened.set_exception(error)
    finally:
        for writer in writers:
            writer.close()  # after what it still has to write
        if len(writers) < 2:
            plain.close()
        if not writers:
            connection.close()
        _carrying.discard(task)


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while piece := await source.read(_PIECE):
            target.write(piece)
            await target.drain()
