"""The link over a blocking socket (AF_UNIX or TCP): frames with sequence numbers and CRCs."""

from __future__ import annotations

import select
import socket
import struct
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NoReturn, Self

from pcie_shim import framing, register_map
from pcie_shim.endpoint import Endpoint, connect
from pcie_shim.errors import (
    AccessError,
    CrcError,
    DeviceGoneError,
    FramingError,
    GreetingMismatchError,
    HeldError,
    LinkClosedError,
    LinkError,
    LinkTimeoutError,
    SequenceError,
    ShortReadError,
    StaleHandleError,
)
from pcie_shim.host.link import ALL_ONES, LONGEST_POLL_S, Done, Link
from pcie_shim.register_map import ErrorCode

if TYPE_CHECKING:
    from collections.abc import Iterable
    from types import TracebackType

    from pcie_shim.framing import Frame, Octets
    from pcie_shim.host.link import RegisterWrite

_WORD: Final = struct.Struct("<I")
_DONE: Final = struct.Struct("<IIQQ")  # the registers DONE, STATUS, CYCLES and COMPUTE_NS
_DONE_WORDS: Final = _DONE.size // 4
_CLOSING_CODES: Final = (ErrorCode.STALE, ErrorCode.HELD, ErrorCode.BAD_FRAME)


class SocketLink(Link):
    """One open link; closes itself, and says why, once the stream cannot be trusted.

    Attributes:
        endpoint: Where the board listens.
        greeting: What the board said when the link opened.
        timeout: Seconds that an answer may take.
    """

    def __init__(self, endpoint: Endpoint, *, timeout: float, connect_timeout: float) -> None:
        """Connect and hear the greeting; use :meth:`open`, which also checks it."""
        self.endpoint = endpoint
        self.timeout = timeout
        self._closed = ""
        self._decoder = framing.FrameDecoder()
        self._sequence = 0
        self._interrupts = 0
        self._done: Done | None = None
        deadline = time.monotonic() + connect_timeout
        self._socket = connect(endpoint, timeout=connect_timeout)
        try:
            self._limit(connect_timeout)
            frame = self._receive(deadline, connect_timeout, "greet")
            self._limit(timeout)
            if frame.operation == framing.ERROR:
                self._refused(frame)
            self.greeting = framing.decode_greeting(frame)
            self.token = self.greeting.token
        except LinkError as error:
            self._give_up(error)

    @classmethod
    def open(cls, endpoint: Endpoint, *, timeout: float, connect_timeout: float | None = None) -> Self:
        """A link to a board that speaks this protocol and has this register map.

        Args:
            endpoint: The board's registers, or its programming port.
            timeout: Seconds for each answer.
            connect_timeout: Seconds for the board to listen and greet; None: as ``timeout``.

        Raises:
            UnreachableError: Nothing listens there.
            HeldError: Another host holds the board.
            GreetingMismatchError: It has another protocol version, register map or BAR size.
            LinkError: It does not greet, or is no board.
        """
        link = cls(
            endpoint, timeout=timeout, connect_timeout=timeout if connect_timeout is None else connect_timeout
        )
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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def is_open(self) -> bool:
        """Whether the link can be used."""
        return not self._closed

    def fileno(self) -> int:
        """The socket's descriptor, for a poll over many links."""
        return self._socket.fileno()

    def close(self, reason: str = "it was closed") -> None:
        """End the link; what is used afterwards raises :class:`LinkClosedError` with this reason."""
        if not self._closed:
            self._closed = reason
            self._socket.close()

    # ---- registers ------------------------------------------------------------------------------------

    def read32(self, address: int) -> int:
        """One register.

        Raises:
            DeviceGoneError: The ID register reads all ones.
            AccessError: The board refused the address.
            LinkError: The link broke; it is closed.
        """
        (value,) = _WORD.unpack(self.read_block(address, 1))
        if value == ALL_ONES and address == register_map.ID:
            self._give_up(
                DeviceGoneError(f"The ID of the board at {self.endpoint} reads all ones: no device answers")
            )
        return int(value)

    def write32(self, address: int, value: int) -> None:
        """Write one register and wait until the board has taken it.

        Raises:
            AccessError: The board refused the address or the value.
            LinkError: The link broke; it is closed.
        """
        self.write_block(address, _WORD.pack(value))

    def read_block(self, address: int, count: int) -> bytes:
        """``count`` words from ``address`` on, as little-endian bytes.

        Raises:
            ShortReadError: Fewer or more words came; the link is closed.
            AccessError: The board refused the address or the length.
            LinkError: The link broke; it is closed.
        """
        frame = self.request(framing.READ, 0, address, count)
        if frame.words != count:
            self._give_up(
                ShortReadError(
                    f"The board at {self.endpoint} answered a read of {count} words at {address:#06x} with "
                    f"{frame.words}: the link is closed"
                )
            )
        return bytes(frame.payload)

    def write_block(self, address: int, words: Octets) -> None:
        """Write little-endian words from ``address`` on and wait until the board has taken them.

        Raises:
            AccessError: The board refused the address, the length or a value.
            LinkError: The link broke; it is closed.
        """
        self.request(framing.WRITE, 0, address, len(words) // 4, words)

    def wait_done(self, number: int, *, timeout: float) -> Done:
        """Wait until the board has stopped after start or resume ``number``; needs CONTROL.INTERRUPT_ENABLE.

        Raises:
            AccessError: The board refused the start, or a write posted before it.
            LinkTimeoutError: It did not stop in time; the link is closed.
            LinkError: The link broke; it is closed.
        """
        deadline = time.monotonic() + timeout
        what = f"say done number {number}"
        while (done := self.take_done()) is None:
            self._wait_readable(deadline, timeout, what)
            self._receive_some()
        if done.number != number:
            self._give_up(
                SequenceError(
                    f"The board at {self.endpoint} said done number {done.number} where {number} was due: "
                    "the link is closed"
                )
            )
        return done

    # ---- for a host that drives many boards -----------------------------------------------------------

    def post(self, writes: Iterable[RegisterWrite]) -> None:
        """Send posted writes; a refusal is raised where the next answer or interrupt is taken.

        Raises:
            LinkError: The link broke; it is closed.
        """
        self._send(b"".join(self._posted(framing.WRITE, address, words) for address, words in writes))

    def post_part(self, offset: int, part: Octets) -> None:
        """Send a part of a programming file, which begins at this offset, without waiting; errors as `post`."""
        self._send(self._posted(framing.PROGRAM, offset, part))

    def _posted(self, operation: int, address: int, words: Octets) -> bytes:
        self._sequence = (self._sequence + 1) & ALL_ONES
        return framing.encode(operation, framing.POSTED, self._sequence, address, len(words) // 4, words)

    def _send(self, frames: bytes) -> None:
        self._check_open()
        try:
            self._socket.sendall(frames)
        except OSError as error:
            self._broken_send(error)

    def receive_done(self) -> Done | None:
        """Receive once (after a poll said that something is there); what the board said, if it is whole.

        Raises:
            AccessError: The board refused a posted write.
            LinkError: The link broke; it is closed.
        """
        self._receive_some()
        return self.take_done()

    def take_done(self) -> Done | None:
        """What the board said, if it has come; None if it has not.

        Raises:
            AccessError: The board refused a posted write.
            LinkError: The link broke; it is closed.
        """
        if self._done is not None:
            done, self._done = self._done, None
            return done
        self._check_open()
        try:
            frame = self._decoder.next_frame()
        except FramingError as error:
            self._give_up(error)
        if frame is None or frame.operation == framing.IRQ:
            return None if frame is None else self._interrupt(frame)
        if frame.operation == framing.ERROR:
            self._refused(frame)
        return self._give_up(SequenceError("an answer came that nobody asked for"))

    def request(self, operation: int, flags: int, address: int, count: int, payload: Octets = b"") -> Frame:
        """Send one request and wait for its answer; an interrupt that comes before it is kept.

        Returns:
            The reply; its payload is valid until the link receives again.

        Raises:
            AccessError: The board refused.
            LinkError: The link broke; it is closed.
        """
        self._sequence = sequence = (self._sequence + 1) & ALL_ONES
        self._send(framing.encode(operation, flags, sequence, address, count, payload))
        deadline = time.monotonic() + self.timeout
        while True:
            try:
                frame = self._receive(deadline, self.timeout, f"answer about {address:#06x}")
            except LinkError as error:
                self._give_up(error)
            if frame.operation == framing.IRQ:
                done = self._interrupt(frame)
                self._done = done._replace(results=memoryview(bytes(done.results)))
            elif frame.operation == framing.ERROR:
                self._refused(frame)
            elif frame.sequence == sequence and frame.operation == operation and frame.flags & framing.REPLY:
                return frame
            else:
                self._give_up(SequenceError(f"answer {frame.sequence} came where answer {sequence} was due"))

    # ---- receiving ------------------------------------------------------------------------------------

    def _receive(self, deadline: float, timeout: float, what: str) -> Frame:
        """The next frame, whatever it is; the socket's own limit bounds each receive."""
        while (frame := self._decoder.next_frame()) is None:
            if time.monotonic() > deadline:
                raise self.late(timeout, what)
            try:
                count = self._socket.recv_into(self._decoder.room())
            except BlockingIOError:
                raise self.late(timeout, what) from None
            except OSError as error:
                raise self._gone(error.strerror or str(error)) from error
            if count == 0:
                raise self._gone("it closed the link")
            self._decoder.received(count)
        return frame

    def _receive_some(self) -> None:
        self._check_open()
        try:
            count = self._socket.recv_into(self._decoder.room())
        except BlockingIOError:
            return
        except OSError as error:
            self._give_up(self._gone(error.strerror or str(error)))
        if count == 0:
            self._give_up(self._gone("it closed the link"))
        self._decoder.received(count)

    def _wait_readable(self, deadline: float, timeout: float, what: str) -> None:
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        while (remaining := deadline - time.monotonic()) > 0:
            if poll.poll(min(remaining, LONGEST_POLL_S) * 1000):
                return
        self._give_up(self.late(timeout, what))

    def _interrupt(self, frame: Frame) -> Done:
        if frame.words < _DONE_WORDS:
            self._give_up(
                ShortReadError(
                    f"The board at {self.endpoint} sent an interrupt of {frame.words} words: the link is closed"
                )
            )
        self._interrupts = (self._interrupts + 1) & ALL_ONES
        if frame.sequence != self._interrupts:
            self._give_up(
                SequenceError(f"interrupt {frame.sequence} came where interrupt {self._interrupts} was due")
            )
        number, status, cycles, compute_ns = _DONE.unpack_from(frame.payload)
        if number == status == ALL_ONES:
            self._give_up(
                DeviceGoneError(
                    f"The registers of the board at {self.endpoint} read all ones: no device answers"
                )
            )
        return Done(number, status, cycles, compute_ns, frame.payload[_DONE.size :])

    # ---- failing --------------------------------------------------------------------------------------

    def _refused(self, frame: Frame) -> NoReturn:
        """Raise what an ERROR frame says; after some codes the link is of no use any more."""
        try:
            code, detail = framing.decode_error(frame)
        except FramingError as error:
            self._give_up(error)
        name = ErrorCode(code).name if code in ErrorCode.__members__.values() else f"code {code}"
        sentence = f"The board at {self.endpoint} refused access to {frame.address:#06x} ({name}): {detail}"
        if code in _CLOSING_CODES:
            self.close(f"the board said {name}")
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
        if isinstance(error, BlockingIOError):
            self._give_up(self.late(self.timeout, "take what was written"))
        # A board that closes says why first: that word may be waiting.
        frame = None
        with suppress(LinkError):
            deadline = time.monotonic() + self.timeout
            while (frame := self._receive(deadline, self.timeout, "")).operation != framing.ERROR:
                pass
        if frame is not None and frame.operation == framing.ERROR:
            self.close("the board closed it")
            self._refused(frame)
        self._give_up(self._gone(error.strerror or str(error)))

    def late(self, timeout: float, what: str) -> LinkTimeoutError:
        """The error that says that the board did not (do) ``what`` within ``timeout`` seconds."""
        rest = ": a frame began and did not end" if self._decoder.inside_frame else ""
        return LinkTimeoutError(
            f"The board at {self.endpoint} did not {what} within {timeout:.3g} s{rest}: the link is closed"
        )

    def _gone(self, reason: str) -> LinkClosedError:
        return LinkClosedError(f"The board at {self.endpoint} is gone: {reason}")

    def _give_up(self, error: LinkError) -> NoReturn:
        """Close the link, and raise the error that says why."""
        if type(error) in {FramingError, CrcError, SequenceError}:
            # the decoder knows no endpoint
            text = str(error)
            if str(self.endpoint) not in text:
                error = type(error)(f"The link to the board at {self.endpoint} is broken and closed: {text}")
        self.close(str(error))
        raise error

    def _check_open(self) -> None:
        if self._closed:
            raise LinkClosedError(f"The link to the board at {self.endpoint} is closed: {self._closed}")

    def _limit(self, seconds: float) -> None:
        """Let the kernel bound every blocking call: cheaper than Python's own time-outs, a system call each."""
        # of 0 microseconds the kernel makes no limit at all
        value = struct.pack("@ll", *divmod(max(1, round(seconds * 1e6)), 10**6))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, value)
