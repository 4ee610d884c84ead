"""Machines, images and served boards for the tests of the boards."""

import contextlib
import dataclasses
import socket
import struct
import tempfile
import threading
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import pytest

from machines import make_kernel
from machines.bm1 import BM1Machine, Start, StopReason
from machines.bm1_kind import BM1
from machines.kind import FrameInput
from machines.parameters import BM1Parameters, RngKind, SensorMode
from pcie_shim import register_map as rm
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.board.server import StopSignal, serve_board
from pcie_shim.endpoint import Endpoint
from pcie_shim.errors import BoardError, PcieShimError
from pcie_shim.host.driven_board import DrivenBoard
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.host.socket_link import Done
from pcie_shim.programming_file import Image, Partition, image_bytes
from pcie_shim.register_layout import in_field
from tests.misbehaving_board import serve_misbehaving
from tests.patience import PATIENCE

_PLACES: list[socket.socket] = []
"""Bound and never listening, until `free_places`."""


def machine(
    seed: int = 0, *, lines: int = 8, sensor_bits: Sequence[int] = (3, 4), zeros: float = 0.1, **parameters
) -> BM1Machine:
    """A machine with random tables, ``zeros`` of its codes 0."""
    built = BM1Parameters(lines=lines, sensor_bits=tuple(sensor_bits), **parameters)
    random = np.random.default_rng(seed)

    def table(rows: int) -> np.ndarray:
        codes = random.integers(0, built.ones_code + 1, (rows, lines))
        codes[random.random((rows, lines)) < zeros] = 0
        return codes.astype(np.uint16)

    tables = [table(1 << bits) for bits in built.sensor_bits] if built.has_tables else []
    for each in tables:
        each[-1] = built.ones_code
    numbers = None
    if built.rng is RngKind.TABLE:
        numbers = random.integers(0, 1 << built.prob_bits, 500).astype(np.uint32)
    return BM1Machine(built, table(built.prior_addresses), tuple(tables), numbers)


def never_stopping() -> BM1Machine:
    """A machine that runs for minutes once it is started with the widest target and limit."""
    built = BM1Parameters(lines=4, sensor_bits=(2,), counter_bits=32)
    table = np.full((4, 4), 100, np.uint16)
    table[-1] = built.ones_code
    return BM1Machine(built, np.full((1, 4), 100, np.uint16), (table,))


def image(of: BM1Machine, *, index: int = 0, count: int = 1, offset: int = 0, total: int = 0) -> Image:
    """An image of one part of a model."""
    lines = of.parameters.lines
    return Image(
        machine=of,
        partition=Partition(index, count, offset, total or lines),
        interface_sensors=max(20, BM1.registers(of.parameters).input_words),
        interface_results=1200,
        model_hash="ab" * 32,
        build_date="2026-01-02T03:04:05Z",
        tool_version="0",
    )


def images(seed: int, lines: Sequence[int], **parameters) -> list[Image]:
    """The images of a model split over boards with so many lines each."""
    total = sum(lines)
    return [
        image(
            machine(seed + index, lines=own, **parameters),
            index=index,
            count=len(lines),
            offset=sum(lines[:index]),
            total=total,
        )
        for index, own in enumerate(lines)
    ]


def loaded(of: Image) -> EmulatedBoard:
    """A board in no server, programmed with an image."""
    board = EmulatedBoard()
    board.load(image_bytes(of))
    return board


def finish(board: EmulatedBoard) -> int:
    """Step until the machine stops; the number of steps."""
    steps = 0
    while board.running:
        assert board.read(rm.STATUS, 1)[0] & 15 == rm.BoardState.RUNNING
        board.step()
        steps += 1
    return steps


def refused(code: rm.ErrorCode) -> contextlib.AbstractContextManager[pytest.ExceptionInfo[RefusedError]]:
    """An error of this code; its sentence has no full stop, because the host continues it."""
    return pytest.raises(
        RefusedError, check=lambda error: error.code is code and not str(error).endswith(".")
    )


def done_by(
    board: DrivenBoard, reason: int, results: bytes, *, state: rm.BoardState = rm.BoardState.DONE
) -> Done:
    """What the interrupt of a board says whose machine has stopped, or is in another state."""
    status = in_field(rm.STATUS_STATE_MASK, state) | in_field(rm.STATUS_STOP_REASON_MASK, reason)
    return Done(board.number, status, 9, 100, memoryview(results))


class ServedBoard:
    """An emulated board in a thread of the test's process; the host may have to read its results."""

    def __init__(
        self, endpoint: Endpoint | str, *, index: int = 0, misbehave: str = "", sends_results: bool = True
    ) -> None:
        self.endpoint = endpoint
        self._sends_results = sends_results
        self._stop = StopSignal()
        self._listens = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(index, misbehave), name="board", daemon=True)
        self._thread.start()
        assert self._listens.wait(PATIENCE), f"the board at {endpoint} did not start"

    def _run(self, index: int, misbehave: str) -> None:
        try:
            if misbehave:
                serve = partial(serve_misbehaving, fault=misbehave, sends_results=self._sends_results)
            else:
                board = EmulatedBoard(sends_results=self._sends_results)
                serve = partial(serve_board, pin=False, board=board)
            serve(self.endpoint, index=index, stop=self._stop, on_ready=lambda _board: self._listens.set())
        finally:
            self._stop.close()
            self._listens.set()

    def stop(self) -> None:
        """End it, and wait until its connections are closed."""
        if self._thread.is_alive():
            self._stop.set()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


@contextlib.contextmanager
def board_fails(cause: type[PcieShimError]) -> Iterator[pytest.ExceptionInfo[BoardError]]:
    """Expect the error of a board with such a cause."""
    with pytest.raises(BoardError) as caught:
        yield caught
    assert isinstance(caught.value.__cause__, cause)


def endpoints_of(boards: Sequence[ServedBoard]) -> list[str]:
    return [board.endpoint for board in boards]


@contextlib.contextmanager
def opened(parts: Sequence[Image], *, tcp: bool = False, sends_results: bool = True) -> Iterator[MiniCluster]:
    """A mini-cluster of well-behaved boards that hold these parts; they end in order."""
    with tempfile.TemporaryDirectory(prefix="bm") as base:
        boards = [
            ServedBoard(
                tcp_endpoint() if tcp else f"unix:{base}/board{at}.sock",
                index=at,
                sends_results=sends_results,
            )
            for at in range(len(parts))
        ]
        try:
            with MiniCluster.open(endpoints_of(boards), parts, timeout=PATIENCE, slack=PATIENCE) as cluster:
                yield cluster
        finally:
            for board in boards:
                board.stop()


def expected(parts: Sequence[Image], frame: FrameInput) -> list[tuple[list[int], int, StopReason]]:
    """Compute counts, cycles and reason of each board here, with kernels and without boards."""
    kernels = [make_kernel(part.machine) for part in parts]
    sliced = frame.stop == "slices"
    end = 256 if sliced else 0
    while sliced and end < 2 * frame.target_count:
        end *= 2
    for kernel, part in zip(kernels, parts, strict=True):
        parameters = part.machine.parameters
        lines = slice(part.partition.line_offset, part.partition.line_offset + parameters.lines)
        kernel.start(
            Start(
                addresses=_inputs(parameters, frame.addresses, lines),
                prior_address=frame.prior_address,
                prior_codes=None if frame.prior_codes is None else frame.prior_codes[lines],
                target_count=frame.target_count,
                max_cycles=frame.max_cycles,
                bank=frame.bank,
                run_until=end if end < frame.max_cycles else 0,
            )
        )
    while sliced and not any(kernel.reason is StopReason.OVERFLOW for kernel in kernels):
        going = [kernel for kernel in kernels if kernel.reason is StopReason.SLICE]
        if not going:
            break
        end *= 2
        for kernel in going:
            kernel.resume(end if end < frame.max_cycles else 0)
    return [(kernel.counts.tolist(), kernel.cycles, kernel.reason) for kernel in kernels]


def expected_of_replicas(parts: Sequence[Image], frame: FrameInput):
    """Compute a frame for each replica with machines of one replica, which are independent of the others."""
    parameters = parts[0].machine.parameters
    alone = []
    for part in parts:
        one = dataclasses.replace(part.machine.parameters, replicas=1)
        of_one = dataclasses.replace(part.machine, parameters=one)
        alone.append(
            dataclasses.replace(part, machine=of_one, interface_sensors=BM1.registers(one).input_words)
        )
    inputs = np.asarray(frame.addresses).reshape(parameters.replicas, parameters.sensors, -1)
    priors, codes = frame.prior_address, frame.prior_codes
    return [
        expected(
            alone,
            dataclasses.replace(
                frame,
                addresses=own,
                prior_address=priors[replica] if isinstance(priors, tuple) else priors,
                prior_codes=codes if codes is None or codes.ndim == 1 else codes[replica],
            ),
        )
        for replica, own in enumerate(inputs)
    ]


def _inputs(parameters: BM1Parameters, given: object, lines: slice) -> tuple[int, ...] | np.ndarray:
    """Return a board's inputs; None or -1 is a missing reading."""
    if not parameters.sensors:
        return ()
    missing = (1 << np.array(parameters.sensor_bits, np.int64)) - 1
    if isinstance(given, tuple):
        given = np.array([-1 if address is None else address for address in given], np.int64)
    own = given.reshape(parameters.sensors, -1)
    if parameters.sensor_mode is not SensorMode.COLUMN:
        return np.where(own[:, lines] == -1, missing[:, np.newaxis], own[:, lines])
    return tuple(np.where(own[:, 0] == -1, missing, own[:, 0]).tolist())


def tcp_endpoint() -> str:
    """Return an endpoint whose port and next port (for programming) stay reserved until `free_places`."""
    return f"tcp://127.0.0.1:{two_ports(_PLACES)}"


def two_ports(places: list[socket.socket]) -> int:
    """Return a free port, of which and the next one nobody else is given any before these sockets are closed."""
    while True:
        first, second = socket.socket(), socket.socket()
        places.extend((first, second))
        for place in (first, second):
            place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        first.bind(("127.0.0.1", 0))
        port: int = first.getsockname()[1]
        with contextlib.suppress(OSError, OverflowError):
            second.bind(("127.0.0.1", port + 1))
            return port


def free_places() -> None:
    """Close what holds the ports of `tcp_endpoint`; those of boards that listen stay theirs."""
    while _PLACES:
        _PLACES.pop().close()


def words(*values: int) -> bytes:
    """32-bit words, little-endian."""
    return struct.pack(f"<{len(values)}I", *values)
