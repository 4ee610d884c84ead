"""One WebSocket connection of the client, with clear errors and detection of silent servers.

Messages go directly from the socket's callback to `on_messages`, without a queue or a task in between.

If no data comes from the server for `ping_interval + ping_timeout` seconds, the connection is closed. All data
counts as a sign of life, not only pongs.
"""

import asyncio
import logging
import re
import socket
import ssl
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from enum import Enum, auto
from http import HTTPStatus
from typing import Final

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidHandshake, InvalidMessage, InvalidStatus, InvalidURI, PayloadTooBig
from websockets.frames import CloseCode
from websockets.http11 import USER_AGENT, Request, Response
from websockets.uri import WebSocketURI, parse_uri

from bridge.client.route import Route, connect_along, reason_of, shown
from bridge.codecs.json_codec import excerpt
from bridge.errors import (
    AccessRefusedError,
    BridgeError,
    NotRosbridgeError,
    OptionError,
    UnreachableError,
    UriError,
)
from bridge.transport.frames import is_impossible
from bridge.transport.websocket import MESSAGE_BYTES_HEADER, WebSocketTransport

WRITE_LIMIT: Final = 1 << 16
"""Number of unsent bytes above which publishers must wait."""
CLOSE_TIMEOUT: Final = 1.0
"""Timeout in seconds of the closing handshake."""
_OVERSLEPT: Final = 0.5
"""If the watchdog wakes this many seconds late, this process was suspended, and the server was not silent."""
_SIZE: Final = re.compile("[1-9][0-9]{2,17}")
"""Form of a size limit that a server announces: 100 bytes or more, because no operation fits into less."""


class _NoDebug(logging.LoggerAdapter[logging.Logger]):
    """Logger for the library without debug lines, which would contain all headers, including tokens."""

    def isEnabledFor(self, level: int) -> bool:
        """Return whether to log at a level."""
        return level > logging.DEBUG and super().isEnabledFor(level)


_log = _NoDebug(logging.getLogger("bridge.client.websocket"), {})


def check_uri(uri: str) -> WebSocketURI:
    """Read the URI of a rosbridge server, or raise a UriError.

    The form is `ws://host:port` or `wss://host:port`. The URI may also contain a path and credentials.
    """
    try:
        parsed = parse_uri(uri)
        parsed.host.encode("idna")
    except (InvalidURI, ValueError) as error:  # ValueError: a bad port, half a bracket, odd letters
        reason = error.msg if isinstance(error, InvalidURI) else str(error)
        raise UriError(
            f"{shown(uri)!r} is not a rosbridge URI ({reason}): expected, for example, ws://192.168.1.10:9090"
        ) from None
    return parsed


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of a connection (see `bridge.client.connect`): times in seconds, and `max_size` in bytes."""

    connect_timeout: float
    max_size: int
    ping_interval: float
    ping_timeout: float

    def __post_init__(self) -> None:
        for limit in fields(self):
            value = getattr(self, limit.name)
            if not value > 0:
                raise OptionError(f"{limit.name} must be more than 0, not {value!r}")


class Loss(Enum):
    """Cause of the end of a connection. Only causes that affect the next connection are distinguished."""

    RECEIVED_TOO_LARGE = auto()
    """The server sent a message above `max_size`."""
    SENT_TOO_LARGE = auto()
    """This client sent a message that is larger than the server permits."""
    OTHER = auto()


class WebSocket(WebSocketTransport):
    """A WebSocket client connection with callbacks for messages and for its end.

        connect_along -> handshake() -> begin() -> messages ... -> close(), or the end by the server or the network

    Before `begin`, no callback is called. If the connection ends during the handshake, `handshake` raises the error.
    """

    def __init__(
        self,
        uri: WebSocketURI,
        limits: Limits,
        on_messages: Callable[[list[bytes]], None],
        on_lost: Callable[["WebSocket", str], None],
    ) -> None:
        protocol = ClientProtocol(uri, max_size=limits.max_size, logger=_log)
        super().__init__(protocol, max_size=limits.max_size, write_limit=WRITE_LIMIT)
        self._client_protocol = protocol
        self._limits = limits

        # The handshake: the event is set by the server's answer, or by the end of the connection without one.
        self._answered = asyncio.Event()
        # Maximum size of a message in bytes that the server announced in its handshake, or None.
        self.largest_accepted: int | None = None
        # Messages that came together with the answer, until `begin` passes them on.
        self._early: list[bytes] = []
        # Set by `begin`; from then on everything goes to the callbacks, and `on_lost` is called exactly once.
        self.opened = False
        self._on_messages = on_messages
        self._on_lost = on_lost

        # The watchdog runs from `begin` to the end. After a silence it pings once; any data counts as an answer. If
        # there is none, it sets `_silent_for` and ends the connection.
        self._watchdog: asyncio.TimerHandle | None = None
        self._pinged_at: float | None = None
        self._silent_for = 0.0

    async def handshake(self, headers: tuple[tuple[str, str], ...]) -> None:
        """Perform the opening handshake, or raise the error that ended it."""
        request = self._client_protocol.connect()
        request.headers.update(headers)
        request.headers.setdefault("User-Agent", USER_AGENT)
        self._client_protocol.send_request(request)
        self._flush()
        await self._answered.wait()
        if (error := self.handshake_error) is not None:
            raise error

    @property
    def handshake_error(self) -> Exception | None:
        """The error that ended the handshake, or None."""
        return self._client_protocol.handshake_exc

    def begin(self) -> None:
        """Start the callbacks, after the handshake."""
        self.opened = True
        self.last_heard = time.monotonic()
        self._schedule(self._limits.ping_interval)
        early, self._early = self._early, []
        if early:  # they arrived together with the handshake
            self._on_messages(early)

    async def close(self) -> None:
        """Close the connection after sending everything written so far."""
        if self.is_open:
            self.start_closing(CloseCode.NORMAL_CLOSURE)
        # Otherwise the last messages of a program would be lost in the write buffer.
        await self.drain()
        with suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await self.wait_closed()
        self.abort()

    # Calls of the transport

    def handshake_received(self, event: Request | Response) -> None:
        """Wake `handshake`."""
        announced = event.headers.get(MESSAGE_BYTES_HEADER, "")
        if _SIZE.fullmatch(announced):
            self.largest_accepted = int(announced)
        self._answered.set()

    def messages_received(self, messages: list[bytes]) -> None:
        """Pass the messages to `on_messages`. Keep messages that arrive before `begin`; `begin` passes them on."""
        if self.opened:
            self._on_messages(messages)
        else:
            self._early += messages

    def close_expected(self) -> None:
        """Abort the connection after `CLOSE_TIMEOUT` unless the server closes it. Abort a handshake at once."""
        if self.opened:
            self._schedule(CLOSE_TIMEOUT)
        else:
            self.abort()  # a peer with another protocol may never close the connection

    def connection_ended(self, exc: Exception | None) -> None:
        """Wake `handshake` if it still waits. Call `on_lost` if `begin` has been called."""
        self._answered.set()
        self._cancel_watchdog()
        if self.opened:
            self._on_lost(self, self._why_lost(exc))

    @property
    def loss(self) -> Loss:
        """Cause of the end of the connection."""
        closed = self._protocol.close_exc
        # An impossible length is a malformed frame, and not a large message.
        if isinstance(closed.__cause__, PayloadTooBig) and not is_impossible(self.refused):
            return Loss.RECEIVED_TOO_LARGE
        if closed.rcvd is not None and closed.rcvd.code == CloseCode.MESSAGE_TOO_BIG:
            return Loss.SENT_TOO_LARGE
        return Loss.OTHER

    def _why_lost(self, exc: Exception | None) -> str:
        # First the reasons for which this client ended it, because the others follow from them.
        if self._silent_for:
            return f"no data came from the server for {self._silent_for:.3g} s"
        if self.never_reads:
            return "the server causes answers and does not read them"
        closed, loss = self._protocol.close_exc, self.loss
        if loss is Loss.RECEIVED_TOO_LARGE:
            return (
                f"the server sent a message of more than {self._max_size} bytes (max_size allows larger ones)"
            )
        if loss is Loss.SENT_TOO_LARGE:
            return "the server closed it: a message was too large for it (code 1009)"
        if closed.rcvd is not None:
            return f"the server closed it (code {closed.rcvd.code})"
        if closed.sent is not None:
            return f"the server violated the WebSocket protocol ({closed.sent.reason})"
        return reason_of(exc) if isinstance(exc, OSError) else "the connection broke off"

    # Watching for silence

    def _cancel_watchdog(self) -> None:
        if self._watchdog is not None:
            self._watchdog.cancel()

    def _schedule(self, seconds: float) -> None:
        self._cancel_watchdog()
        due = time.monotonic() + seconds
        self._watchdog = asyncio.get_running_loop().call_later(seconds, self._check_liveness, due)

    def _check_liveness(self, due: float) -> None:
        # Not a timer that every message resets, which would take longer than reading the message.
        now = time.monotonic()
        silent = now - self.last_heard
        if not self.is_open:
            self.abort()
        elif silent < self._limits.ping_interval:
            self._schedule(self._limits.ping_interval - silent)
        elif self._pinged_at is None or self._pinged_at <= self.last_heard or now - due > _OVERSLEPT:
            self._pinged_at = now
            self.ping()
            self._schedule(self._limits.ping_timeout)
        else:
            self._silent_for = silent
            self.abort()


async def open_websocket(
    uri: WebSocketURI,
    shown_uri: str,
    *,
    route: Route,
    timeout: float,
    limits: Limits,
    on_messages: Callable[[list[bytes]], None],
    on_lost: Callable[[WebSocket, str], None],
) -> WebSocket:
    """Open a connection without compression. On a local network, compression costs more than it saves.

    `shown_uri` is the URI without secrets, for errors. `on_messages` is called with a list of messages that arrived
    together. `on_lost` is called once, with the reason of the end.

    Raises:
        UnreachableError: No server answers, it accepts no more clients, or its certificate is not trusted.
        NotRosbridgeError: A server answers, but not as a WebSocket server.
        AccessRefusedError: The token or client certificate is missing or wrong.
    """
    attempt: WebSocket | None = None

    def factory() -> WebSocket:
        nonlocal attempt
        attempt = WebSocket(uri, limits, on_messages, on_lost)
        return attempt

    try:
        async with asyncio.timeout(timeout):
            websocket = await connect_along(route, uri, factory)
            await websocket.handshake(route.headers)
    except BaseException as error:
        answered, heard = False, b""
        if attempt is not None:
            attempt.abort()
            answered, heard = attempt.is_connected, attempt.first_bytes
            if isinstance(error, Exception) and attempt.handshake_error is not None:
                # The first bytes say more than the error: a service that sends a greeting interrupts the
                # request.
                error = attempt.handshake_error
        if isinstance(error, BridgeError) or not isinstance(error, OSError | InvalidHandshake):
            raise
        raise _connect_error(error, shown_uri, heard, timeout, answered=answered) from error
    # It may have ended since the handshake, without a callback.
    if not websocket.is_open:
        raise UnreachableError(f"{shown_uri} is unreachable: it closed the connection at once")
    websocket.begin()
    return websocket


def _connect_error(
    error: Exception, uri: str, heard: bytes, seconds: float, *, answered: bool
) -> UnreachableError | NotRosbridgeError | AccessRefusedError:
    """Return the error for a connection that could not be opened."""
    # From the most specific to the least: an answer in HTTP, other bytes, TLS, the network.
    if isinstance(error, InvalidStatus):
        response = error.response
        seen = f"HTTP {response.status_code} {response.reason_phrase[:80]}".rstrip()
        if response.status_code in {HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN}:
            return AccessRefusedError(f"{uri} refuses this client ({seen}): check token and headers")
        if response.status_code == HTTPStatus.SERVICE_UNAVAILABLE:
            return UnreachableError(f"{uri} accepts no more clients now ({seen})")
        to = response.headers.get("Location")
        seen += f", to {to[:200]}" if to else ""
        return NotRosbridgeError(
            f"{uri} is not a rosbridge server: it answers like a web server ({seen}); check port and path"
        )
    if isinstance(error, InvalidMessage) and not heard:
        is_tls = uri.startswith("wss:")
        perhaps = (
            " (some servers do so without a client certificate)" if is_tls else "; does it expect wss://?"
        )
        return UnreachableError(f"{uri} is unreachable: it closed the connection without an answer{perhaps}")
    if isinstance(error, InvalidHandshake) or (isinstance(error, TimeoutError) and heard):
        why = f"within {seconds:g} s " if isinstance(error, TimeoutError) else ""
        return NotRosbridgeError(
            f"{uri} is not a rosbridge server: it did not answer {why}as a WebSocket server but with {excerpt(heard)}"
        )
    if isinstance(error, ssl.SSLCertVerificationError):
        return UnreachableError(f"{uri} cannot be trusted; certificate error: {error.verify_message}")
    if isinstance(error, ssl.SSLError) and "ALERT" in (error.reason or ""):
        return AccessRefusedError(
            f"{uri} refuses this client ({error.reason}): check the client certificate in tls"
        )
    if isinstance(error, ssl.SSLError):
        return NotRosbridgeError(
            f"{uri} does not speak TLS ({error.reason}): is it ws:// rather than wss://?"
        )
    if isinstance(error, TimeoutError) and error.errno is None:  # the kernel's error has a number
        done = "it accepted the connection but did not answer" if answered else "it did not answer"
        return UnreachableError(f"{uri} is unreachable: {done} within {seconds:g} s")
    if isinstance(error, socket.gaierror):
        return UnreachableError(f"{uri} is unreachable: its host name is unknown ({reason_of(error)})")
    return UnreachableError(
        f"{uri} is unreachable: {reason_of(error)}; is the rosbridge server running, and is the port right?"
    )
