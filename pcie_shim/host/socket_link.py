"""The link to a board over a blocking socket (AF_UNIX or TCP): frames with sequence numbers and CRCs.

    host                                              board
      │◀─ GREET: map, image, token ─────────────────────│   after AUTHENTICATE, if there is a key
      │── READ 1 ──────────────────────────────────────▶│
      │◀─ reply 1 ──────────────────────────────────────│
      │── WRITE 2, POSTED: settings and sensors ───────▶│   no reply
      │── WRITE 3, POSTED: RUN_UNTIL and the doorbell ─▶│
      │◀─ IRQ 1: DONE, STATUS, CYCLES, COMPUTE_NS ──────│   IRQs have their own numbers; results may follow
      │◀─ ERROR 3 ──────────────────────────────────────│   instead of the IRQ, if write 3 was refused

A host with one board reads, writes and waits. A host with many boards posts to each board, polls the
descriptors of all links, and receives the frames that have arrived. Every method may raise a `LinkError`.
If the board refused an access, the error is an `AccessError`, and the link stays open. After any other
`LinkError`, the link is broken and closed.
"""

import hmac
import select
import socket
import struct
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Final, NamedTuple, NoReturn, Self, TypeAlias

from pcie_shim import credentials, framing, register_map
from pcie_shim.endpoint import Endpoint, connect
from pcie_shim.errors import (
    AccessError,
    CrcError,
    DeviceGoneError,
    FramingError,
    GreetingMismatchError,
    HeldError,
    KeyRefusedError,
    LinkClosedError,
    LinkError,
    LinkTimeoutError,
    SequenceError,
    ShortReadError,
    StaleHandleError,
)
from pcie_shim.framing import Frame, Octets
from pcie_shim.register_layout import ALL_ONES, DONE_BLOCK, WORD, field_of
from pcie_shim.register_map import ErrorCode

LONGEST_POLL_S: Final = 3600.0
"""Maximum duration of a single wait in seconds, because poll expects milliseconds in 31 bits."""

RegisterWrite: TypeAlias = "tuple[int, Octets]"
"""An address of the register map in bytes, and the little-endian words to write from that address on."""


class Done(NamedTuple):
    """The answer of a board when its machine has stopped.

    Attributes:
        number: Doorbell number of the start or resume that has ended.
        status: Value of the STATUS register.
        cycles: Number of cycles run in this frame.
        compute_ns: Computing time since the start or resume, in nanoseconds.
        results: Words of the blocks in `UsedRegisters.answer`, RESULTS first. The attribute is empty if the board does
            not send results. The bytes are valid until the link receives again.
    """

    number: int
    status: int
    cycles: int
    compute_ns: int
    results: memoryview

    @property
    def state(self) -> int:
        """State of the board: the field STATUS.STATE."""
        return field_of(register_map.STATUS_STATE_MASK, self.status)

    @property
    def reason(self) -> int:
        """Stop reason: the field STATUS.STOP_REASON."""
        return field_of(register_map.STATUS_STOP_REASON_MASK, self.status)


_ENDS_S: Final = 1.0
"""Over a network, a board may take this many seconds to notice that this host's previous link has ended."""
_RETRY_S: Final = 0.02
_CLOSING_CODES: Final = (ErrorCode.STALE, ErrorCode.HELD, ErrorCode.BAD_FRAME)


class SocketLink:
    """An open link over a socket.

    After an overdue answer or a damaged frame, the link closes itself, because later data cannot be trusted.
    """

    def __init__(self, endpoint: Endpoint, *, timeout: float, connect_timeout: float) -> None:
        """Connect and receive the greeting. Call `open` instead, because it also checks the greeting."""
        self.endpoint = endpoint
        self.timeout = timeout
        """Maximum time in seconds for an answer of the board, and for accepting data."""

        # Why the link was closed, which later calls report; empty while it is open.
        self._closed = ""

        # Numbers of the last request and of the last interrupt. Both ends count, so that a lost or repeated frame is
        # noticed, and an answer is known to be that of its request.
        self._sequence = 0
        self._interrupts = 0

        # The buffer of received bytes. Payloads are views of it, which the next receive overwrites.
        self._decoder = framing.FrameDecoder()

        # Bytes of all frames in both directions, and transfers: frames that were sent together count once.
        self.bytes_moved = self.transfers = 0

        # Read requests whose answers `answers` will return: sequence number, address and number of words, in order.
        self._asked: list[tuple[int, int, int]] = []

        # An interrupt that came while a request waited for its answer, with a copy of its results, until it is taken.
        self._done: Done | None = None

        deadline = time.monotonic() + connect_timeout
        self._socket = connect(endpoint, timeout=connect_timeout)
        # polls of this descriptor alone
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self._writable.register(self._socket, select.POLLOUT)
        try:
            self._limit(connect_timeout)
            frame = self._receive(deadline, connect_timeout, "greet")
            self._limit(timeout)
            if endpoint.host:
                frame = self._authenticate(frame, deadline, connect_timeout)
            if frame.operation == framing.ERROR:
                self._refused(frame)
            self.greeting = framing.decode_greeting(frame)
            # the token proves to the programming port that its owner holds this link
            self.token = self.greeting.token
        except LinkError as error:
            self._give_up(error)

    def _authenticate(self, frame: Frame, deadline: float, connect_timeout: float) -> Frame:
        """If there is a key, check that host and board have the same key. Return the board's greeting.

        Raises:
            KeyRefusedError: The keys differ, or only the host or only the board has a key.
        """
        key = self.endpoint.key
        if frame.operation != framing.AUTHENTICATE:
            if key and frame.operation == framing.GREET:
                raise KeyRefusedError(
                    f"The board at {self.endpoint} does not ask for the key: start it with the same --key-file, or unset the host's"
                )
            return frame
        if not key:
            raise KeyRefusedError(
                f"The board at {self.endpoint} expects a key: give the file with --key-file or BM_KEY_FILE"
            )
        board_nonce, host_nonce = bytes(frame.payload), credentials.nonce()
        proof = credentials.host_proof(key, board_nonce, host_nonce)
        payload = host_nonce + proof
        try:
            reply = self.request(framing.AUTHENTICATE, 0, 0, len(payload) // 4, payload)
        except (AccessError, LinkClosedError):
            reply = None
        expected = credentials.board_proof(key, board_nonce, host_nonce)
        if reply is None or not hmac.compare_digest(bytes(reply.payload), expected):
            raise KeyRefusedError(
                f"The board at {self.endpoint} has another key: give both sides the same file"
            )
        return self._receive(deadline, connect_timeout, "greet")

    @classmethod
    def open(cls, endpoint: Endpoint, *, timeout: float, connect_timeout: float | None = None) -> Self:
        """Open a link to a board that has this protocol version and register map.

        The board must greet within `connect_timeout` seconds (default: `timeout`), and answer within `timeout` seconds.

        Raises:
            LinkUnreachableError: No board listens at the endpoint.
            HeldError: Another host holds the board.
            KeyRefusedError: Host and board do not have the same key.
            GreetingMismatchError: The board has another protocol version, register map or BAR size.
            LinkError: The peer does not greet, or is not a board.
        """
        # the greeting is only what the board says; `DrivenBoard` compares the registers, too
        link = cls._opened(endpoint, timeout, timeout if connect_timeout is None else connect_timeout)
        greeting = link.greeting
        for what, theirs, ours in (
            ("protocol version", greeting.protocol_version, framing.PROTOCOL_VERSION),
            ("register map", greeting.map_hash, register_map.MAP_SHA256),
            ("BAR size", greeting.bar_size, register_map.BAR_SIZE),
        ):
            if theirs != ours:
                link.close()
                raise GreetingMismatchError(
                    f"The board at {endpoint} has {what} {theirs}, this software has {ours}: "
                    "use a board and a host of the same version"
                )
        return link

    @classmethod
    def _opened(cls, endpoint: Endpoint, timeout: float, connect_timeout: float) -> Self:
        deadline = time.monotonic() + (_ENDS_S if endpoint.host else 0.0)
        while True:
            try:
                return cls(endpoint, timeout=timeout, connect_timeout=connect_timeout)
            except HeldError:
                # the board may be held by this host's previous link, whose end it has not noticed yet
                if time.monotonic() >= deadline:
                    raise
                time.sleep(_RETRY_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the socket's descriptor for a poll over many links, or -1 if the link has ended."""
        return self._socket.fileno()

    def close(self, reason: str = "it was closed") -> None:
        """End the link. Later calls raise a LinkClosedError with this reason."""
        if not self._closed:
            self._closed = reason
            self._socket.close()

    # ---- registers ------------------------------------------------------------------------------------

    def read32(self, address: int) -> int:
        """Read one register. Raises a DeviceGoneError if the register is ID and reads all ones."""
        (value,) = WORD.unpack(self.read_block(address, 1))
        if value == ALL_ONES and address == register_map.ID:
            self._give_up(
                DeviceGoneError(f"The ID of the board at {self.endpoint} reads all ones: no device answers")
            )
        return int(value)

    def write32(self, address: int, value: int) -> None:
        """Write one register and wait for the acknowledgement."""
        self.write_block(address, WORD.pack(value))

    def read_block(self, address: int, count: int) -> bytes:
        """Read `count` little-endian words from `address` on. If fewer or more words arrive, raise a ShortReadError."""
        self.ask([(address, count)])
        return self.answers()[0]

    def write_block(self, address: int, words: Octets) -> None:
        """Write little-endian words from `address` on and wait for the acknowledgement."""
        self.request(framing.WRITE, 0, address, len(words) // 4, words)

    # ---- for a host that drives many boards -----------------------------------------------------------

    def ask(self, blocks: Iterable[tuple[int, int]]) -> None:
        """Request blocks of words without waiting; `answers` returns the words.

        A block is an address and a number of words.
        """
        requests = []
        for address, count in blocks:
            self._sequence = (self._sequence + 1) & ALL_ONES
            self._asked.append((self._sequence, address, count))
            requests.append(framing.encode(framing.READ, 0, self._sequence, address, count))
        self._send(b"".join(requests))

    def answers(self) -> list[bytes]:
        """Return, in order, each block that `ask` has requested, with the format and errors of `read_block`.

        After an AccessError, the caller must close the link, because answers to later requests may still arrive.
        """
        asked, self._asked = self._asked, []
        blocks = []
        for sequence, address, count in asked:
            frame = self._answer(framing.READ, sequence, address)
            if frame.words != count:
                self._give_up(
                    ShortReadError(
                        f"The board at {self.endpoint} answered a read of {count} words at {address:#06x} with "
                        f"{frame.words}: the link is closed"
                    )
                )
            blocks.append(bytes(frame.payload))
        self.transfers += 1
        return blocks

    def post(self, writes: Iterable[RegisterWrite]) -> None:
        """Send writes without waiting for replies. If the board refuses a write, the next receive raises the error."""
        self._send(b"".join(self._posted(framing.WRITE, address, words) for address, words in writes))

    def post_part(self, offset: int, part: Octets) -> None:
        """Send the part of a programming file that begins at `offset`, without waiting for an answer.

        If the board refuses the part, receiving the next answer raises the error.
        """
        self._send(self._posted(framing.PROGRAM, offset, part))

    def _posted(self, operation: int, address: int, words: Octets) -> bytes:
        self._sequence = (self._sequence + 1) & ALL_ONES
        return framing.encode(operation, framing.POSTED, self._sequence, address, len(words) // 4, words)

    def _send(self, frames: bytes) -> None:
        self._check_open()
        self.bytes_moved += len(frames)
        self.transfers += 1
        left, deadline = memoryview(frames), time.monotonic() + self.timeout
        while left:
            try:
                left = left[self._socket.send(left) :]
            except BlockingIOError:
                # the buffer is full, and uvloop may have made the descriptor non-blocking, as for `_receive`
                wait = max(0.0, deadline - time.monotonic())
                if not wait or not self._writable.poll(1000 * wait):
                    self._give_up(self.timeout_error(self.timeout, "accept the data"))
            except OSError as error:
                self._broken_send(error)

    def receive_done(self) -> Done | None:
        """After a poll, receive once. Return the board's answer if it is now complete, otherwise None."""
        self._check_open()
        try:
            self._fill()
        except LinkClosedError as error:
            self._give_up(error)
        return self.take_done()

    def take_done(self) -> Done | None:
        """Return the board's answer if it has been received completely, otherwise None."""
        if self._done is not None:
            done, self._done = self._done, None
            return done
        self._check_open()
        try:
            frame = self._next_frame()
        except FramingError as error:
            self._give_up(error)
        if frame is None or frame.operation == framing.IRQ:
            return None if frame is None else self._interrupt(frame)
        if frame.operation == framing.ERROR:
            self._refused(frame)
        return self._give_up(SequenceError("an answer arrived without a request"))

    def request(self, operation: int, flags: int, address: int, count: int, payload: Octets = b"") -> Frame:
        """Send one request, and return the board's answer. If an interrupt arrives first, store it for `take_done`.

        The payload of the answer is valid until the link receives again.
        """
        self._sequence = sequence = (self._sequence + 1) & ALL_ONES
        self._send(framing.encode(operation, flags, sequence, address, count, payload))
        frame = self._answer(operation, sequence, address)
        self.transfers += 1
        return frame

    def _answer(self, operation: int, sequence: int, address: int) -> Frame:
        deadline = time.monotonic() + self.timeout
        while True:
            try:
                frame = self._receive(deadline, self.timeout, f"answer about {address:#06x}")
            except LinkError as error:
                self._give_up(error)
            if frame.operation == framing.IRQ:
                # copied, because the next receive overwrites the buffer
                done = self._interrupt(frame)
                self._done = done._replace(results=memoryview(bytes(done.results)))
            elif frame.operation == framing.ERROR:
                self._refused(frame)
            elif frame.sequence == sequence and frame.operation == operation and frame.flags & framing.REPLY:
                return frame
            else:
                self._give_up(SequenceError(f"answer {frame.sequence} arrived instead of {sequence}"))

    # ---- receiving ------------------------------------------------------------------------------------

    def _receive(self, deadline: float, timeout: float, what: str) -> Frame:
        """Return the next frame of any kind; after the deadline, raise `timeout_error(timeout, what)`."""
        while (frame := self._next_frame()) is None:
            left = deadline - time.monotonic()
            # an event loop that watches the descriptor may have made it non-blocking (uvloop does)
            if left <= 0 or not self._readable.poll(1000 * left):
                raise self.timeout_error(timeout, what)
            self._fill()
        return frame

    def _next_frame(self) -> Frame | None:
        frame = self._decoder.next_frame()
        if frame is not None:
            self.bytes_moved += framing.HEADER_BYTES + len(frame.payload)
        return frame

    def _fill(self) -> None:
        """Receive once into the decoder, without waiting; nothing happens if no data has arrived."""
        try:
            count = self._socket.recv_into(self._decoder.room())
        except BlockingIOError:
            return
        except OSError as error:
            raise self._closed_error(error.strerror or str(error)) from error
        if count == 0:
            raise self._closed_error("it closed the link")
        self._decoder.received(count)

    def _interrupt(self, frame: Frame) -> Done:
        if frame.words < DONE_BLOCK.size // 4:
            self._give_up(
                ShortReadError(
                    f"The board at {self.endpoint} sent an interrupt of {frame.words} words: the link is closed"
                )
            )
        self.transfers += 1
        self._interrupts = (self._interrupts + 1) & ALL_ONES
        if frame.sequence != self._interrupts:
            self._give_up(SequenceError(f"interrupt {frame.sequence} arrived instead of {self._interrupts}"))
        number, status, cycles, compute_ns = DONE_BLOCK.unpack_from(frame.payload)
        if number == status == ALL_ONES:
            self._give_up(
                DeviceGoneError(
                    f"The registers of the board at {self.endpoint} read all ones: no device answers"
                )
            )
        return Done(number, status, cycles, compute_ns, frame.payload[DONE_BLOCK.size :])

    # ---- failing --------------------------------------------------------------------------------------

    def _refused(self, frame: Frame) -> NoReturn:
        """Raise the error in an ERROR frame, after closing the link for some codes."""
        try:
            code, detail = framing.decode_error(frame)
        except FramingError as error:
            self._give_up(error)
        name = ErrorCode(code).name if code in ErrorCode.__members__.values() else f"code {code}"
        sentence = f"The board at {self.endpoint} refused access to {frame.address:#06x} ({name}): {detail}"
        if code in _CLOSING_CODES:
            self.close(f"the board answered {name}")
        if code == ErrorCode.HELD:
            raise HeldError(f"The board at {self.endpoint} is held: {detail}", code=code, detail=detail)
        if code == ErrorCode.STALE:
            raise StaleHandleError(
                f"The handle of the board at {self.endpoint} is stale: {detail}; open the board again",
                code=code,
                detail=detail,
            )
        raise AccessError(sentence, code=code, detail=detail)

    def _broken_send(self, error: OSError) -> NoReturn:
        # A board sends the reason before it closes: an ERROR may be in the buffer.
        frame = None
        # what came before it does not matter any more
        with suppress(LinkError):
            deadline = time.monotonic() + self.timeout
            while (frame := self._receive(deadline, self.timeout, "")).operation != framing.ERROR:
                pass
        if frame is not None and frame.operation == framing.ERROR:
            self.close("the board closed it")
            self._refused(frame)
        self._give_up(self._closed_error(error.strerror or str(error)))

    def timeout_error(self, timeout: float, what: str) -> LinkTimeoutError:
        """Return the error for a board that did not do `what` (a verb phrase) within `timeout` seconds."""
        rest = ": a frame is incomplete" if self._decoder.inside_frame else ""
        return LinkTimeoutError(
            f"The board at {self.endpoint} did not {what} within {timeout:.3g} s{rest}: the link is closed"
        )

    def _closed_error(self, reason: str) -> LinkClosedError:
        return LinkClosedError(f"The board at {self.endpoint} is gone: {reason}")

    def _give_up(self, error: LinkError) -> NoReturn:
        """Close the link, and raise the error."""
        if not self._closed and type(error) in {FramingError, CrcError, SequenceError}:
            # the error of the decoder does not name the endpoint
            error = type(error)(f"The link to the board at {self.endpoint} is broken and closed: {error}")
        self.close(str(error))
        raise error

    def _check_open(self) -> None:
        if self._closed:
            raise LinkClosedError(f"The link to the board at {self.endpoint} is closed: {self._closed}")

    def _limit(self, seconds: float) -> None:
        """Set the socket's timeouts in the kernel, because each of Python's timeouts would cost a system call."""
        # 0 microseconds would mean no limit
        value = struct.pack("@ll", *divmod(max(1, round(seconds * 1e6)), 10**6))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, value)
