"""A small HTTP server for the state of a process: GET only, one request per connection, everything bounded."""

import asyncio
import contextlib
import errno
import socket
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Final
from urllib.parse import urlsplit

from pcie_shim.endpoint import Endpoint

REQUEST_LIMIT: Final = 1 << 13
"""Maximum size of a request in bytes."""
REQUEST_TIME: Final = 5.0
"""Seconds in which a client must send its request, and then as many to receive the answer."""
CLIENTS: Final = 8
"""Maximum number of concurrent connections; a new one replaces the oldest."""
PACE: Final = 0.02
"""Seconds between two accepted connections, and two reads after an answer: the kernel slows the client, not this
process the frames."""

_END: Final = b"\r\n\r\n"


@dataclass(frozen=True, slots=True)
class Response:
    """The answer to a request."""

    status: HTTPStatus
    body: bytes
    type: str = "text/plain; charset=utf-8"


Answer = Callable[[str], Awaitable[Response]]
"""Function that returns the response for a path."""


def refused(status: HTTPStatus) -> Response:
    """Return the response of a refusal."""
    return Response(status, f"{status.phrase}\n".encode())


def path_of(request: bytes, *, local_only: bool) -> str | Response:
    """Return the path of a request, or the response that refuses it.

    With `local_only`, the Host must be this machine. A web page that reaches the port under another name has
    made that name resolve to this machine (DNS rebinding).
    """
    try:
        first, *lines = request.decode("ascii").removesuffix("\r\n\r\n").split("\r\n")
        method, target, version = first.split(" ")
        headers = [line.split(":", 1) for line in lines]
        hosts, origins = (
            [value.strip() for key, value in headers if key.lower() == name] for name in ("host", "origin")
        )
    except ValueError:
        return refused(HTTPStatus.BAD_REQUEST)
    if not version.startswith("HTTP/1.") or not target.startswith("/"):
        return refused(HTTPStatus.BAD_REQUEST)
    if method != "GET":
        return refused(HTTPStatus.METHOD_NOT_ALLOWED)
    if local_only and (len(hosts) != 1 or not _is_local(f"//{hosts[0]}")):
        return refused(HTTPStatus.FORBIDDEN)
    if not all(_is_local(origin) for origin in origins):
        return refused(HTTPStatus.FORBIDDEN)
    return target.partition("?")[0]


def _is_local(url: str) -> bool:
    """Return whether a URL names this machine."""
    try:
        host = urlsplit(url).hostname
    except ValueError:
        return False
    return bool(host) and Endpoint(host=str(host)).is_loopback


async def serve_http(listener: socket.socket, answer: Answer, *, local_only: bool) -> None:
    """Answer requests until cancelled; see the limits above."""
    listener.setblocking(False)
    clients: dict[asyncio.Task[None], None] = {}
    try:
        while True:
            try:
                connection = await _accept(listener)
            except OSError as error:
                if error.errno == errno.EBADF:
                    return
                await asyncio.sleep(1)  # too many open files
                continue
            if len(clients) >= CLIENTS:
                next(iter(clients)).cancel()
            client = asyncio.ensure_future(_serve(connection, answer, local_only=local_only))
            clients[client] = None
            client.add_done_callback(clients.pop)
            await asyncio.sleep(PACE)
    finally:
        for client in clients:
            client.cancel()


async def _accept(listener: socket.socket) -> socket.socket:
    """Wait for a connection; asyncio's `sock_accept` fails in the loop if one arrives while it is cancelled."""
    loop, descriptor = asyncio.get_running_loop(), listener.fileno()
    while True:
        try:
            return listener.accept()[0]
        except BlockingIOError:
            readable = asyncio.Event()
            loop.add_reader(descriptor, readable.set)
            try:
                await readable.wait()
            finally:
                loop.remove_reader(descriptor)


async def _serve(connection: socket.socket, answer: Answer, *, local_only: bool) -> None:
    loop = asyncio.get_running_loop()
    connection.setblocking(False)
    with connection, contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(REQUEST_TIME):
            request = bytearray()
            while _END not in request and len(request) < REQUEST_LIMIT:
                part = await loop.sock_recv(connection, REQUEST_LIMIT)
                if not part:
                    return
                request += part
        head, found, _ = bytes(request).partition(_END)
        if not found:
            response = refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE)
        else:
            path = path_of(head + found, local_only=local_only)
            response = await answer(path) if isinstance(path, str) else path
        async with asyncio.timeout(REQUEST_TIME):
            await loop.sock_sendall(connection, _bytes_of(response))
            connection.shutdown(socket.SHUT_WR)
            # a socket that is closed with unread bytes discards the answer
            while await loop.sock_recv(connection, REQUEST_LIMIT):
                await asyncio.sleep(PACE)  # asyncio's loop does nothing else while bytes are there


def _bytes_of(response: Response) -> bytes:
    head = (
        f"HTTP/1.1 {response.status.value} {response.status.phrase}\r\nContent-Type: {response.type}\r\n"
        f"Content-Length: {len(response.body)}\r\nCache-Control: no-store\r\nConnection: close\r\n"
        "X-Content-Type-Options: nosniff\r\n\r\n"
    )
    return head.encode() + response.body
