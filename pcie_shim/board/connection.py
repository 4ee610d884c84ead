"""Connections to the two ports of a board: frames in order, refusals, and the proof of the key.

`pcie_shim.host.socket_link` shows the frames. If received bytes are not a frame, or if a frame is out of order, the
board sends ERROR BAD_FRAME and closes the connection. After all other refusals, the connection stays open.
"""

import hmac
import socket
import struct
import time
from collections.abc import Callable
from typing import Final

from pcie_shim import credentials, framing
from pcie_shim.board.emulated_board import RefusedError
from pcie_shim.endpoint import no_delay
from pcie_shim.errors import FramingError
from pcie_shim.framing import HEADER_BYTES, Frame, ProgramBegin
from pcie_shim.link_rate import LinkModel
from pcie_shim.register_layout import ALL_ONES
from pcie_shim.register_map import ErrorCode

SEND_S: Final = 5.0
"""If a host does not read the board's frames for this many seconds, the board closes the link."""
_TOGETHER: Final = 1 << 16
"""Answers to requests that arrived together are collected, and sent whenever they reach this many bytes."""
KEEPALIVE_S: Final = 5
"""Interval of TCP keep-alive probes in seconds. After three unanswered probes, the link is closed."""


class Connection:
    """A connection of a host or loader to the board. The board sends the first frame: a challenge or its greeting."""

    def __init__(
        self, connection: socket.socket, key: bytes, greeting: bytes, link: LinkModel | None = None
    ) -> None:
        """Send the first frame: a challenge if the board has a key, or else the greeting.

        If `link` is not None, this model of a slower link delays all frames.
        """
        no_delay(connection)
        if connection.family != socket.AF_UNIX:
            # a host whose machine or cable failed must not hold the board forever
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, KEEPALIVE_S)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, KEEPALIVE_S)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
        # reads never block, because epoll precedes them; writes may take SEND_S
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", int(SEND_S), 0))
        self.socket = connection
        self.decoder = framing.FrameDecoder()

        # The model of a slower link, and the monotonic time from which it delays the frames of the last receive: when
        # the first of them is decoded, so that the delay comes on top of the socket's; 0 before that.
        self._link = link
        self._sent_ns = 0

        # True while `answer` handles the requests that arrived together, and the frames that it will send at its end.
        self._answering = False
        self._unsent = bytearray()

        # Sequence number of the last request. Every request has the next one, so a lost or repeated one is noticed.
        self.sequence = 0

        # Cleared by whoever finds the connection unusable. The server then drops it; the socket is closed only there,
        # so that the descriptor cannot be another connection's while the server still knows it.
        self.open = True

        # The challenge that the peer has to answer before anything else; empty without a key, and after its proof.
        self._nonce = credentials.nonce() if key else b""
        self._key = key
        self._greeting = greeting
        if key:
            self.send(framing.encode(framing.AUTHENTICATE, 0, 0, 0, len(self._nonce) // 4, self._nonce))
        else:
            self.send(greeting)

    def receive(self) -> bool:
        """Read once, and return whether bytes arrived. If the connection is closed, `open` becomes False."""
        try:
            count = self.socket.recv_into(self.decoder.room(), 0, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            count = 0
        self.decoder.received(count)
        self._sent_ns = 0
        self.open = count > 0
        return self.open

    def answer(self, handle: Callable[[Frame], None]) -> None:
        """Pass all complete frames to `handle`. If `handle` raises a RefusedError, answer with an ERROR frame."""
        self._answering = True
        self._handle_all(handle)
        self._answering = False
        self._flush()

    def _handle_all(self, handle: Callable[[Frame], None]) -> None:
        while self.open:
            sequence = address = 0
            try:
                frame = self.decoder.next_frame()
                if frame is None:
                    return
                _, _, sequence, address, _, payload = frame
                if self._link is not None:
                    self._sent_ns = self._sent_ns or time.monotonic_ns()
                    self._link.carry(HEADER_BYTES + len(payload), self._sent_ns)
                self.sequence = due = (self.sequence + 1) & ALL_ONES
                if sequence == due:
                    (self._authenticate if self._nonce else handle)(frame)
                    continue
                problem = f"request {sequence} arrived instead of {due}"
            except FramingError as error:
                problem = str(error)
            except RefusedError as error:
                self.send(framing.encode_error(sequence, address, error.code, str(error)))
                continue
            # after this, the position in the stream and the peer's count are unknown
            self.send(framing.encode_error(sequence, address, ErrorCode.BAD_FRAME, problem))
            self.open = False

    def _authenticate(self, frame: Frame) -> None:
        """Check the peer's proof, and answer with the board's proof and the greeting."""
        answer = bytes(frame.payload)
        nonce, proof = answer[: credentials.NONCE_BYTES], answer[credentials.NONCE_BYTES :]
        expected = credentials.host_proof(self._key, self._nonce, nonce)
        if frame.operation != framing.AUTHENTICATE or not hmac.compare_digest(proof, expected):
            raise FramingError("the proof that this host has the board's key is missing or wrong")
        own = credentials.board_proof(self._key, self._nonce, nonce)
        self._nonce = b""
        reply = framing.encode(
            framing.AUTHENTICATE, framing.REPLY, frame.sequence, 0, credentials.PROOF_BYTES // 4, own
        )
        self.send(reply + self._greeting)

    def send(self, data: bytes) -> None:
        """Send bytes at once, or collect them while `answer` runs (see `_TOGETHER`).

        If the peer accepts nothing for `SEND_S`, the connection is closed.
        """
        self._unsent += data
        if not self._answering or len(self._unsent) >= _TOGETHER:
            self._flush()

    def _flush(self) -> None:
        data, self._unsent = self._unsent, bytearray()
        if not data:
            return
        if self._link is not None:
            self._link.carry(len(data), time.monotonic_ns())
        try:
            self.socket.sendall(data)
        except OSError:
            self.open = False


class HostConnection(Connection):
    """A host's connection to the register port. After this host's first request, other hosts are refused."""

    def __init__(
        self,
        connection: socket.socket,
        key: bytes,
        greeting: bytes,
        token: bytes,
        programmed: int,
        link: LinkModel | None,
    ) -> None:
        """Store the greeting's token (`token`) and the number of images loaded so far (`programmed`)."""
        super().__init__(connection, key, greeting, link)

        # A loader that shows this token may program the board although this host holds it: it is the same host.
        self.token = token

        # If the board's count has changed since, another image is loaded, and the host's knowledge of it is stale.
        self.programmed = programmed

        # Number of interrupts sent, which is the sequence number of the last one.
        self.interrupts = 0


class LoaderConnection(Connection):
    """A loader's connection to the programming port. After this loader's first request, other loaders are refused."""

    def __init__(self, connection: socket.socket, key: bytes, greeting: bytes) -> None:
        super().__init__(connection, key, greeting)

        # The announced file, from BEGIN until END, and its bytes so far: never more than `begin.size`.
        self.begin: ProgramBegin | None = None
        self.content = bytearray()

        # Monotonic time of the last frame; after a long silence another loader may have its turn.
        self.last_frame = time.monotonic()
