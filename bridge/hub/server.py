"""The hub on a socket: a thin shell of WebSockets around the broker.

Each connection is an `asyncio.Protocol` around the sans-I/O protocol of ``websockets``, without a task: a
message is read, brokered and written to all who hear it within one callback of the event loop. Nothing is
compressed: on loopback that costs more than it saves.

What a socket doesn't take waits in its client's outbox, which drops the oldest; nobody else waits for it.
"""

import asyncio
import contextlib
import logging
import re
import socket
import time
from collections.abc import Callable, Sequence
from http import HTTPStatus
from math import inf
from typing import Final, cast

from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.typing import Origin

from bridge.hub.broker import Broker
from bridge.hub.errors import HubError
from bridge.hub.graph import Client
from bridge.hub.limits import HubLimits

log = logging.getLogger(__name__)

#: Web pages of this machine; pages from elsewhere could speak to a robot through their visitor's browser.
_LOCAL_ORIGIN: Final = re.compile(r"https?://(localhost|127\.\d+\.\d+\.\d+|\[::1\])(:\d+)?")
#: Bytes that wait in the process for one socket before its client's outbox fills.
_WRITE_BUFFER: Final = 64 * 1024
#: Bytes that wait in the kernel for one socket: more would only be older when they arrive.
_SEND_BUFFER: Final = 256 * 1024
#: Frames of one client that are worked on before others have their turn, looked at after so many bytes.
_TURN: Final = 64
_SLICE: Final = 4 * 1024
#: Seconds between two looks for silent and stuck clients.
_SWEEP: Final = 1.0
#: Seconds that a peer has to end a connection which we closed.
_CLOSE_TIMEOUT: Final = 2.0
#: Connections whose handshake is under way, beyond the clients.
_HANDSHAKES: Final = 64
_LAST_PORT: Final = 65535
#: Payloads from these lengths on have a longer header (RFC 6455, section 5.2).
_MEDIUM_FRAME: Final = 126
_LONG_FRAME: Final = 1 << 16


async def serve_hub(
    host: str,
    port: int,
    *,
    limits: HubLimits | None = None,
    origins: Sequence[str] = (),
    on_ready: Callable[[int], None] | None = None,
    stop: asyncio.Event,
) -> None:
    """Serve rosbridge until ``stop`` is set, then close every connection (1001) and return.

    Args:
        host: the address to listen on. The hub knows no passwords: give a loopback address, unless everybody
            who reaches the address may publish to your robot.
        port: 0 for any free one.
        limits: what is refused.
        origins: web pages (``https://robot.example``) that may connect, besides those of this machine.
            Programs that are no browsers send no origin and may always connect.
        on_ready: called with the port once clients can connect.
        stop: set it to end.

    Raises:
        HubError: the address cannot be served.
    """
    if not 0 <= port <= _LAST_PORT:
        raise HubError(
            f"the hub cannot listen on {host} port {port}: a port is a number from 0 to {_LAST_PORT}"
        )
    hub = _Hub(limits or HubLimits(), origins)
    loop = asyncio.get_running_loop()
    try:
        server = await loop.create_server(lambda: _Connection(hub), host, port)
    except OSError as error:
        raise HubError(
            f"the hub cannot listen on {host} port {port} ({error.strerror or error}): "
            "end what listens there already, or choose another host or port"
        ) from None
    try:
        hub.sweep()
        if on_ready is not None:
            on_ready(server.sockets[0].getsockname()[1])
        await stop.wait()
    finally:
        server.close()
        await hub.close()


class _Hub:
    """The broker, its connections and its timers."""

    def __init__(self, limits: HubLimits, origins: Sequence[str]) -> None:
        self.limits = limits
        self.broker = Broker(limits)
        self.origins: list[Origin | re.Pattern[str] | None] = [None, _LOCAL_ORIGIN, *map(Origin, origins)]
        self.connections: set[_Connection] = set()
        self._by_client: dict[Client, _Connection] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._timer_deadline = inf
        self._sweeper: asyncio.TimerHandle | None = None
        self._swept = time.monotonic()
        self._nobody_left = asyncio.Event()

    def admit(self, connection: "_Connection", address: str) -> Client:
        client = self.broker.connect(address)
        self._by_client[client] = connection
        return client

    def receive(self, client: Client, data: bytes) -> None:
        self.broker.receive(client, data, time.monotonic())
        self._serve()

    def dismiss(self, client: Client) -> None:
        del self._by_client[client]
        self.broker.disconnect(client)
        self._serve()

    def forget(self, connection: "_Connection") -> None:
        self.connections.discard(connection)
        if not self.connections:
            self._nobody_left.set()

    def sweep(self) -> None:
        """Look after those who say nothing and take nothing, now and then."""
        now = time.monotonic()
        # When the hub itself was held up, its clients' answers may be waiting to be read: next time, then.
        if now < self._swept + 3 * _SWEEP:
            for connection in list(self.connections):
                connection.sweep(now)
        self._swept = now
        self._sweeper = asyncio.get_running_loop().call_later(_SWEEP, self.sweep)

    async def close(self) -> None:
        """End all connections: politely, then not."""
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

    def _serve(self) -> None:
        """Send what the broker has for whom, and see that it is woken in time."""
        for client in self.broker.take_ready():
            connection = self._by_client.get(client)
            if connection is not None:
                connection.flush()
        if self.broker.deadline != self._timer_deadline:
            self._set_timer(self.broker.deadline)

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
        self._serve()


class _Connection(asyncio.Protocol):
    """One WebSocket: frames in, messages out, and the clocks that run on it."""

    def __init__(self, hub: _Hub) -> None:
        self._hub = hub
        self._protocol = ServerProtocol(origins=hub.origins, max_size=hub.limits.message_bytes)
        self._transport: asyncio.Transport
        self._client: Client | None = None
        self._address = "?"
        self._partial: bytearray | None = None
        self._started = self._heard = time.monotonic()
        self._pinged: float | None = None
        self._stuck_since: float | None = None
        self._close_by = inf

    # --- what asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait for the handshake."""
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(high=_WRITE_BUFFER)
        peer = transport.get_extra_info("peername")
        self._address = str(peer[0]) if peer else "?"
        self._hub.connections.add(self)
        if len(self._hub.connections) > self._hub.limits.clients + _HANDSHAKES:
            self.abort()
            return
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)

    def data_received(self, data: bytes) -> None:
        """Do what arrived, to the last answer it causes; but after many frames others have their turn."""
        self._heard = time.monotonic()
        if len(data) <= _SLICE:
            self._take(data)
        else:
            rest = self._take_turn(memoryview(data))
            if rest:
                self._transport.pause_reading()
                asyncio.get_running_loop().call_soon(self._go_on, rest)

    def eof_received(self) -> None:
        """A client that ends its half ends the whole."""
        self._protocol.receive_eof()
        self._after_protocol()

    def connection_lost(self, _exc: Exception | None) -> None:
        """Forget the client."""
        self._hub.forget(self)
        self._leave()

    def pause_writing(self) -> None:
        """The socket takes nothing now: its client's outbox fills from here on."""
        self._stuck_since = time.monotonic()

    def resume_writing(self) -> None:
        """The socket takes data again."""
        self._stuck_since = None
        self.flush()

    # --- what the hub calls

    def flush(self) -> None:
        """Write what waits for the client, as far as the socket takes it."""
        client = self._client
        if client is None or self._protocol.state is not State.OPEN or self._transport.is_closing():
            return
        if client.doomed:
            self._give_up(client.doomed)
            return
        pop, write = client.outbox.pop, self._transport.write
        while self._stuck_since is None:
            payload = pop()
            if payload is None:
                return
            write(_header(len(payload)) + payload)

    def sweep(self, now: float) -> None:
        """Close what is too silent or too slow at ``now``."""
        limits = self._hub.limits
        if now > self._close_by:
            self.abort()
        elif self._protocol.state is State.CONNECTING:
            if now > self._started + limits.handshake_timeout:
                self.abort()
        elif self._stuck_since is not None and now > self._stuck_since + limits.stuck_timeout:
            self._give_up(f"its socket took nothing for {limits.stuck_timeout:g} s")
        elif self._pinged is None:
            if now > self._heard + limits.ping_interval and self._protocol.state is State.OPEN:
                self._pinged = now
                self._protocol.send_ping(b"")
                self._after_protocol()
        elif self._heard >= self._pinged:
            self._pinged = None
        elif now > self._pinged + limits.ping_timeout:
            self._give_up(f"nothing was heard of it for {now - self._heard:.0f} s")

    def close(self, code: CloseCode, reason: str) -> None:
        """Begin to end the connection."""
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(code, reason)
            self._after_protocol()
        else:
            self.abort()

    def abort(self) -> None:
        """End the connection at once."""
        self._transport.abort()

    # --- the rest

    def _go_on(self, data: memoryview) -> None:
        rest = self._take_turn(data)
        if rest:
            asyncio.get_running_loop().call_soon(self._go_on, rest)
        elif not self._transport.is_closing():
            self._transport.resume_reading()

    def _take_turn(self, data: memoryview) -> memoryview:
        """Work on a client's data until its turn is over; what is left of it."""
        frames = 0
        while data and frames < _TURN and not self._transport.is_closing():
            frames += self._take(bytes(data[:_SLICE]))
            data = data[_SLICE:]
        return data[:0] if self._transport.is_closing() else data

    def _take(self, data: bytes) -> int:
        """Do what the next bytes ask for; how many frames they had."""
        self._protocol.receive_data(data)
        events = self._protocol.events_received()
        for event in events:
            if isinstance(event, Frame):
                self._take_frame(event)
            elif isinstance(event, Request):
                self._answer_request(event)
        self._after_protocol()
        return len(events)

    def _answer_request(self, request: Request) -> None:
        protocol = self._protocol
        response = protocol.accept(request)
        if response.status_code == HTTPStatus.SWITCHING_PROTOCOLS and self._hub.broker.full:
            response = protocol.reject(
                HTTPStatus.SERVICE_UNAVAILABLE, f"The hub has {self._hub.limits.clients} clients already.\n"
            )
        protocol.send_response(response)
        if protocol.state is State.OPEN:
            self._client = self._hub.admit(self, self._address)
        else:
            log.warning("a connection from %s was refused: HTTP %d", self._address, response.status_code)

    def _take_frame(self, frame: Frame) -> None:
        if frame.opcode not in {Opcode.TEXT, Opcode.BINARY, Opcode.CONT} or self._client is None:
            return
        data = bytes(frame.data)
        if not frame.fin or self._partial is not None:
            # A bytearray, not a list: empty fragments without end take nothing.
            self._partial = self._partial or bytearray()
            self._partial += data
            if not frame.fin:
                return
            data, self._partial = bytes(self._partial), None
        self._hub.receive(self._client, data)

    def _after_protocol(self) -> None:
        """Send what the protocol itself has to say, and see to the end if it has come."""
        for data in self._protocol.data_to_send():
            if self._transport.is_closing():
                break
            if data:
                self._transport.write(data)
            else:  # our half is over; closing the whole could cost the last frame on its way
                self._transport.write_eof()
        if self._protocol.close_expected():
            self._close_by = min(self._close_by, time.monotonic() + _CLOSE_TIMEOUT)
            self._leave()

    def _leave(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._hub.dismiss(client)

    def _give_up(self, why: str) -> None:
        if not self._transport.is_closing():
            log.warning("the connection from %s is closed: %s", self._address, why)
            self.abort()


def _header(length: int) -> bytes:
    """The beginning of an unmasked text frame."""
    if length < _MEDIUM_FRAME:
        return bytes((0x81, length))
    if length < _LONG_FRAME:
        return b"\x81\x7e" + length.to_bytes(2, "big")
    return b"\x81\x7f" + length.to_bytes(8, "big")
