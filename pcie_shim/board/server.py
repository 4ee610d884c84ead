"""The server of a board: one thread that serves the registers to one host at a time, and programs the board.

    host ────▶ register port ────┐
                                 ├─ one epoll loop ─── board (registers, machine)
    loader ──▶ programming port ─┘

The machine runs in chunks of cycles, and the loop polls its sockets after each chunk. So a reset, a second host or the
end of the process never waits longer than one chunk. When a host disconnects, another host can open the board. If a
host violates the protocol, the server sends an ERROR and closes the link.
"""

import hashlib
import logging
import os
import select
import socket
import time
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from typing import Final, Protocol, TypeVar

from pcie_shim import framing, register_map
from pcie_shim.board.connection import Connection, HostConnection, LoaderConnection
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.endpoint import Endpoint, listen, parse_endpoint, remove_listener
from pcie_shim.errors import FramingError
from pcie_shim.framing import Frame, ProgramBegin
from pcie_shim.link_rate import LinkModel
from pcie_shim.programming_file import MAX_IMAGE_BYTES
from pcie_shim.register_layout import ALL_ONES
from pcie_shim.register_map import ErrorCode

_LOG: Final = logging.getLogger(__name__)

PROGRAMMING_SILENCE_S: Final = 10.0
"""If the loader sends no frame for this many seconds, another loader may program the board."""
MAX_SILENT: Final = 16
"""Maximum number of connections to a port that have sent no request yet. A further connection replaces the oldest."""

_HELD: Final = "another host holds it; only one host can drive a board at a time"
_PROGRAMMED: Final = "another loader is programming it"
_Peer = TypeVar("_Peer", bound=Connection)
_READABLE: Final = select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR


class Board(Protocol):
    """Registers and a machine, without sockets. A board without image is blank (docs/reference/registers.md)."""

    turned: float
    """Monotonic time at which the board's server last polled for requests; 0 before the first poll."""
    programmed: int
    """Number of images loaded so far."""
    done: int
    """Doorbell number of the last completed run, as in the register DONE. A start or a resume begins a run."""
    running: bool
    """True while the machine is running and `step` must be called."""

    @property
    def image_hash(self) -> str:
        """SHA-256 (hex) of the loaded image, or zeros if the board is blank. Any thread may read the hash."""

    @property
    def interrupt_enabled(self) -> bool:
        """True if the host has enabled interrupts."""

    def load(self, content: bytes) -> None:
        """Program the board with the bytes of a programming file, or raise a RefusedError."""

    def read(self, address: int, count: int) -> bytes:
        """Return `count` words from `address` on, little-endian, or raise a RefusedError."""

    def write(self, address: int, words: bytes | memoryview) -> None:
        """Write little-endian words from `address` on.

        If the words include a doorbell register, the doorbell takes effect last, and starts the machine.

        Raises:
            RefusedError: The board is busy, or an address or value is invalid.
        """

    def step(self) -> None:
        """Run the machine for one more chunk of cycles. Then `running` tells whether to call `step` again."""

    def interrupt_words(self) -> bytes:
        """Return an interrupt's payload: the registers from DONE to COMPUTE_NS, and results if the board sends them."""

    def release(self) -> None:
        """Stop a running machine and disable interrupts, because the host has disconnected."""

    def close(self) -> None:
        """End the board's other processes, such as a simulation."""


class StopSignal:
    """Stop request for `serve_board`, set by a signal handler or a thread.

    A forked process must create a StopSignal of its own, because forks share the pipe in a StopSignal.
    """

    def __init__(self) -> None:
        # a pipe, because a signal handler may write to it, and epoll wakes up
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    def set(self) -> None:
        """Ask `serve_board` to end. A signal handler may call this method, also repeatedly."""
        with suppress(OSError):
            os.write(self._write, b"x")

    def fileno(self) -> int:
        """Return a file descriptor that becomes readable when `set` is called."""
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
    link: LinkModel | None = None,
    pin: bool = True,
    on_ready: Callable[[Board], None] | None = None,
) -> None:
    """Serve board number `index` until `stop` is set, and then remove the socket files.

    By default, the board is a blank emulated board. `link` is the model of a slower link. It delays every transfer
    between host and board. `on_ready` is called when both sockets are listening.

    With `pin`, this thread is pinned to one of its allowed cores, number `index` modulo the number of cores. A board
    computes for only tenths of a millisecond. This time is too short for Linux to distribute the boards' threads over
    the cores. Without pinning, the boards of a mini-cluster would compute one after the other. The pinned thread also
    gets the policy SCHED_BATCH, so a waking board does not preempt other threads.

    Raises:
        EndpointError: The endpoint is invalid or in use.
    """
    where = parse_endpoint(endpoint) if isinstance(endpoint, str) else endpoint
    if pin:
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[index % len(cores)]})
        # a board that wakes must not preempt the host, which has other boards to start; some sandboxes refuse this
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with closing(BoardServer(where, index, stop, board or EmulatedBoard(), link)) as server:
        if on_ready is not None:
            on_ready(server.board)
        server.run()


class BoardServer:
    """The loop that waits for the stop signal, new connections at both ports, and data from the host and the loader."""

    def __init__(
        self, endpoint: Endpoint, index: int, stop: StopSignal, board: Board, link: LinkModel | None = None
    ) -> None:
        """Listen at the endpoint and at its programming port, or raise an EndpointError."""
        self.board = board
        self._link = link
        self._index = index
        self._stop = stop
        self._endpoint = endpoint
        # a unix socket is private without a key
        self._key = endpoint.key if endpoint.host else b""
        self._registers = listen(endpoint)
        try:
            self._programming = listen(endpoint.programming)
        except BaseException:
            remove_listener(endpoint, self._registers)
            raise

        # The host that holds the board, because it made the first request while nobody held it, and the connections
        # that have not made any, by descriptor and oldest first. No host is in both.
        self._host: HostConnection | None = None
        self._silent_hosts: dict[int, HostConnection] = {}

        # The same for the programming port.
        self._loader: LoaderConnection | None = None
        self._silent_loaders: dict[int, LoaderConnection] = {}

        # All of the sockets above, and the stop signal, are registered here until they are closed.
        self._epoll = select.epoll()
        for descriptor in (stop.fileno(), self._registers.fileno(), self._programming.fileno()):
            self._epoll.register(descriptor, _READABLE)

    def run(self) -> None:
        """Serve until the stop signal is set."""
        board = self.board
        while True:
            board.turned = time.monotonic()
            for descriptor, _ in self._epoll.poll(0.0 if board.running else 1.0):
                if descriptor == self._stop.fileno():
                    return
                self._serve(descriptor)
            if board.running:
                board.step()
                self._interrupt_if_done()
                if self._host is not None and not self._host.open:
                    self._drop_host(self._host)
            self._drop_silent_loader()

    def close(self) -> None:
        """Close all connections and both ports."""
        for host in [*self._silent_hosts.values(), self._host]:
            if host is not None:
                self._drop_host(host)
        for loader in [*self._silent_loaders.values(), self._loader]:
            if loader is not None:
                self._drop_loader(loader)
        self._epoll.close()
        remove_listener(self._endpoint, self._registers)
        remove_listener(self._endpoint.programming, self._programming)

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

    def _greeting(self, token: bytes) -> bytes:
        return framing.encode_greeting(
            framing.Greeting(
                protocol_version=framing.PROTOCOL_VERSION,
                bar_size=register_map.BAR_SIZE,
                board=self._index,
                map_hash=register_map.MAP_SHA256,
                image_hash=self.board.image_hash,
                token=token,
            )
        )

    # ---- the host -------------------------------------------------------------------------------------

    def _accept_host(self) -> None:
        connection = _accepted(self._registers)
        if connection is None:
            return
        if self._is_held():
            _refuse(connection, _HELD)
            return
        # a port scanner, or a host that hangs, must not keep others out
        if len(self._silent_hosts) == MAX_SILENT:
            self._drop_host(next(iter(self._silent_hosts.values())))
        # unpredictable, because it permits programming
        token = os.urandom(8)
        host = HostConnection(
            connection, self._key, self._greeting(token), token, self.board.programmed, self._link
        )
        self._silent_hosts[host.socket.fileno()] = host
        self._epoll.register(host.socket.fileno(), _READABLE)

    def _is_held(self) -> bool:
        """Return whether a host holds the board.

        If that host has disconnected, first handle the frames that it sent before, and release the board.
        """
        host = self._host
        # the end of its connection may have arrived, and not been handled yet
        if host is not None and _has_left(host, self._access):
            self._drop_host(host)
        return self._host is not None

    def _serve_host(self, host: HostConnection) -> None:
        host.receive()
        host.answer(partial(self._access, host))
        if not host.open:
            self._drop_host(host)

    def _access(self, host: HostConnection, frame: Frame) -> None:
        """Handle a frame of a host. If no host holds the board yet, this host holds the board from now on."""
        operation, flags, sequence, address, count, payload = frame
        board = self.board
        if host is not self._host:
            if self._host is not None:
                raise RefusedError(ErrorCode.HELD, _HELD)
            self._host = self._silent_hosts.pop(host.socket.fileno())
            _LOG.info("board %d: a host opened it", self._index)
        # after every programming, even with the same image: registers and counters are reset
        if host.programmed != board.programmed:
            raise RefusedError(ErrorCode.STALE, "the board was programmed after it was opened")
        if operation == framing.READ:
            self._send(host, framing.READ, framing.REPLY, sequence, address, board.read(address, count))
        elif operation == framing.WRITE:
            done = board.done
            board.write(address, payload)
            # acknowledge before the interrupt that the write may cause
            if not flags & framing.POSTED:
                self._send(host, framing.WRITE, framing.REPLY, sequence, address, b"")
            # a short frame is over before the write returns; a longer one ends in `run`
            if board.done != done:
                self._interrupt_if_done()
        else:
            raise FramingError(f"the register port does not support operation {operation}")

    def _interrupt_if_done(self) -> None:
        board, host = self.board, self._host
        if not board.running and host is not None and board.interrupt_enabled:
            self._interrupt(host)

    def _interrupt(self, host: HostConnection) -> None:
        # numbered apart from the requests, so that the host notices a lost one
        host.interrupts = (host.interrupts + 1) & ALL_ONES
        words = self.board.interrupt_words()
        self._send(host, framing.IRQ, 0, host.interrupts, register_map.DONE, words)

    def _send(
        self, host: HostConnection, operation: int, flags: int, sequence: int, address: int, words: bytes
    ) -> None:
        host.send(framing.encode(operation, flags, sequence, address, len(words) // 4, words))

    def _drop_host(self, host: HostConnection) -> None:
        if host is self._host:
            self._host = None
            self.board.release()
            _LOG.info("board %d: its host has disconnected", self._index)
        else:
            del self._silent_hosts[host.socket.fileno()]
        self._epoll.unregister(host.socket.fileno())
        host.socket.close()

    # ---- the loader -----------------------------------------------------------------------------------

    def _accept_loader(self) -> None:
        connection = _accepted(self._programming)
        if connection is None:
            return
        former = self._loader
        if former is not None and _has_left(former, self._program):
            self._drop_loader(former)
        if self._loader is not None:
            _refuse(connection, _PROGRAMMED)
            return
        if len(self._silent_loaders) == MAX_SILENT:
            self._drop_loader(next(iter(self._silent_loaders.values())))
        loader = LoaderConnection(connection, self._key, self._greeting(framing.NO_TOKEN))
        self._silent_loaders[loader.socket.fileno()] = loader
        self._epoll.register(loader.socket.fileno(), _READABLE)

    def _serve_loader(self, loader: LoaderConnection) -> None:
        loader.receive()
        loader.answer(partial(self._program, loader))
        # after the answer, because a loader that waits while the board loads its image is not silent
        loader.last_frame = time.monotonic()
        if not loader.open:
            self._drop_loader(loader)

    def _program(self, loader: LoaderConnection, frame: Frame) -> None:
        """Handle a frame of a loader.

        From a loader's first request until its connection ends, other loaders are refused.
        """
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
            # before memory is taken for it
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

    def _load(self, loader: LoaderConnection, begin: ProgramBegin) -> None:
        content = bytes(loader.content)
        loader.begin = None
        loader.content.clear()
        # again, because a host may have opened the board during the transfer
        self._check_not_held(begin)
        if len(content) != begin.size or hashlib.sha256(content).digest() != begin.sha256:
            raise RefusedError(ErrorCode.BAD_IMAGE, "the received bytes differ from the announced ones")
        self.board.load(content)
        _LOG.info("board %d: programmed with image %s", self._index, self.board.image_hash)

    def _drop_silent_loader(self) -> None:
        loader = self._loader
        if loader is not None and time.monotonic() - loader.last_frame > PROGRAMMING_SILENCE_S:
            self._drop_loader(loader)

    def _drop_loader(self, loader: LoaderConnection) -> None:
        if loader is self._loader:
            self._loader = None
        else:
            del self._silent_loaders[loader.socket.fileno()]
        self._epoll.unregister(loader.socket.fileno())
        loader.socket.close()


def _accepted(listener: socket.socket) -> socket.socket | None:
    try:
        connection, _ = listener.accept()
    except OSError:
        return None  # the peer has disconnected already
    return connection


def _has_left(peer: _Peer, handle: Callable[[_Peer, Frame], None]) -> bool:
    """Handle everything that a peer has sent so far, and return whether it has disconnected."""
    while peer.open and peer.receive():
        peer.answer(partial(handle, peer))
    return not peer.open


def _refuse(connection: socket.socket, detail: str) -> None:
    with suppress(OSError):
        connection.sendall(framing.encode_error(0, 0, ErrorCode.HELD, detail))
    connection.close()
