"""A WebSocket on an asyncio transport, for client and hub: bytes in, whole messages out.

    socket ──▶ data_received ─┬─ one whole message, the usual case ─────────────────▶ messages_received
                              ├─ frames.whole_messages: several in one piece ───────▶ messages_received
                              ├─ an incomplete frame: kept until the rest arrives
                              └─ the library: handshake, control frames, fragments ─▶ events, answers
    socket ◀── write ◀─┬─ send: frames of whole messages
                       └─ _flush: what the library answers

The library is the sans-I/O protocol of `websockets`. It handles handshakes, control frames, fragments and malformed
frames. Nearly all rosbridge messages are unfragmented. The functions of `bridge.transport.frames` read and write
unfragmented messages in a fraction of the library's time. The library gets only whole frames, so it never waits for
the rest of a frame. After a malformed frame or the beginning of the closing handshake, the library reads everything.
"""

import asyncio
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar, Final, cast

from websockets.client import ClientProtocol
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from bridge.transport import frames

MESSAGE_BYTES_HEADER: Final = "Rosbridge-Message-Bytes"
"""Header in the hub's handshake with the maximum size in bytes of a message that the hub accepts."""
# Maximum size of the unread answers to a peer, in messages of the maximum size.
_MAX_UNREAD: Final = 4
_BEGINNING: Final = 512
# Looking up a module-level name is faster than looking up an enumeration member.
_OPEN: Final = State.OPEN
_END_OF_HEADERS: Final = b"\r\n\r\n"
_FIRST_BYTES: Final = 64
_DATA_OPCODES: Final = frozenset((Opcode.TEXT, Opcode.BINARY, Opcode.CONT))


class WebSocketTransport(asyncio.Protocol):
    """A WebSocket connection. A subclass handles the handshake, the messages and the end of the connection."""

    # A turn: after this much from one peer, other tasks get theirs. A client has one peer and needs none. The bytes are
    # those of one read: uvloop would otherwise read from one socket up to 32 times before it looks at the others.
    turn_frames: ClassVar[int] = sys.maxsize
    turn_bytes: ClassVar[int] = sys.maxsize
    # Bytes that the library reads in one turn once it reads everything, in which it is much slower.
    slice_bytes: ClassVar[int] = sys.maxsize

    def __init__(self, protocol: ClientProtocol | ServerProtocol, *, max_size: int, write_limit: int) -> None:
        """Prepare the connection. `protocol` must have the same `max_size`.

        `paused` becomes true when more than `write_limit` bytes are unsent.
        """
        # Monotonic seconds of the last data from the peer, whatever it was.
        self.last_heard = time.monotonic()
        # True while messages can be sent. It copies the library's state, which takes longer to look up, after each
        # call of the library (`_flush`), and `abort` clears it.
        self.is_open = False
        # For error messages: the beginning of the peer's answer, and of a frame that was invalid or too large.
        self.first_bytes = b""
        self.refused = b""
        # True while so much data waits for the peer that writers should wait too (see `drain`), which asyncio decides
        # by `write_limit`.
        self.paused = False
        self._writable = asyncio.Event()
        self._writable.set()
        self._write_limit = write_limit

        self._protocol = protocol
        self._is_server = isinstance(protocol, ServerProtocol)
        self._max_size = max_size
        self._encode = frames.unmasked if self._is_server else frames.Masker().encode
        # Set when the event loop has connected, and kept after the end.
        self._transport: asyncio.Transport | None = None
        self._lost = asyncio.Event()
        # True once `close_expected` was called, which happens at most once.
        self._ends = False

        # Until the end of the HTTP headers the library reads; `_handshake_tail` has bytes that may begin that end.
        self._in_handshake = True
        self._handshake_tail = b""
        # True while whole messages are split off here: from the handshake to the first invalid frame or the end.
        self._quick = False
        # An incomplete frame, of `_wanted` bytes in all, or 0 while its header is incomplete. It is kept here because
        # the library must stand between two frames while `_quick`.
        self._rest = bytearray()
        self._wanted = 0
        # The data frames of an incomplete message, None between messages. Until it is complete, the library reads
        # all frames.
        self._fragments: bytearray | None = None

        # What a turn left over: messages, then bytes from an index on. While `_interrupted` is set, the socket is not
        # read; `_is_scheduled` is set while `_proceed` is scheduled to end that.
        self._postponed: list[bytes] = []
        self._interrupted: tuple[bytes, int] | None = None
        self._is_scheduled = False
        # Output that `together` holds back, or None outside of it.
        self._held: list[bytes] | None = None
        # True from a pong that the socket does not accept until it accepts data again: then a server does not read,
        # because each ping that it reads could cost memory for another pong.
        self._pongs_unread = False
        # Bytes caused by the peer since it last read something (`count_unread`); answers of the library count while
        # `_is_answering`.
        self._unread = 0
        self._is_answering = False

    # For the subclass to implement

    def handshake_received(self, event: Request | Response) -> None:
        """Handle the handshake message of the peer."""
        raise NotImplementedError

    def messages_received(self, messages: list[bytes]) -> None:
        """Handle whole messages, in order."""
        raise NotImplementedError

    def close_expected(self) -> None:
        """Start a timeout. If the peer has not ended the connection by then, the connection is aborted."""
        raise NotImplementedError

    def connection_ended(self, exc: Exception | None) -> None:
        """Handle the end of the connection."""
        raise NotImplementedError

    # State

    @property
    def is_connected(self) -> bool:
        """True once the socket was connected, even after the connection has ended."""
        return self._transport is not None

    @property
    def is_blocked(self) -> bool:
        """True if reading must stop, because the peer sends pings but does not read the pongs."""
        return self._pongs_unread

    @property
    def is_closing(self) -> bool:
        """True if there is no socket, or if the socket is closing."""
        return self._transport is None or self._transport.is_closing()

    # Sending

    def send(self, messages: Sequence[bytes]) -> None:
        """Write messages to an open connection: JSON in text frames, and a server's CBOR in binary frames."""
        data = self._encode(messages)
        if self._held is not None:
            self._held.append(data)
        elif self._transport is not None:
            self._transport.write(data)

    def count_unread(self, size: int) -> None:
        """Count `size` more bytes of answers, and abort the connection if the peer leaves too many bytes unread."""
        self._unread = self._unread + size if self.paused else 0
        if self.never_reads:
            self.abort()

    @property
    def never_reads(self) -> bool:
        """True if the connection was aborted because the peer left too many answers unread."""
        return self._unread > _MAX_UNREAD * self._max_size

    def ping(self) -> None:
        """Send a ping."""
        self._protocol.send_ping(b"")
        self._flush()

    def start_closing(self, code: CloseCode, reason: str = "") -> None:
        """Begin the closing handshake."""
        self._protocol.send_close(code, reason)
        self._flush()

    def abort(self) -> None:
        """End the connection at once."""
        self.is_open = False
        if self._transport is not None:
            self._transport.abort()

    async def drain(self) -> None:
        """Wait until the write buffer has room, or the connection has ended."""
        await self._writable.wait()

    async def wait_closed(self) -> None:
        """Wait until the connection has ended."""
        await self._lost.wait()

    @contextmanager
    def together(self) -> Iterator[None]:
        """Collect the output of a `with` block, and write it in one piece when the block ends."""
        if self._held is not None:
            yield
            return
        self._held = []
        try:
            yield
        finally:
            held, self._held = self._held, None
            if held and self._transport is not None and not self._transport.is_closing():
                self._transport.write(b"".join(held))
            self._flush()

    def _flush(self) -> None:
        """Write everything that the library has to send, and copy its state to `is_open`."""
        self.is_open = self._protocol.state is _OPEN
        if self._held is not None:
            return  # `together` does this at its end
        data = self._protocol.data_to_send()
        transport = self._transport
        if data and transport is not None and not transport.is_closing():
            if whole := b"".join(data):
                transport.write(whole)
                self._pongs_unread = self._is_server and self.paused
            if not data[-1]:
                # Closing both halves could lose the last frame on its way, but TLS cannot close one half.
                (transport.write_eof if transport.can_write_eof() else transport.close)()
            elif self._is_answering:
                self.count_unread(len(whole))

    # Calls of the event loop

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport."""
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(high=self._write_limit)

    def data_received(self, data: bytes) -> None:
        """Handle bytes from the socket.

        A message in a single frame is decoded directly. The websockets library decodes all other frames.
        """
        self.last_heard = time.monotonic()
        at = 0
        if self._rest:
            rest, missing = self._rest, self._wanted - len(self._rest)
            at = missing if 0 < missing < len(data) else len(data)
            rest += data if at == len(data) else data[:at]
            if len(rest) < self._wanted:
                return
            # Frames after the completed one, if any, follow in the same turn.
            begun = bytes(rest)
            rest.clear()
            # The frame alone, because copying what follows it would take longer than reading that.
            end = self._read(begun, 0)
            if end < len(begun):  # interrupted, or no longer quick
                data, at = begun[end:] + data[at:], 0
        elif self._quick and self._fragments is None:
            message = frames.only_message(data, masked=self._is_server, largest=self._max_size)
            if message is not None:  # the usual case, except in bursts
                self.messages_received([message])
                if self._postponed:
                    self._interrupt(b"", 0)
                return
        elif self._in_handshake:
            self._read_handshake(data)
            return
        self._read_turn(data, at)

    def eof_received(self) -> None:
        """End the connection in both directions when the peer has ended its own direction."""
        self._receive_eof()
        self._flush()

    def connection_lost(self, exc: Exception | None) -> None:
        """Report the end of the connection."""
        self._receive_eof()
        self.is_open = False
        self._lost.set()
        self._writable.set()
        self.connection_ended(exc)

    def pause_writing(self) -> None:
        """Make writers wait, because the write buffer is full."""
        self.paused = True
        self._writable.clear()

    def resume_writing(self) -> None:
        """Let writers continue."""
        self.paused = self._pongs_unread = False
        self._writable.set()
        self.proceed()

    # Reading

    def _read_handshake(self, data: bytes) -> None:
        """Pass the headers of an HTTP message to the library, and handle the data after the headers.

        This data is WebSocket frames or the body of the message.
        """
        self.first_bytes = (self.first_bytes + data)[:_FIRST_BYTES]
        before = self._handshake_tail
        end = (before + data).find(_END_OF_HEADERS)
        if end < 0:
            self._handshake_tail = (before + data)[-len(_END_OF_HEADERS) + 1 :]
            self._give_library(data)
            return
        at = end + len(_END_OF_HEADERS) - len(before)
        self._in_handshake = False
        self._give_library(data[:at])
        # A refusal may have a body, which is not a frame.
        self._quick = self.is_open
        if at < len(data):
            self._read_turn(data, at)

    def _read_turn(self, data: bytes, at: int) -> None:
        """Handle the bytes from index `at`, at most as many as one turn allows.

        The remaining bytes are handled after other tasks have run.
        """
        end = self._read(data, at)
        if end < len(data) or end - at >= self.turn_bytes or self._postponed or self.is_blocked:
            self._interrupt(data, end)

    def postpone(self, messages: list[bytes]) -> None:
        """Keep messages until other tasks have run. The messages are then handled before data that arrived later."""
        self._postponed = messages

    def _interrupt(self, data: bytes, at: int) -> None:
        """Stop reading until other tasks had their turn and reading is no longer blocked."""
        if not self.is_closing:
            # Otherwise asyncio would read more before the rest of this turn is handled.
            cast("asyncio.Transport", self._transport).pause_reading()
            self._interrupted = data, at
            self.proceed()

    def proceed(self) -> None:
        """Schedule the handling of the bytes left over from an interrupted turn. Other tasks run first.

        Nothing is scheduled while reading is blocked.
        """
        if self._interrupted is not None and not self._is_scheduled and not self.is_blocked:
            self._is_scheduled = True
            asyncio.get_running_loop().call_soon(self._proceed)

    def _proceed(self) -> None:
        self._is_scheduled = False
        if self._interrupted is None or self.is_closing or self.is_blocked:
            return
        (data, at), self._interrupted = self._interrupted, None
        cast("asyncio.Transport", self._transport).resume_reading()
        postponed, self._postponed = self._postponed, []
        if postponed:
            self.messages_received(postponed)
        self._read_turn(data, at)

    def _read(self, data: bytes, at: int) -> int:
        """Handle at most `turn_frames` frames and store an incomplete one; return the index at which to continue."""
        size, count, masked = len(data), 0, self._is_server
        while at < size and count < self.turn_frames:
            if self._postponed or self.is_blocked:
                break
            if not self._quick:
                end = min(at + self.slice_bytes, size)
                self._give_library(data[at:end])
                return end
            if self._fragments is None:
                messages, at = frames.whole_messages(
                    data, at, masked=masked, largest=self._max_size, count=self.turn_frames - count
                )
                if messages:
                    count += len(messages)
                    self.messages_received(messages)
                    continue
            end = frames.frame_end(
                data, at, masked=masked, largest=self._max_size - len(self._fragments or b"")
            )
            if end == frames.UNSOUND:
                self._quick = False  # the library refuses it before it has arrived completely
                self.refused = data[at : at + _BEGINNING]
            elif end == frames.UNKNOWN or end > size:
                self._rest += data[at:]
                self._wanted = end - at if end else 0
                at = size
            else:
                count += 1
                self._give_library(data[at:end])
                at = end
        return at

    def _give_library(self, data: bytes) -> None:
        """Pass bytes to the library, and handle the events."""
        self._protocol.receive_data(data)
        messages: list[bytes] = []
        for event in self._protocol.events_received():
            if not isinstance(event, Frame):
                self.handshake_received(event)
            elif event.opcode in _DATA_OPCODES and (message := self._assembled(event)) is not None:
                messages.append(message)
        if messages:
            self.messages_received(messages)
        self._is_answering = True
        self._flush()
        self._is_answering = False
        if not self.is_open:
            self._quick = False
        if not self._ends and self._protocol.close_expected():
            self._ends = True
            self.close_expected()

    def _assembled(self, frame: Frame) -> bytes | None:
        """Return the message that `frame` completes, or None if more frames of the message follow.

        The library limits the size of a message.
        """
        data = bytes(frame.data)
        if self._fragments is None:
            if frame.fin:
                return data
            self._fragments = bytearray()  # not a list, so that endless empty fragments do not take memory
        self._fragments += data
        if not frame.fin:
            return None
        whole, self._fragments = bytes(self._fragments), None
        return whole

    def _receive_eof(self) -> None:
        """Pass an incomplete frame and the end of the stream to the library."""
        self._quick = False
        if self._rest:
            self._protocol.receive_data(bytes(self._rest))
            self._rest.clear()
        self._protocol.receive_eof()
