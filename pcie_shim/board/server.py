"""The server of a board: one thread that serves the registers to one host at a time, and a loader.

The loop polls its sockets between two chunks of the machine, so a reset, a second host or the end of the
process never waits longer than one chunk. When a host disconnects, the board is free for the next one. A host
that violates the protocol gets an ERROR, and its link is closed.
"""

import hashlib
import hmac
import logging
import os
import select
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

from pcie_shim import credentials, framing, register_map
from pcie_shim.board.board import Board
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.board.misbehaviour import Misbehaviour, MisbehaviourKind
from pcie_shim.endpoint import Endpoint, listen, no_delay, parse_endpoint, remove_listener
from pcie_shim.errors import FramingError
from pcie_shim.framing import Frame, ProgramBegin
from pcie_shim.programming_file import MAX_IMAGE_BYTES
from pcie_shim.register_layout import ALL_ONES
from pcie_shim.register_map import ErrorCode

_LOG: Final = logging.getLogger(__name__)

SEND_S: Final = 5.0
"""Seconds after which the link of a host that does not read the board's frames is closed."""
KEEPALIVE_S: Final = 5
"""Interval of TCP keep-alive probes in seconds; three unanswered ones close the link.
"""
PROGRAMMING_SILENCE_S: Final = 10.0
"""Seconds without a frame of the loader after which another loader may program the board."""

MAX_SILENT: Final = 16
"""Maximum number of connections without a request per port; a new one replaces the oldest.
"""

_HELD: Final = "another host holds it; only one host can drive a board at a time"
_PROGRAMMED: Final = "another loader is programming it"
_READABLE: Final = select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR


class StopSignal:
    """Stop request for `serve_board`, from a signal handler or a thread; create it after a fork."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    def set(self) -> None:
        """Request the end; may be called in a signal handler and repeatedly."""
        with suppress(OSError):
            os.write(self._write, b"x")

    def fileno(self) -> int:
        """Return a descriptor that is readable once `set` was called."""
        return self._read

    def close(self) -> None:
        """Close the descriptors."""
        os.close(self._read)
        os.close(self._write)


def serve_board(
    endpoint: Endpoint | str,
    *,
    index: int,
    stop: StopSignal,
    board: Board | None = None,
    misbehave: Misbehaviour | None = None,
    pin: bool = True,
    on_ready: Callable[[Board], None] | None = None,
) -> None:
    """Serve one board, initially blank, until `stop` is set; then remove the socket files.

    Args:
        endpoint: Endpoint of the registers; `Endpoint.programming` is the programming port.
        index: Number of the board, for the greeting.
        stop: Ends the loop.
        board: The board; None for an emulated one.
        misbehave: The fault of an emulated board, for tests of hosts.
        pin: Pin this thread to one of its allowed cores, number `index` modulo their number. Boards compute
            for tenths of a millisecond, too short for Linux to distribute the threads woken by one host over
            the cores: without pinning, the boards of a mini-cluster would compute one after the other. The
            thread also gets the policy SCHED_BATCH, so that it does not preempt others when it wakes.
        on_ready: Called with the board when both sockets are listening.

    Raises:
        EndpointError: The endpoint is invalid or in use.
    """
    where = parse_endpoint(endpoint) if isinstance(endpoint, str) else endpoint
    if pin:
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[index % len(cores)]})
        # a board that wakes must not preempt the host, which has other boards to start
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    registers = listen(where)
    try:
        programming = listen(where.programming)
    except BaseException:
        remove_listener(where, registers)
        raise
    try:
        server = _Server(where, registers, programming, index, stop, board or EmulatedBoard(), misbehave)
        if on_ready is not None:
            on_ready(server.board)
        server.run()
    finally:
        remove_listener(where, registers)
        remove_listener(where.programming, programming)


class _Connection:
    """A host's or a loader's connection: a socket with frames, which begins with the board's challenge or greeting."""

    def __init__(self, connection: socket.socket, endpoint: Endpoint, greeting: bytes) -> None:
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
        self.sequence = 0
        self.open = True
        self.stalled = False
        self._key = endpoint.key if endpoint.host else b""
        self._greeting = greeting
        self._nonce = b""
        if self._key:
            self._nonce = credentials.nonce()
            self.send(
                framing.encode(framing.AUTHENTICATE, 0, 0, 0, credentials.NONCE_BYTES // 4, self._nonce)
            )
        else:
            self.send(greeting)

    def receive(self) -> bool:
        """Receive once; return False if nothing arrived or the connection is closed, which clears `open`."""
        try:
            count = self.socket.recv_into(self.decoder.room(), 0, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            count = 0
        self.decoder.received(count)
        self.open = count > 0
        return self.open

    def answer(self, handle: Callable[[Frame], None]) -> None:
        """Handle all complete frames, and answer refusals with ERROR."""
        while self.open and not self.stalled:
            sequence = address = 0
            try:
                frame = self.decoder.next_frame()
                if frame is None:
                    return
                _, _, sequence, address, _, _ = frame
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
            self.send(framing.encode_error(sequence, address, ErrorCode.BAD_FRAME, problem))
            self.open = False

    def _authenticate(self, frame: Frame) -> None:
        """Check the peer's proof, and answer with the board's and the greeting."""
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
        """Send all bytes; a connection that accepts none for SEND_S is closed."""
        try:
            self.socket.sendall(data)
        except OSError:
            self.open = False


class _Host(_Connection):
    """A link to a host, which holds the board from its first request on."""

    def __init__(
        self, connection: socket.socket, endpoint: Endpoint, greeting: bytes, token: bytes, programmed: int
    ) -> None:
        super().__init__(connection, endpoint, greeting)
        self.token = token
        self.programmed = programmed
        self.interrupts = 0


class _Loader(_Connection):
    """A connection to the programming port, which programs the board from its first request on."""

    def __init__(self, connection: socket.socket, endpoint: Endpoint, greeting: bytes) -> None:
        super().__init__(connection, endpoint, greeting)
        self.begin: ProgramBegin | None = None
        self.content = bytearray()
        self.last_frame = time.monotonic()


class _Server:
    """The loop over the stop signal, two listening sockets, a host and a loader."""

    def __init__(
        self,
        endpoint: Endpoint,
        registers: socket.socket,
        programming: socket.socket,
        index: int,
        stop: StopSignal,
        board: Board,
        misbehave: Misbehaviour | None,
    ) -> None:
        self._endpoint = endpoint
        self._registers = registers
        self._programming = programming
        self._index = index
        self._stop = stop
        self._misbehaviour = misbehave
        self._starts = 0
        self._faults = 0
        self._last_results = b""
        self.board = board
        self._host: _Host | None = None
        self._silent_hosts: dict[int, _Host] = {}
        self._loader: _Loader | None = None
        self._silent_loaders: dict[int, _Loader] = {}
        self._epoll = select.epoll()
        for descriptor in (stop.fileno(), registers.fileno(), programming.fileno()):
            self._epoll.register(descriptor, _READABLE)

    def run(self) -> None:
        board, epoll = self.board, self._epoll
        try:
            while True:
                computing = board.running and not board.stuck
                wait = 0.0 if computing else 1.0
                board.turned = time.monotonic()
                for descriptor, _ in epoll.poll(wait):
                    if descriptor == self._stop.fileno():
                        return
                    self._serve(descriptor)
                if board.running and not board.stuck:
                    board.step()
                    self._interrupt_if_done()
                    if self._host is not None and not self._host.open:
                        self._drop_host(self._host)
                self._drop_silent_loader()
        finally:
            for host in [*self._silent_hosts.values(), self._host]:
                if host is not None:
                    self._drop_host(host)
            for loader in [*self._silent_loaders.values(), self._loader]:
                if loader is not None:
                    self._drop_loader(loader)
            epoll.close()

    def _serve(self, descriptor: int) -> None:
        host, loader = self._host, self._loader
        if descriptor in self._silent_hosts:
            self._serve_host(self._silent_hosts[descriptor])
        elif host is not None and descriptor == host.socket.fileno():
            self._serve_host(host)
        elif descriptor in self._silent_loaders:
            self._serve_loader(self._silent_loaders[descriptor])
        elif loader is not None and descriptor == loader.socket.fileno():
            self._serve_loader(loader)
        elif descriptor == self._registers.fileno():
            self._accept_host()
        elif descriptor == self._programming.fileno():
            self._accept_loader()

    # ---- the host -------------------------------------------------------------------------------------

    def _accept_host(self) -> None:
        try:
            connection, _ = self._registers.accept()
        except OSError:
            return  # the peer has disconnected already
        if self._is_held():
            _refuse(connection, _HELD)
            return
        if len(self._silent_hosts) == MAX_SILENT:
            self._drop_host(next(iter(self._silent_hosts.values())))
        token = os.urandom(8)
        host = _Host(connection, self._endpoint, self._greeting(token), token, self.board.programmed)
        self._silent_hosts[host.socket.fileno()] = host
        self._epoll.register(host.socket.fileno(), _READABLE)

    def _is_held(self) -> bool:
        """Return whether a host holds the board, after handling the last frames of one that has disconnected."""
        host = self._host
        if host is None:
            return False
        if host.stalled:
            host.open = not _is_closed_by_peer(host.socket)
        while host.open and host.receive():
            host.answer(partial(self._access, host))
        if not host.open:
            self._drop_host(host)
        return self._host is not None

    def _serve_host(self, host: _Host) -> None:
        if host.stalled:
            # misbehaving: do not read the host's frames, but notice when it disconnects
            host.open = not _is_closed_by_peer(host.socket)
            time.sleep(0.01)
        else:
            host.receive()
            host.answer(partial(self._access, host))
        if not host.open:
            self._drop_host(host)

    def _greeting(self, token: bytes) -> bytes:
        map_hash = register_map.MAP_SHA256
        if self._misbehaves(MisbehaviourKind.WRONG_MAP):
            map_hash = hashlib.sha256(b"another map").hexdigest()
        return framing.encode_greeting(
            framing.Greeting(
                protocol_version=framing.PROTOCOL_VERSION,
                bar_size=register_map.BAR_SIZE,
                board=self._index,
                map_hash=map_hash,
                image_hash=self.board.image_hash,
                token=token,
            )
        )

    def _access(self, host: _Host, frame: Frame) -> None:
        """Handle a frame of a host, which then holds the board if it is free."""
        operation, flags, sequence, address, count, payload = frame
        board = self.board
        if host is not self._host:
            if self._host is not None:
                raise RefusedError(ErrorCode.HELD, _HELD)
            self._host = self._silent_hosts.pop(host.socket.fileno())
            _LOG.info("board %d: a host opened it", self._index)
        if host.programmed != board.programmed:
            raise RefusedError(ErrorCode.STALE, "the board was programmed after it was opened")
        if operation == framing.READ:
            self._send(host, framing.READ, framing.REPLY, sequence, address, board.read(address, count))
        elif operation == framing.WRITE:
            done = board.done
            if self._misbehaviour is not None and isinstance(board, EmulatedBoard) and not board.running:
                rings = address <= register_map.RESUME and address + 4 * count > register_map.START
                board.stuck = rings and self._misbehaves(MisbehaviourKind.NEVER_DONE, ahead=1)
                if rings and self._misbehaves(MisbehaviourKind.DONE_EARLY, ahead=1):
                    self._interrupt(host)
            board.write(address, payload)
            # acknowledge before the interrupt that the write may cause
            if not flags & framing.POSTED:
                self._send(host, framing.WRITE, framing.REPLY, sequence, address, b"")
            if board.done != done or board.running:
                self._starts += 1
                self._interrupt_if_done()
        else:
            raise FramingError(f"the register port does not support operation {operation}")

    def _interrupt_if_done(self) -> None:
        board, host = self.board, self._host
        if not board.running and host is not None and board.interrupt_enabled:
            self._interrupt(host)

    def _interrupt(self, host: _Host) -> None:
        host.interrupts = (host.interrupts + 1) & ALL_ONES
        words = self.board.interrupt_words()
        self._send(host, framing.IRQ, 0, host.interrupts, register_map.DONE, words)

    def _drop_host(self, host: _Host) -> None:
        if host is self._host:
            self._host = None
            self.board.release()
            _LOG.info("board %d: its host has disconnected", self._index)
        else:
            del self._silent_hosts[host.socket.fileno()]
        self._epoll.unregister(host.socket.fileno())
        host.socket.close()

    # ---- misbehaving ----------------------------------------------------------------------------------

    def _misbehaves(self, kind: MisbehaviourKind, *, ahead: int = 0) -> bool:
        """Return whether this fault occurs now, with `ahead` more starts than counted so far, and count it."""
        wanted = self._misbehaviour
        if wanted is None or wanted.kind is not kind:
            return False
        if 0 < wanted.after >= self._starts + ahead or 0 < wanted.times <= self._faults:
            return False
        self._faults += 1
        return True

    def _send(
        self, host: _Host, operation: int, flags: int, sequence: int, address: int, words: bytes
    ) -> None:
        """Send an answer or an interrupt, or a faulty one."""
        if self._misbehaviour is None:
            host.send(framing.encode(operation, flags, sequence, address, len(words) // 4, words))
            return
        if self._misbehaves(MisbehaviourKind.DROP):
            return
        if self._misbehaves(MisbehaviourKind.STALL):
            host.stalled = True
            return
        if operation == framing.IRQ:
            last, self._last_results = self._last_results, words
            if last and self._misbehaves(MisbehaviourKind.STALE_RESULT):
                words = last
        if words and self._misbehaves(MisbehaviourKind.SHORT_READ):
            words = words[:-4]
        if words and self._misbehaves(MisbehaviourKind.ALL_ONES):
            words = b"\xff" * len(words)
        if self._misbehaves(MisbehaviourKind.WRONG_SEQUENCE):
            sequence = (sequence + 1) & ALL_ONES
        data = framing.encode(operation, flags, sequence, address, len(words) // 4, words)
        if operation == framing.IRQ and self._misbehaves(MisbehaviourKind.DONE_TWICE):
            host.interrupts = (host.interrupts + 1) & ALL_ONES
            data += framing.encode(operation, flags, host.interrupts, address, len(words) // 4, words)
        if self._misbehaves(MisbehaviourKind.WRONG_CRC):
            data = data[:16] + bytes(byte ^ 0xFF for byte in data[16:20]) + data[20:]
        if self._misbehaves(MisbehaviourKind.ENDLESS):
            data = data[:-2]
            host.stalled = True
        host.send(data)

    # ---- the loader -----------------------------------------------------------------------------------

    def _accept_loader(self) -> None:
        try:
            connection, _ = self._programming.accept()
        except OSError:
            return
        if self._is_being_programmed():
            _refuse(connection, _PROGRAMMED)
            return
        if len(self._silent_loaders) == MAX_SILENT:
            self._drop_loader(next(iter(self._silent_loaders.values())))
        loader = _Loader(connection, self._endpoint, self._greeting(framing.NO_TOKEN))
        self._silent_loaders[loader.socket.fileno()] = loader
        self._epoll.register(loader.socket.fileno(), _READABLE)

    def _is_being_programmed(self) -> bool:
        """Return whether a loader programs the board, after handling the last frames of a disconnected one."""
        loader = self._loader
        if loader is None:
            return False
        while loader.open and loader.receive():
            loader.answer(partial(self._program, loader))
        if not loader.open:
            self._drop_loader(loader)
        return self._loader is not None

    def _serve_loader(self, loader: _Loader) -> None:
        loader.last_frame = time.monotonic()
        loader.receive()
        loader.answer(partial(self._program, loader))
        if not loader.open:
            self._drop_loader(loader)

    def _program(self, loader: _Loader, frame: Frame) -> None:
        """Handle a frame of a loader, which excludes other loaders from its first request on."""
        if loader is not self._loader:
            if self._loader is not None:
                raise RefusedError(ErrorCode.HELD, _PROGRAMMED)
            self._loader = self._silent_loaders.pop(loader.socket.fileno())
        operation, flags, sequence, address, count, payload = frame
        if operation == framing.READ:
            words = self.board.read(address, count)
            loader.send(framing.encode(framing.READ, framing.REPLY, sequence, address, count, words))
            return
        if operation != framing.PROGRAM:
            raise FramingError(f"the programming port does not support operation {operation}")
        if flags & framing.BEGIN:
            begin = framing.ProgramBegin.decode(payload)
            if begin.size > MAX_IMAGE_BYTES:
                raise RefusedError(
                    ErrorCode.BAD_IMAGE, f"it has {begin.size} bytes, the maximum is {MAX_IMAGE_BYTES}"
                )
            self._check_not_held(begin)
            loader.begin = begin
            loader.content.clear()
        elif loader.begin is None or address != len(loader.content):
            raise FramingError(f"a part for offset {address} arrived out of order")
        elif len(loader.content) < loader.begin.size:
            # the last word of the file may be padded with zeros
            loader.content += payload[: loader.begin.size - len(loader.content)]
        if flags & framing.END:
            self._load(loader, loader.begin)
        if not flags & framing.POSTED:
            loader.send(framing.encode(framing.PROGRAM, framing.REPLY, sequence, address, 0))

    def _check_not_held(self, begin: ProgramBegin) -> None:
        if self._is_held() and self._host is not None and begin.token != self._host.token:
            raise RefusedError(
                ErrorCode.HELD, "a host holds it; stop that host, or use it to program the board"
            )

    def _load(self, loader: _Loader, begin: ProgramBegin) -> None:
        content = bytes(loader.content)
        loader.begin = None
        loader.content.clear()
        self._check_not_held(begin)
        if len(content) != begin.size or hashlib.sha256(content).digest() != begin.sha256:
            raise RefusedError(ErrorCode.BAD_IMAGE, "the received bytes differ from the announced ones")
        self.board.load(content)
        _LOG.info("board %d: programmed with image %s", self._index, self.board.image_hash)

    def _drop_silent_loader(self) -> None:
        loader = self._loader
        if loader is not None and time.monotonic() - loader.last_frame > PROGRAMMING_SILENCE_S:
            self._drop_loader(loader)

    def _drop_loader(self, loader: _Loader) -> None:
        if loader is self._loader:
            self._loader = None
        else:
            del self._silent_loaders[loader.socket.fileno()]
        self._epoll.unregister(loader.socket.fileno())
        loader.socket.close()


def _refuse(connection: socket.socket, detail: str) -> None:
    with suppress(OSError):
        connection.sendall(framing.encode_error(0, 0, ErrorCode.HELD, detail))
    connection.close()


def _is_closed_by_peer(connection: socket.socket) -> bool:
    """Return whether the peer has closed the connection, without reading from it."""
    poll = select.poll()
    poll.register(connection, select.POLLRDHUP)
    return bool(poll.poll(0))
