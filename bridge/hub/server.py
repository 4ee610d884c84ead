"""The hub's socket: a thin layer of WebSockets around the broker.

    asyncio ─▶ _Connection.messages_received ─▶ Broker.receive_turn ─▶ outboxes of clients
                              └─▶ _Hub.serve ─▶ Broker.take_ready ─▶ _Connection.flush of each ─▶ asyncio
    timers ──▶ _Hub._wake ─▶ Broker.wake ─▶ outboxes;   _Hub.sweep ─▶ silent and stuck connections

Connections do not have tasks. One callback of the event loop reads the messages, passes them through the broker,
and writes them to all subscribers, with one write per subscriber. Data is not compressed, because compression on
loopback costs more time than it saves.

If a client's socket accepts no more bytes, messages wait in the outbox of this client. A full outbox drops its oldest
message. Other clients are not delayed.
"""

import asyncio
import contextlib
import logging
import os
import socket
import time
from collections.abc import Callable
from http import HTTPStatus
from math import inf
from typing import Final, cast

from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.server import ServerProtocol

from bridge.hub.access import SUBPROTOCOL, AccessPolicy, is_loopback
from bridge.hub.broker import Broker
from bridge.hub.graph import Client, Graph
from bridge.hub.limits import HubError, HubLimits
from bridge.hub.outbox import Outbox
from bridge.names import RosVersion
from bridge.transport.websocket import MESSAGE_BYTES_HEADER, WebSocketTransport

log = logging.getLogger(__name__)

# Bytes that wait in the process for one socket before its client's outbox is used.
_WRITE_BUFFER: Final = 64 * 1024
# Bytes that wait in the kernel for one socket; with more, data would only arrive later.
_SEND_BUFFER: Final = 256 * 1024
# One client's share of a turn: what is read from it (see `WebSocketTransport`), and the queued messages or fragments
# that are written to it. A read has at most a quarter of a mebibyte, which is handled at once.
_TURN_FRAMES: Final = 128
_TURN_BYTES: Final = 64 * 1024
_SLICE_BYTES: Final = 4 * 1024
_TURN_MESSAGES: Final = 32
# Bytes of a block that the hub frees once, so that glibc retains up to twice as many bytes of freed memory. Otherwise
# it returns them after each burst and gets them again page by page: a quarter of the hub's time with messages of 17 kB.
_RETAINED: Final = 4 * 1024 * 1024
# In seconds, for `_Hub.stay_awake`: how long the hub polls its sockets after a prompt response; how soon after polling
# in vain a response shows that its client had to wait for that; and how long the hub then does not poll, at first and
# at most.
_AWAKE: Final = 200e-6
_AT_ONCE: Final = 60e-6
_PAUSES: Final = (1e-3, 0.1)
# Seconds between two checks for silent and stuck clients.
_SWEEP: Final = 1.0
# Seconds that a client has to end a connection which the hub closed.
_CLOSE_TIMEOUT: Final = 2.0
# Maximum number of connections in a handshake; the oldest is aborted to admit another.
_HANDSHAKES: Final = 64
# At most so many lines about refused and closed connections in so many seconds: anybody can cause them.
_LOG_LINES: Final = 10
_LOG_PERIOD: Final = 10.0
_LAST_PORT: Final = 65535
_FOR_BROWSERS: Final = """\
This port is a rosbridge server (hub) for WebSocket clients, such as robots and roslibpy. It has no page.
Where the command `dashboard` runs, the page is at http://127.0.0.1:8080
"""


async def serve_hub(
    host: str,
    port: int,
    *,
    limits: HubLimits | None = None,
    access: AccessPolicy | None = None,
    ros_version: RosVersion = 1,
    on_ready: Callable[[int], None] | None = None,
    on_graph: Callable[[Graph], None] | None = None,
    stop: asyncio.Event,
) -> None:
    """Serve rosbridge until `stop` is set, then close every connection with code 1001 and return.

    Args:
        host: the address to listen on. Without tokens and TLS, everybody who can reach this address may publish
            to your robot.
        port: the port to listen on, or 0 for any free port.
        limits: bounds on clients and messages.
        access: access control and TLS. By default, every program and the web pages of this machine may connect.
        ros_version: the ROS version that the hub emulates.
        on_ready: called with the port once clients can connect.
        on_graph: called before `on_ready` with the graph of clients and topics. The function may read the graph,
            but not change it.
        stop: event that ends the hub.

    Raises:
        HubError: the address cannot be served.
    """
    if not 0 <= port <= _LAST_PORT:
        raise HubError(
            f"the hub cannot listen on {host} port {port}: a port is a number from 0 to {_LAST_PORT}"
        )
    access = access or AccessPolicy()
    hub = _Hub(limits or HubLimits(), access, ros_version, loopback=is_loopback(host))
    hub.broker.definitions.load()
    bytes(_RETAINED)  # freed at once
    loop = asyncio.get_running_loop()
    try:
        server = await loop.create_server(
            lambda: _Connection(hub),
            host,
            port,
            ssl=access.tls,
            ssl_handshake_timeout=hub.limits.handshake_timeout if access.tls else None,
        )
    except socket.gaierror as error:
        raise HubError(
            f"the hub cannot listen on {host}: that is not an address or name of this machine ({error.strerror}); "
            "give one, for example 127.0.0.1, or 0.0.0.0 for all of them"
        ) from None
    except OSError as error:
        raise HubError(
            f"the hub cannot listen on {host} port {port} ({os.strerror(error.errno) if error.errno else error}): "
            "end the process that listens there, or choose another host or port"
        ) from None
    try:
        hub.sweep()
        if on_graph is not None:
            on_graph(hub.broker.graph)
        if on_ready is not None:
            on_ready(server.sockets[0].getsockname()[1])
        await stop.wait()
    finally:
        server.close()
        await hub.close()


class _Hub:
    """The broker, its connections and its timers."""

    def __init__(
        self, limits: HubLimits, access: AccessPolicy, ros_version: RosVersion, *, loopback: bool
    ) -> None:
        self.limits = limits
        self.loopback = loopback
        self.access = access
        self.broker = Broker(limits, ros_version=ros_version)
        # All sockets, from `begin` to `forget`; `_nobody_left` is set when the last one is gone.
        self.connections: set[_Connection] = set()
        self._nobody_left = asyncio.Event()
        # Those in the opening or closing handshake, the oldest first. They have no client, so the limit of clients
        # does not bound them.
        self.handshakes: dict[_Connection, None] = {}
        # Those that the broker knows, from `admit` to `dismiss`.
        self._by_client: dict[Client, _Connection] = {}
        # The call of `Broker.wake` at the broker's deadline; no timer stands for infinity.
        self._timer: asyncio.TimerHandle | None = None
        self._timer_deadline = inf
        # The next `sweep`, and when the last one was: a hub that was late must not blame its clients.
        self._sweeper: asyncio.TimerHandle | None = None
        self._swept = time.monotonic()
        # Monotonic seconds: until when a response is prompt, from when on sockets may be polled for it, and when
        # polling was last in vain.
        self._prompt_until = self._poll_from = self._in_vain = -inf
        # Seconds without polling, the next time that polling was in vain; and True while `_poll` is scheduled.
        self._pause = _PAUSES[0]
        self._is_polling = False
        # Lines about connections since `_log_since` (see `warn`).
        self._log_lines = 0
        self._log_since = -inf

    def admit(self, connection: "_Connection", address: str) -> Client:
        client = self.broker.connect(address)
        self.handshakes.pop(connection, None)
        self._by_client[client] = connection
        return client

    def dismiss(self, client: Client) -> None:
        del self._by_client[client]
        self.broker.disconnect(client)
        self.serve()

    def begin(self, connection: "_Connection") -> None:
        self.connections.add(connection)
        self.handshakes[connection] = None
        if len(self.handshakes) > _HANDSHAKES:
            oldest = next(iter(self.handshakes))
            del self.handshakes[oldest]
            oldest.abort()

    def forget(self, connection: "_Connection") -> None:
        self.connections.discard(connection)
        self.handshakes.pop(connection, None)
        if not self.connections:
            self._nobody_left.set()

    def warn(self, message: str, *args: object) -> None:
        """Log a line about a connection, unless many were logged recently."""
        now = time.monotonic()
        if now > self._log_since + _LOG_PERIOD:
            if self._log_lines > _LOG_LINES:
                log.warning("%d more lines about connections were suppressed", self._log_lines - _LOG_LINES)
            self._log_lines, self._log_since = 0, now
        self._log_lines += 1
        if self._log_lines <= _LOG_LINES:
            log.warning(message, *args)

    def sweep(self) -> None:
        """Check for silent and stuck clients, periodically."""
        now = time.monotonic()
        # After a delay of the hub itself, the clients' answers may be waiting to be read.
        if now < self._swept + 3 * _SWEEP:
            for connection in list(self.connections):
                connection.sweep(now)
        self._swept = now
        self._sweeper = asyncio.get_running_loop().call_later(_SWEEP, self.sweep)

    async def close(self) -> None:
        """End all connections, with a closing handshake if the client takes part in it."""
        if self._sweeper is not None:
            self._sweeper.cancel()
        for connection in list(self.connections):
            connection.close(CloseCode.GOING_AWAY, "the hub ends")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CLOSE_TIMEOUT):
                while self.connections:
                    self._nobody_left.clear()
                    await self._nobody_left.wait()
        for connection in list(self.connections):
            connection.abort()
        if self._timer is not None:
            self._timer.cancel()

    def serve(self) -> None:
        """Write the output that waits for clients, and schedule the broker's next deadline."""
        for client in self.broker.take_ready():
            connection = self._by_client.get(client)
            if connection is not None:
                connection.flush()
        deadline = self.broker.deadline
        if deadline != self._timer_deadline:
            self._set_timer(deadline)

    def stay_awake(self, now: float) -> None:
        """Poll the sockets for a moment after a client's response at `now`, if responses are prompt.

        Without polling, the hub sleeps while a message is on its way, and waking up takes longer than the hub's other
        work. If a client only publishes, the hub does not poll, because the client may need the processor core.
        """
        is_prompt, self._prompt_until = now < self._prompt_until, now + _AWAKE
        if self._is_polling:
            self._pause = _PAUSES[0]
        elif (
            now < self._in_vain + _AT_ONCE
        ):  # a client on the same core had to wait for the end of the polling
            self._in_vain, self._poll_from = -inf, now + self._pause
            self._pause = min(2 * self._pause, _PAUSES[1])
        elif is_prompt and now >= self._poll_from:
            self._poll()

    def _poll(self) -> None:
        now = time.monotonic()
        self._is_polling = now < self._prompt_until
        if self._is_polling:
            asyncio.get_running_loop().call_soon(self._poll)  # with a call to make, the loop does not sleep
        else:
            self._in_vain = now

    def _set_timer(self, deadline: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._timer_deadline = None, deadline
        if deadline != inf:
            delay = max(deadline - time.monotonic(), 0)
            self._timer = asyncio.get_running_loop().call_later(delay, self._wake)

    def _wake(self) -> None:
        self._timer, self._timer_deadline = None, inf
        self.broker.wake(time.monotonic())
        self.serve()


class _Connection(WebSocketTransport):
    """One client's WebSocket: it receives and sends messages, and has deadlines for both."""

    turn_frames = _TURN_FRAMES
    turn_bytes = _TURN_BYTES
    slice_bytes = _SLICE_BYTES

    def __init__(self, hub: _Hub) -> None:
        protocol = ServerProtocol(
            origins=hub.access.allowed_origins,
            max_size=hub.limits.message_bytes,
            select_subprotocol=lambda _, offered: SUBPROTOCOL if SUBPROTOCOL in offered else None,
        )
        super().__init__(protocol, max_size=hub.limits.message_bytes, write_limit=_WRITE_BUFFER)
        self._hub = hub
        self._server_protocol = protocol  # the same as `_protocol`, with its type
        # The broker's client, from the handshake until the connection closes. None before and after.
        self._client: Client | None = None
        self._address = "?"
        # Monotonic seconds, for `sweep`: when the handshake began, when the client was last pinged (None if it has
        # sent something since), since when its socket accepts nothing, and when a closing connection is cut off.
        self._started = time.monotonic()
        self._pinged_at: float | None = None
        self._stuck_since: float | None = None
        self._close_by = inf
        # True from output to the client until its next message, which may be a response.
        self._is_answered = False
        # True while the next turn of `_flush_backlog` is scheduled.
        self._flushing = False

    @property
    def is_blocked(self) -> bool:
        """Return whether to stop reading from the client, because it must first read its answers."""
        client = self._client
        return client is not None and (client.outbox.congested or self._pongs_unread)

    # --- called by the event loop

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start waiting for the handshake."""
        super().connection_made(transport)
        peer = transport.get_extra_info("peername")
        self._address = str(peer[0]) if peer else "?"
        self._hub.begin(self)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)

    def pause_writing(self) -> None:
        """Let the client's outbox fill while the socket accepts nothing."""
        super().pause_writing()
        self._stuck_since = time.monotonic()
        if self._client is not None:
            self._client.outbox.wire = None

    def resume_writing(self) -> None:
        """Write the queued messages."""
        self._stuck_since = None
        super().resume_writing()
        self.flush()

    # --- called by the transport

    def handshake_received(self, event: Request | Response) -> None:
        """Admit the client, or refuse it."""
        protocol, request = self._server_protocol, cast("Request", event)
        response = protocol.accept(request)
        if response.status_code == HTTPStatus.UPGRADE_REQUIRED:
            response = protocol.reject(HTTPStatus.UPGRADE_REQUIRED, _FOR_BROWSERS)
            response.headers["Upgrade"] = "websocket"
        if response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
            refusal = self._hub.access.refusal(request, loopback=self._hub.loopback)
            if refusal is HTTPStatus.FORBIDDEN:
                response = protocol.reject(refusal, "The hub does not have this host name.\n")
            elif refusal is not None:
                response = protocol.reject(refusal, "The hub requires a token.\n")
                response.headers["WWW-Authenticate"] = "Bearer"
            elif self._hub.broker.full:
                response = protocol.reject(
                    HTTPStatus.SERVICE_UNAVAILABLE,
                    f"The hub already has {self._hub.limits.clients} clients.\n",
                )
        response.headers[MESSAGE_BYTES_HEADER] = str(self._hub.limits.message_bytes)
        protocol.send_response(response)
        if response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
            self._client = self._hub.admit(self, self._address)
            if not self.paused:
                self._client.outbox.wire = []
        else:
            self._hub.warn("a connection from %s was refused: HTTP %d", self._address, response.status_code)

    def messages_received(self, messages: list[bytes]) -> None:
        """Have the broker perform the messages, and write the output."""
        if self._client is not None:
            performed = self._hub.broker.receive_turn(self._client, messages, self.last_heard)
            if performed < len(messages):
                self.postpone(messages[performed:])
            responds, self._is_answered = self._is_answered, False
            self._hub.serve()
            if responds:
                self._hub.stay_awake(self.last_heard)

    def close_expected(self) -> None:
        """Remove the client, and abort the connection after `_CLOSE_TIMEOUT` if the client does not close it."""
        error = self._server_protocol.parser_exc
        if error is not None and self._client is not None and not isinstance(error, EOFError):
            self._hub.warn("the connection from %s is closed: %s", self._address, error)
        self._close_by = time.monotonic() + _CLOSE_TIMEOUT
        self._leave()

    def connection_ended(self, _exc: Exception | None) -> None:
        """Remove the client."""
        self._leave()
        self._hub.forget(self)

    # --- called by the hub

    def flush(self) -> None:
        """Write as much of the client's queue as the socket accepts, in one piece if it is small."""
        client = self._client
        if client is None or not self.is_open:
            return
        if client.close_reason:
            self._give_up(client.close_reason)
            return
        outbox = client.outbox
        if outbox.wire:
            payloads, outbox.wire = outbox.wire, []
            self._is_answered = True
            self.send(payloads)
        if outbox.wire is None or not outbox.empty:
            self._flush_backlog(outbox)
        if self._interrupted is not None:
            self.proceed()

    def _flush_backlog(self, outbox: Outbox) -> None:
        """Write at most `_TURN_MESSAGES` messages of the queue now, and the rest after other tasks have run."""
        left = _TURN_MESSAGES
        while left and not self.paused and not outbox.empty:
            # In portions, because what the socket does not accept can no longer be dropped.
            messages: list[bytes] = []
            size = 0
            while left and size < _WRITE_BUFFER and (message := outbox.pop()) is not None:
                messages.append(message)
                size += len(message)
                left -= 1
            if messages:
                self.send(messages)
        if self.paused:
            return
        if outbox.wire is None:
            outbox.wire = []
        if not outbox.empty and not self._flushing:
            self._flushing = True
            asyncio.get_running_loop().call_soon(self._continue_flush)

    def _continue_flush(self) -> None:
        self._flushing = False
        self.flush()

    def sweep(self, now: float) -> None:
        """Close the connection if it has been silent or stuck for too long at `now`."""
        limits = self._hub.limits
        if now > self._close_by:
            self.abort()
        elif self._client is None:
            if self._close_by == inf and now > self._started + limits.handshake_timeout:
                self.abort()
        elif self._stuck_since is not None and now > self._stuck_since + limits.stuck_timeout:
            self._give_up(f"its socket accepted nothing for {limits.stuck_timeout:g} s")
        elif self.is_blocked:
            self.last_heard = now  # the hub does not read from it
        elif self._pinged_at is None:
            if now > self.last_heard + limits.ping_interval and self.is_open:
                self._pinged_at = now
                self.ping()
        elif self.last_heard >= self._pinged_at:
            self._pinged_at = None
        elif now > self._pinged_at + limits.ping_timeout:
            self._give_up(f"it was silent for {now - self.last_heard:.0f} s")

    def close(self, code: CloseCode, reason: str) -> None:
        """Begin the closing handshake, or end a connection that is not open."""
        if self.is_open:
            self.start_closing(code, reason)
            self.close_expected()
        else:
            self.abort()

    def _leave(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._hub.handshakes[self] = None
            self._hub.dismiss(client)

    def _give_up(self, why: str) -> None:
        if not self.is_closing:
            self._hub.warn("the connection from %s is closed: %s", self._address, why)
            self.abort()
