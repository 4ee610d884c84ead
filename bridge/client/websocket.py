"""One WebSocket connection: opened with clear errors, each message handed over at once, a silent peer noticed.

A message goes from the socket's callback straight to its receiver: no queue and no task in between. Whole messages
are found and written by `frames`; handshake, control frames, fragments, whatever is broken and the end are the
library's. It is given whole frames alone, so it always stands between two of them (``_framed``); once anything is
wrong or ends, all that comes is the library's.

Liveness is watched here rather than by the library's keepalive, so that anything the peer sends counts as a sign
of life and a silent one is given up within ``ping_interval + ping_timeout``.
"""

import asyncio
import logging
import socket
import ssl
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Final

from websockets.asyncio.client import ClientConnection
from websockets.client import ClientProtocol
from websockets.exceptions import (
    InvalidHandshake,
    InvalidMessage,
    InvalidStatus,
    InvalidURI,
    PayloadTooBig,
)
from websockets.frames import DATA_OPCODES, CloseCode, Frame
from websockets.protocol import Event, State
from websockets.uri import WebSocketURI, parse_uri

from bridge.client.route import Route, connect_along, shown
from bridge.codecs.json_codec import excerpt
from bridge.errors import AccessRefusedError, BridgeError, NotRosbridgeError, UnreachableError, UriError
from bridge.transport.frames import (
    UNKNOWN,
    UNSOUND,
    frame_end,
    mask_keys,
    masked_text,
    only_message,
    whole_messages,
)

#: An enumeration's member takes as long to look up as a frame to write.
_OPEN: Final = State.OPEN
#: Bytes that may wait for the peer before publishers have to wait too.
WRITE_LIMIT: Final = 1 << 16
#: Seconds that the closing handshake may take.
CLOSE_TIMEOUT: Final = 1.0
_END_OF_HANDSHAKE: Final = b"\r\n\r\n"
#: Seconds by which the watch may be late before that counts as this process having slept, not the peer.
_OVERSLEPT: Final = 0.5


class _NoDebug(logging.LoggerAdapter[logging.Logger]):
    """A log for the library without its debugging: that has all headers in it, tokens too."""

    def isEnabledFor(self, level: int) -> bool:  # noqa: N802  # the standard library's name
        """Whether a line of that level is wanted."""
        return level > logging.DEBUG and super().isEnabledFor(level)


_log = _NoDebug(logging.getLogger("bridge.client.websocket"), {})


def check_uri(uri: str) -> WebSocketURI:
    """Read the URI of a rosbridge server.

    Raises:
        UriError: it is not ``ws://host:port`` or ``wss://host:port`` (a path and credentials may follow).
    """
    try:
        parsed = parse_uri(uri)
        parsed.host.encode("idna")
    except (
        InvalidURI,
        ValueError,
    ) as error:  # ValueError: a port that is no number, half a bracket, odd letters
        reason = error.msg if isinstance(error, InvalidURI) else str(error)
        raise UriError(
            f"{shown(uri)!r} is no URI of a rosbridge server ({reason}): it must be like ws://192.168.1.10:9090"
        ) from None
    return parsed


class WebSocket(ClientConnection):
    """A WebSocket client connection that calls back for every message and for its end.

    Attributes:
        opened: the handshake is done; only then are messages handed over and the end is told.
        first_bytes: what the peer said first, before the handshake was done.
    """

    def __init__(
        self,
        protocol: ClientProtocol,
        *,
        ping_interval: float,
        ping_timeout: float,
        on_messages: Callable[[list[bytes]], None],
        on_lost: Callable[["WebSocket", str], None],
    ) -> None:
        """Prepare the connection; `open_websocket` makes and opens it."""
        super().__init__(
            protocol,
            ping_interval=None,
            ping_timeout=None,
            close_timeout=CLOSE_TIMEOUT,
            max_queue=None,
            write_limit=WRITE_LIMIT,
        )
        self.opened = False
        self.first_bytes = b""
        self._early: list[Frame] = []
        self._on_messages = on_messages
        self._on_lost = on_lost
        self._interval = ping_interval
        self._patience = ping_timeout
        self._last_heard = self.loop.time()
        self._pinged = False
        self._watch: asyncio.TimerHandle | None = None
        self._handshake = b""
        self._framed = False
        self._rest = bytearray()
        self._wanted = 0
        self._largest = protocol.max_message_size or sys.maxsize
        self._begun: bytearray | None = None
        self._keys = mask_keys()
        self._silent_for = 0.0
        self._held = 0

    @property
    def last_heard(self) -> float:
        """When the peer last sent anything (the loop's time)."""
        return self._last_heard

    @property
    def is_open(self) -> bool:
        """Whether messages can be sent."""
        return self.protocol.state is _OPEN

    def begin(self) -> None:
        """Take up the connection after its handshake."""
        self.opened = True
        self._last_heard = self.loop.time()
        self._schedule(self._interval)
        for event in self._early:  # what came in one piece with the handshake
            self.process_event(event)
        self._early.clear()

    def send_now(self, data: bytes) -> bool:
        """Hand one text message to the socket (or to its buffer, without limit: see ``paused`` and ``drain``).

        Returns:
            Whether there is a connection that it went to.
        """
        protocol = self.protocol
        if protocol.state is not _OPEN:
            return False
        frame = masked_text(data, next(self._keys))
        if self._held or protocol.writes:
            protocol.writes.append(frame)
            self.send_data()
        else:
            self.transport.write(frame)
        return True

    @contextmanager
    def together(self) -> Iterator[None]:
        """Keep what is sent inside back until its end, and hand it to the socket in one piece."""
        self._held += 1
        try:
            yield
        finally:
            self._held -= 1
            if not self.transport.is_closing():  # it may have come to its end meanwhile
                self.send_data()

    def send_data(self) -> None:
        """Write what the protocol has to say; the library's own, but for what is kept back."""
        if self._held:
            return
        writes = self.protocol.writes
        if len(writes) > 1:
            # an empty one, always the last, stands for the end of the stream
            self.protocol.writes = [b"".join(writes), *([b""] if not writes[-1] else [])]
        super().send_data()

    def abandon(self) -> None:
        """Give the connection up at once."""
        self.transport.abort()

    # What the transport tells

    def data_received(self, data: bytes) -> None:
        """Take bytes from the socket."""
        self._last_heard = self.loop.time()
        self._pinged = False
        if self._framed:
            self._take_frames(data)
            return
        if not self.opened:
            self.first_bytes = (self.first_bytes + data)[:64]
            if self.protocol.state is State.CONNECTING:
                self._take_handshake(data)
                return
        self._give_library(data)

    def eof_received(self) -> None:
        """Take note that the peer says nothing more."""
        self._give_rest()
        super().eof_received()

    def _take_handshake(self, data: bytes) -> None:
        """Give the library the answer to the handshake, up to where frames begin."""
        before = self._handshake
        end = (before + data).find(_END_OF_HANDSHAKE)
        if end < 0:
            self._handshake = (before + data)[-len(_END_OF_HANDSHAKE) + 1 :]
            self._give_library(data)
            return
        frames = end + len(_END_OF_HANDSHAKE) - len(before)
        self._give_library(data[:frames])
        # A refusal may have a body: that is the library's too.
        self._framed = self.protocol.state is _OPEN
        if frames < len(data):
            (self._take_frames if self._framed else self._give_library)(data[frames:])

    def _take_frames(self, data: bytes) -> None:
        """Take frames: hand whole messages over, have the library read each of the others."""
        at = 0
        if self._rest:
            rest, missing = self._rest, self._wanted - len(self._rest)
            at = missing if 0 < missing < len(data) else len(data)
            rest += data if at == len(data) else data[:at]
            if len(rest) < self._wanted:
                return
            begun = bytes(rest)
            rest.clear()
            self._read_frames(begun, 0)
            if at == len(data):
                return
        elif self.opened and self.protocol.current_size is None:
            message = only_message(data, masked=False, largest=self._largest)
            if message is not None:  # so it is nearly always, when they do not come in floods
                self._on_messages([message])
                return
        if self._framed:
            self._read_frames(data, at)
        else:
            self._give_library(data[at:])

    def _read_frames(self, data: bytes, at: int) -> None:
        """Take the frames from ``at`` on; one that is not complete is kept for later."""
        size = len(data)
        while at < size:
            begun = self.protocol.current_size  # bytes of a message in several frames, None outside of one
            if begun is None and self.opened:
                messages, at = whole_messages(data, at, masked=False, largest=self._largest)
                if messages:
                    self._on_messages(messages)
                if at == size:
                    return
            end = frame_end(data, at, masked=False, largest=self._largest - (begun or 0))
            if end == UNKNOWN or end > size:
                self._rest += data[at:]
                self._wanted = (
                    end - at
                )  # less than there is if nobody knows yet: then the next bytes are looked at
                return
            if end == UNSOUND:
                self._framed = False
                end = size
            self._give_library(data[at:end])
            at = end
            if self.protocol.state is not _OPEN:
                self._framed = False
                if at < size:
                    self._give_library(data[at:])
                return

    def _give_rest(self) -> None:
        """Give the library what there is of a frame, and all that may come after it."""
        if self._framed:
            self._framed = False
            if self._rest:
                self.protocol.receive_data(bytes(self._rest))
                self._rest.clear()

    def _give_library(self, data: bytes) -> None:
        """Have the library read some bytes, and do what comes of it."""
        super().data_received(data)
        if self.protocol.state is not _OPEN:
            if not self.opened and self.protocol.handshake_exc is not None:
                self.abandon()  # a peer that speaks something else may never hang up
            elif self.opened and self.protocol.state is State.CLOSING:
                # The server ends the connection by the protocol; one that does not is not waited for.
                self._schedule(CLOSE_TIMEOUT)

    def process_event(self, event: Event) -> None:
        """Take one event of the WebSocket protocol: hand a whole message over, leave the rest to the library."""
        if not isinstance(event, Frame) or event.opcode not in DATA_OPCODES:
            super().process_event(event)
            return
        if not self.opened:
            self._early.append(event)
            return
        if self._begun is None and event.fin:
            self._on_messages([bytes(event.data)])
            return
        # In several frames. Their sizes together are limited by the protocol.
        if self._begun is None:
            self._begun = bytearray()
        self._begun += event.data
        if event.fin:
            whole, self._begun = bytes(self._begun), None
            self._on_messages([whole])

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note of the end, and tell it."""
        self._give_rest()
        super().connection_lost(exc)
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None
        if self.opened:
            self._on_lost(self, self._why_lost(exc))

    def _why_lost(self, exc: Exception | None) -> str:
        if self._silent_for:
            return f"nothing was heard from the server for {self._silent_for:.3g} s"
        if isinstance(self.protocol.parser_exc, PayloadTooBig):
            return (
                f"the server sent a message of more than {self.protocol.max_message_size} bytes "
                "(max_size allows larger ones)"
            )
        if (
            self.protocol.close_rcvd is not None
            and self.protocol.close_rcvd.code == CloseCode.MESSAGE_TOO_BIG
        ):
            return "the server closed it: a message was larger than it takes (code 1009)"
        if self.protocol.close_rcvd is not None:
            return f"the server closed it (code {self.protocol.close_rcvd.code})"
        if self.protocol.close_sent is not None:
            return f"the server broke the WebSocket protocol ({self.protocol.close_sent.reason})"
        return _say(exc) if isinstance(exc, OSError) else "the connection broke off"

    # Watching for silence

    def _schedule(self, seconds: float) -> None:
        if self._watch is not None:
            self._watch.cancel()
        self._watch = self.loop.call_later(seconds, self._look, self.loop.time() + seconds)

    def _look(self, due: float) -> None:
        self._watch = None
        now = self.loop.time()
        if self.protocol.state is not _OPEN:
            self.abandon()
            return
        silent = now - self._last_heard
        if silent < self._interval:
            self._schedule(self._interval - silent)
        elif not self._pinged or now - due > _OVERSLEPT:
            self._pinged = True
            self.protocol.send_ping(b"")
            self.send_data()
            self._schedule(self._patience)
        else:
            self._silent_for = silent
            self.abandon()


async def open_websocket(
    uri: WebSocketURI,
    shown_uri: str,
    *,
    route: Route,
    timeout: float,  # noqa: ASYNC109  # the limit is part of the errors' sentences
    max_size: int,
    ping_interval: float,
    ping_timeout: float,
    on_messages: Callable[[list[bytes]], None],
    on_lost: Callable[[WebSocket, str], None],
) -> WebSocket:
    """Connect, without permessage-deflate: on a local network it costs more than it saves.

    Args:
        uri: where to.
        shown_uri: the same without secrets, for the errors.
        route: the way there: TLS, headers, a proxy.
        timeout: seconds for all of it.
        max_size: bytes of one incoming message; a larger one ends the connection.
        ping_interval: seconds of silence after which the peer is asked for a sign of life.
        ping_timeout: seconds that it then has.
        on_messages: is called with the messages, those that came together at once.
        on_lost: is called once, with the reason, when the connection ends.

    Returns:
        The open connection.

    Raises:
        UnreachableError: nothing answers there.
        NotRosbridgeError: something answers there, but not as a WebSocket server.
        AccessRefusedError: it wants a token or a certificate, or another one.
    """
    made: list[WebSocket] = []

    def factory() -> WebSocket:
        websocket = WebSocket(
            ClientProtocol(uri, max_size=max_size, logger=_log),
            ping_interval=ping_interval,
            ping_timeout=ping_timeout,
            on_messages=on_messages,
            on_lost=on_lost,
        )
        made.append(websocket)
        return websocket

    try:
        async with asyncio.timeout(timeout):
            websocket = await connect_along(route, uri, shown_uri, factory)
            await websocket.handshake(route.headers)
    except BaseException as error:
        attempt = made[-1] if made and hasattr(made[-1], "transport") else None
        if attempt is not None:
            attempt.abandon()
        heard = attempt.first_bytes if attempt is not None else b""
        if (
            isinstance(error, Exception)
            and attempt is not None
            and attempt.protocol.handshake_exc is not None
        ):
            # What was heard says more than what came of it: a service that greets first breaks off the request.
            error = attempt.protocol.handshake_exc
        if isinstance(error, BridgeError) or not isinstance(error, OSError | InvalidHandshake):
            raise
        raise _connect_error(error, shown_uri, heard, timeout, answered=attempt is not None) from error
    if not websocket.is_open:
        raise UnreachableError(f"{shown_uri} is unreachable: it closed the connection at once")
    websocket.begin()
    return websocket


def _connect_error(
    error: Exception, uri: str, heard: bytes, seconds: float, *, answered: bool
) -> UnreachableError | NotRosbridgeError | AccessRefusedError:
    """The sentence for a connection that did not come about."""
    if isinstance(error, InvalidStatus):
        response = error.response
        seen = f"HTTP {response.status_code} {response.reason_phrase[:80]}".rstrip()
        if response.status_code in {HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN}:
            return AccessRefusedError(f"{uri} does not let this client in ({seen}): check token and headers")
        if response.status_code == HTTPStatus.SERVICE_UNAVAILABLE:
            return UnreachableError(f"{uri} takes no more clients now ({seen})")
        to = response.headers.get("Location")
        seen += f", to {to[:200]}" if to else ""
        return NotRosbridgeError(
            f"{uri} is no rosbridge server: it answers as a web server ({seen}); check port and path"
        )
    if isinstance(error, InvalidMessage) and not heard:
        perhaps = " (as servers do that want a client_certificate)" if uri.startswith("wss:") else ""
        return UnreachableError(f"{uri} is unreachable: it closed the connection without an answer{perhaps}")
    if isinstance(error, InvalidHandshake) or (isinstance(error, TimeoutError) and heard):
        why = f"within {seconds:g} s " if isinstance(error, TimeoutError) else ""
        return NotRosbridgeError(
            f"{uri} is no rosbridge server: it did not answer {why}as a WebSocket server but with {excerpt(heard)}"
        )
    if isinstance(error, ssl.SSLCertVerificationError):
        return UnreachableError(f"{uri} is not to be trusted: its certificate: {error.verify_message}")
    if isinstance(error, ssl.SSLError) and "ALERT" in (error.reason or ""):
        return AccessRefusedError(
            f"{uri} does not let this client in ({error.reason}): check client_certificate"
        )
    if isinstance(error, ssl.SSLError):
        return NotRosbridgeError(
            f"{uri} does not speak TLS ({error.reason}): is it ws:// rather than wss://?"
        )
    if isinstance(error, TimeoutError) and error.errno is None:  # the kernel's own has a number
        done = "it took the connection but did not answer" if answered else "it did not answer"
        return UnreachableError(f"{uri} is unreachable: {done} within {seconds:g} s")
    if isinstance(error, socket.gaierror):
        return UnreachableError(f"{uri} is unreachable: its host name is not known ({_say(error)})")
    return UnreachableError(
        f"{uri} is unreachable: {_say(error)}; is the rosbridge server running, and is the port right?"
    )


def _say(error: Exception) -> str:
    """An operating system's error in its own words, without numbers."""
    if isinstance(error, ConnectionRefusedError):
        return "connection refused"
    if isinstance(error, ConnectionResetError):
        return "the connection was reset"
    return (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
