"""Endpoints of boards and services (`unix:/path` or `tcp://host:port`), and functions that open their sockets."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from pcie_shim.errors import EndpointError, LinkTimeoutError, LinkUnreachableError

UNIX_PATH_BYTES: Final = 107
"""Maximum length in bytes of the path of a Unix socket on Linux."""

_RETRY_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A board's address: a unix socket's path, or a TCP host and port.

    Attributes:
        path: Path of the unix socket, or empty for TCP.
        host: Name or address of the TCP host, or empty for a unix socket.
        port: TCP port, or 0 for a unix socket.
        key: Key of a link over TCP, or empty for none. A unix socket is private and needs no key.
    """

    path: str = ""
    host: str = ""
    port: int = 0
    key: bytes = field(default=b"", repr=False, compare=False)

    def __str__(self) -> str:
        if self.path:
            return f"unix:{self.path}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """True if only programs on this machine can reach the endpoint."""
        if not self.host or self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def programming(self) -> Endpoint:
        """The endpoint for programming a board: `board0.program.sock` for `board0.sock`, or the next TCP port."""
        if self.path:
            path = Path(self.path)
            return Endpoint(path=str(path.with_name(f"{path.stem}.program{path.suffix}")))
        return replace(self, port=self.port + 1)


def parse_endpoint(text: str) -> Endpoint:
    """Parse `unix:/path` or `tcp://host:port`. Raises an EndpointError if the text is not an endpoint."""
    if text.startswith("unix:"):
        endpoint = Endpoint(path=text.removeprefix("unix:"))
        if not endpoint.path.startswith("/"):
            raise EndpointError(f"The endpoint '{text}' has a relative path: unix: needs an absolute one")
        longest = len(os.fsencode(endpoint.programming.path))
        if longest > UNIX_PATH_BYTES:
            raise EndpointError(
                f"The path in '{text}' is too long: with '.program' it has {longest} bytes, a unix socket's "
                f"path takes {UNIX_PATH_BYTES}; use a shorter folder"
            )
        return endpoint
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
        (host or "").encode("idna")  # like the resolver, which would fail with a UnicodeError (a ValueError)
    except ValueError:
        host, port = None, None
    if text.startswith("tls://"):
        raise EndpointError(
            f"The endpoint '{text}' asks for TLS, which links to boards do not have: use tcp:// with a key, through ssh or "
            "WireGuard (docs/how-to/hosts.md)"
        )
    if text.startswith("tcp://") and host and port and port < 65535 and text.count("/") == 2:
        return Endpoint(host=host, port=port)
    raise EndpointError(
        f"The endpoint '{text}' is not understood: use unix:/path/board0.sock or tcp://host:port, with a "
        "port from 1 to 65534 (the next one is for programming)"
    )


def listen(endpoint: Endpoint) -> socket.socket:
    """Return a listening socket. Raises an EndpointError if the endpoint cannot be used.

    A unix socket has mode 0600. It replaces the socket file of a process that has ended.
    """
    try:
        if not endpoint.path:
            family = socket.AF_INET6 if ":" in endpoint.host else socket.AF_INET
            return socket.create_server((endpoint.host, endpoint.port), family=family)
        return _listen_privately(endpoint.path)
    except OSError as error:
        reasons = {
            errno.EADDRINUSE: "another process listens there",
            errno.ENOENT: f"the folder {Path(endpoint.path).parent} does not exist; create it",
        }
        reason = reasons.get(error.errno or 0, error.strerror or str(error))
        raise EndpointError(f"Nothing can be served at {endpoint}: {reason}") from error


def _listen_privately(path: str) -> socket.socket:
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # Linux creates the file with the mode of the socket, so another user can never connect
        os.fchmod(server.fileno(), 0o600)
        try:
            server.bind(path)
        except OSError as error:
            if error.errno != errno.EADDRINUSE or is_served(path):
                raise
            # a killed process has left its file behind
            Path(path).unlink()
            server.bind(path)
        server.listen()
    except BaseException:
        server.close()
        raise
    return server


def is_served(path: str) -> bool:
    """Return whether a process listens at the path of a unix socket. The process need not answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except (BlockingIOError, PermissionError):
            pass  # the backlog is full, for which a blocking connect would wait, or it is another user's
        except OSError:
            return False
        return True


def connect(endpoint: Endpoint, *, timeout: float) -> socket.socket:
    """Connect to a board. If the board does not listen yet, try again for `timeout` seconds.

    Raises:
        LinkUnreachableError: No board listens at the endpoint.
        LinkTimeoutError: The host of a TCP endpoint does not answer.
    """
    deadline = time.monotonic() + timeout
    # a board that was started together with this host may not listen yet
    while True:
        try:
            return _connect_once(endpoint, max(deadline - time.monotonic(), _RETRY_S))
        except TimeoutError:
            raise LinkTimeoutError(f"{endpoint} did not take a connection within {timeout:g} s") from None
        except OSError as error:
            if time.monotonic() + _RETRY_S >= deadline:
                reason = error.strerror or str(error)
                raise LinkUnreachableError(
                    f"No board listens at {endpoint} ({reason}, for {timeout:g} s): is it started?"
                ) from error
        time.sleep(_RETRY_S)


def _connect_once(endpoint: Endpoint, timeout: float) -> socket.socket:
    if not endpoint.path:
        # a timeout for connecting alone: the link limits its calls in the kernel
        tcp = socket.create_connection((endpoint.host, endpoint.port), timeout=timeout)
        no_delay(tcp)
        tcp.settimeout(None)
        return tcp
    unix = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        unix.settimeout(timeout)
        unix.connect(endpoint.path)
    except OSError:
        unix.close()
        raise
    unix.settimeout(None)
    return unix


def no_delay(connection: socket.socket) -> None:
    """Disable Nagle's algorithm on TCP, so that small frames are sent at once."""
    if connection.family != socket.AF_UNIX:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def remove_listener(endpoint: Endpoint, server: socket.socket) -> None:
    """Close a listening socket. If it is a unix socket, also remove its file."""
    server.close()
    if endpoint.path:
        with suppress(OSError):
            Path(endpoint.path).unlink()
