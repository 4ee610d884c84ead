"""The hub on a socket: a thin shell of WebSockets around the broker.

Each connection is an `asyncio.Protocol`, without a task: what a socket brings is read, brokered and written to all
who hear it within one callback of the event loop, with one write for each of them. Whole messages are found by
`frames`; handshakes, pings, fragments and everything broken are left to the sans-I/O protocol of ``websockets``.
Nothing is compressed: on loopback that costs more than it saves.

What a socket doesn't take waits in its client's outbox, which drops the oldest; nobody else waits for it.
"""

import asyncio
import contextlib
import logging
import socket
import time
from collections.abc import Callable
from http import HTTPStatus
from math import inf
from typing import Final, cast

from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol

from bridge.hub.access import Door, choose_subprotocol
from bridge.hub.broker import Broker
from bridge.hub.delivery.definitions import RosVersion
from bridge.hub.delivery.outbox import Outbox
from bridge.hub.errors import HubError
from bridge.hub.graph import Client, Graph
from bridge.hub.limits import HubLimits
from bridge.transport.frames import UNKNOWN, UNSOUND, frame_end, only_message, unmasked, whole_messages

log = logging.getLogger(__name__)

#: An enumeration's member takes as long to look up as a frame to write.
_OPEN: Final = State.OPEN
#: Bytes that wait in the process for one socket before its client's outbox fills.
_WRITE_BUFFER: Final = 64 * 1024
#: Bytes that wait in the kernel for one socket: more would only be older when they arrive.
_SEND_BUFFER: Final = 256 * 1024
#: Frames of one client, or so many bytes of them, that are worked on before others have their turn.
_TURN: Final = 64
_TURN_BYTES: Final = 64 * 1024
_SLICE: Final = 4 * 1024
#: Of memory that was used: half of what is kept for the next messages.
_KEPT: Final = 4 * 1024 * 1024
#: Seconds between two looks for silent and stuck clients.
_SWEEP: Final = 1.0
#: Seconds that a peer has to end a connection which we closed.
_CLOSE_TIMEOUT: Final = 2.0
#: Connections whose handshake is under way, beyond the clients.
_HANDSHAKES: Final = 64
_LAST_PORT: Final = 65535
_END_OF_REQUEST: Final = b"\r\n\r\n"


async def serve_hub(
    host: str,
    port: int,
    *,
    limits: HubLimits | None = None,
    door: Door | None = None,
    ros_version: RosVersion = 1,
    on_ready: Callable[[int], None] | None = None,
    on_graph: Callable[[Graph], None] | None = None,
    stop: asyncio.Event,
) -> None:
    """Serve rosbridge until ``stop`` is set, then close every connection (1001) and return.

    Args:
        host: the address to listen on. Without tokens and TLS give a loopback address, unless everybody who
            reaches the address may publish to your robot.
        port: 0 for any free one.
        limits: what is refused.
        door: who may come in, and whether what they say is encrypted; by default every program, and web pages
            of this machine.
        ros_version: which ROS it plays.
        on_ready: called with the port once clients can connect.
        on_graph: called before with who and what there is; to be looked at, not changed.
        stop: set it to end.

    Raises:
        HubError: the address cannot be served.
    """
    if not 0 <= port <= _LAST_PORT:
        raise HubError(
            f"the hub cannot listen on {host} port {port}: a port is a number from 0 to {_LAST_PORT}"
        )
    door = door or Door()
    hub = _Hub(limits or HubLimits(), door, ros_version)
    _keep_memory()
    loop = asyncio.get_running_loop()
    try:
        server = await loop.create_server(
            lambda: _Connection(hub),
            host,
            port,
            ssl=door.tls,
            ssl_handshake_timeout=hub.limits.handshake_timeout if door.tls else None,
        )
    except socket.gaierror as error:
        raise HubError(
            f"the hub cannot listen on {host}: that is no address or name of this machine ({error.strerror}); "
            "give one, for example 127.0.0.1, or 0.0.0.0 for all of them"
        ) from None
    except OSError as error:
        raise HubError(
            f"the hub cannot listen on {host} port {port} ({error.strerror or error}): "
            "end what listens there already, or choose another host or port"
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


def _keep_memory() -> None:
    """Have the C library keep what large messages took, for the next ones.

    glibc gives memory back after each burst, and takes it again page by page, which is a fifth of the hub's time with
    messages of 17 kB. Once a block of so many bytes was freed it keeps twice as many.
    """
    bytes(_KEPT)


class _Hub:
    """The broker, its connections and its timers."""

    def __init__(self, limits: HubLimits, door: Door, ros_version: RosVersion) -> None:
        self.limits = limits
        self.broker = Broker(limits, ros_version=ros_version)
        self.door = door
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

    def dismiss(self, client: Client) -> None:
        del self._by_client[client]
        self.broker.disconnect(client)
        self.serve()

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

    def serve(self) -> None:
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
        self.serve()


class _Connection(asyncio.Protocol):
    """One WebSocket: frames in, messages out, and the clocks that run on it."""

    def __init__(self, hub: _Hub) -> None:
        self._hub = hub
        self._protocol = ServerProtocol(
            origins=hub.door.allowed_origins,
            max_size=hub.limits.message_bytes,
            select_subprotocol=lambda _, offered: choose_subprotocol(offered),
        )
        self._transport: asyncio.Transport
        self._client: Client | None = None
        self._address = "?"
        self._partial: bytearray | None = None
        # Whether whole frames are looked for here; else all that comes is the library's to read.
        self._quick = False
        self._rest: bytes | bytearray = b""
        self._wanted = 0
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
        at, client = 0, self._client
        if self._rest:
            if isinstance(
                self._rest, bytes
            ):  # a large frame comes in many pieces: they are put together once
                self._rest = bytearray(self._rest)
            missing = self._wanted - len(self._rest)
            at = missing if 0 < missing < len(data) else len(data)
            self._rest += data if at == len(data) else data[:at]
            if len(self._rest) < self._wanted:
                return
            begun, self._rest = bytes(self._rest), b""
            if at == len(data):
                data, at = begun, 0
            else:
                self._take(begun, 0)
        elif client is not None and self._quick and self._partial is None:
            message = only_message(data, masked=True, largest=self._hub.limits.message_bytes)
            if message is not None:  # so it is nearly always, when they do not come in floods
                self._hub.broker.receive_all(client, [message], self._heard)
                self._hub.serve()
                return
        self._work_on(data, at)

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
        if self._client is not None:
            self._client.outbox.wire = None

    def resume_writing(self) -> None:
        """The socket takes data again."""
        self._stuck_since = None
        self.flush()

    # --- what the hub calls

    def flush(self) -> None:
        """Write what waits for the client, as far as the socket takes it, in one piece where it is small."""
        client = self._client
        if client is None or self._protocol.state is not _OPEN or self._transport.is_closing():
            return
        if client.close_reason:
            self._give_up(client.close_reason)
            return
        outbox = client.outbox
        if outbox.wire:
            self._transport.write(unmasked(outbox.take_wire()))
        if outbox.wire is None or not outbox.empty:
            self._flush_waiting(outbox)

    def _flush_waiting(self, outbox: Outbox) -> None:
        """Write what waited while the socket took nothing, and what goes in fragments."""
        while self._stuck_since is None and not outbox.empty:
            waiting = outbox.pop()
            if waiting is not None:
                self._transport.write(unmasked((waiting,)))
        if self._stuck_since is None and outbox.wire is None:
            outbox.wire = []

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
            if now > self._heard + limits.ping_interval and self._protocol.state is _OPEN:
                self._pinged = now
                self._protocol.send_ping(b"")
                self._after_protocol()
        elif self._heard >= self._pinged:
            self._pinged = None
        elif now > self._pinged + limits.ping_timeout:
            self._give_up(f"nothing was heard of it for {now - self._heard:.0f} s")

    def close(self, code: CloseCode, reason: str) -> None:
        """Begin to end the connection."""
        if self._protocol.state is _OPEN:
            self._protocol.send_close(code, reason)
            self._after_protocol()
        else:
            self.abort()

    def abort(self) -> None:
        """End the connection at once."""
        self._transport.abort()

    # --- the rest

    def _work_on(self, data: bytes, at: int = 0) -> None:
        """Work on a client's bytes for one turn; what is left is for the next, when others had theirs."""
        at = self._take(data, at)
        self._hub.serve()
        if at < len(data) and not self._transport.is_closing():
            self._transport.pause_reading()
            asyncio.get_running_loop().call_soon(self._go_on, data, at)

    def _go_on(self, data: bytes, at: int) -> None:
        if not self._transport.is_closing():
            self._transport.resume_reading()
            self._work_on(data, at)

    def _take(self, data: bytes, at: int) -> int:
        """Do what a turn's worth of bytes asks for; where it ended. An incomplete frame is kept for later."""
        size, frames, turn_end = len(data), 0, at + _TURN_BYTES
        largest, now = self._hub.limits.message_bytes, self._heard
        while at < size and frames < _TURN and at < turn_end:
            if not self._quick:
                self._hand_over(data[at : at + _SLICE])
                at = min(at + _SLICE, size)
                break
            client = self._client
            if self._partial is None and client is not None:
                found, at = whole_messages(
                    data, at, masked=True, largest=largest, count=_TURN - frames, until=turn_end
                )
                frames += len(found)
                if found:
                    self._hub.broker.receive_all(client, found, now)
                    continue
            end = frame_end(data, at, masked=True, largest=largest)
            if end == UNSOUND:
                self._quick = False  # the library closes the connection for it, before all of it has come
            elif end == UNKNOWN or end > size:
                self._rest, self._wanted = data[at:], end - at if end else 0
                at = size
            else:
                frames += 1
                self._hand_over(data[at:end])
                at = end
        return at

    def _hand_over(self, data: bytes) -> None:
        """Have the library read some bytes: a whole frame, or whatever comes once nothing is quick any more."""
        was_open = self._client is not None
        self._protocol.receive_data(data)
        for event in self._protocol.events_received():
            if isinstance(event, Frame):
                self._take_frame(event)
            elif isinstance(event, Request):
                self._answer_request(event)
        self._after_protocol()
        if self._protocol.state is not _OPEN:
            self._quick = False
        elif not was_open:
            # The library stands before a frame, unless the client sent some without waiting for the answer.
            self._quick = data.endswith(_END_OF_REQUEST) and data.count(_END_OF_REQUEST) == 1

    def _answer_request(self, request: Request) -> None:
        protocol = self._protocol
        response = protocol.accept(request)
        if response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
            refusal = self._hub.door.refusal(request)
            if refusal is not None:
                response = protocol.reject(refusal, "The hub wants a token.\n")
                response.headers["WWW-Authenticate"] = "Bearer"
            elif self._hub.broker.full:
                response = protocol.reject(
                    HTTPStatus.SERVICE_UNAVAILABLE,
                    f"The hub has {self._hub.limits.clients} clients already.\n",
                )
        protocol.send_response(response)
        if protocol.state is _OPEN:
            self._client = self._hub.admit(self, self._address)
            if self._stuck_since is None:
                self._client.outbox.wire = []
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
        self._hub.broker.receive(self._client, data, self._heard)

    def _after_protocol(self) -> None:
        """Send what the protocol itself has to say, and see to the end if it has come."""
        for data in self._protocol.data_to_send():
            if self._transport.is_closing():
                break
            if data:
                self._transport.write(data)
            elif self._transport.can_write_eof():
                # Our half is over; closing the whole could cost the last frame on its way.
                self._transport.write_eof()
            else:  # TLS has no halves
                self._transport.close()
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
