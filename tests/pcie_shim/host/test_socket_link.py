"""The link over a socket, towards a board whose bytes the test writes.

SocketLink ──AF_UNIX── board (a socket in this process, which has greeted)
"""

import contextlib
import os
import socket
import threading

import pytest

from pcie_shim import errors, framing
from pcie_shim import register_map as rm
from pcie_shim.endpoint import parse_endpoint
from pcie_shim.host.socket_link import SocketLink
from pcie_shim.register_layout import ALL_ONES, DONE_BLOCK
from pcie_shim.register_map import ErrorCode
from tests.patience import PATIENCE

GREETING = framing.encode_greeting(
    framing.Greeting(
        protocol_version=framing.PROTOCOL_VERSION,
        bar_size=rm.BAR_SIZE,
        board=0,
        map_hash=rm.MAP_SHA256,
        image_hash="00" * 32,
        token=bytes(8),
    )
)


@contextlib.contextmanager
def linked(folder, *, greets_after=0.0, timeout=PATIENCE, connect_timeout=None):
    """An open link, and the board's end of it; the board greets when the host has given up, if not before."""
    place = folder / "board.sock"
    with socket.socket(socket.AF_UNIX) as listener, contextlib.ExitStack() as ends:
        listener.bind(str(place))
        listener.listen()
        accepted: list[socket.socket] = []
        ended = threading.Event()

        def greet():
            connection, _ = listener.accept()
            accepted.append(ends.enter_context(connection))
            ended.wait(greets_after)
            with contextlib.suppress(OSError):  # a host that does not wait has gone
                connection.sendall(GREETING)

        thread = threading.Thread(target=greet)
        thread.start()
        try:
            endpoint = parse_endpoint(f"unix:{place}")
            link = ends.enter_context(
                SocketLink.open(endpoint, timeout=timeout, connect_timeout=connect_timeout)
            )
        finally:
            ended.set()
            thread.join()
        yield link, accepted[0]


def interrupt(sequence, words):
    return framing.encode(framing.IRQ, 0, sequence, rm.DONE, len(words) // 4, words)


def refusal(code):
    return framing.encode_error(1, rm.START, code, "no")


def test_a_board_may_take_longer_to_greet_than_to_answer(folder):
    with linked(folder, greets_after=0.2, timeout=0.05, connect_timeout=PATIENCE) as (link, _):
        with pytest.raises(errors.LinkTimeoutError, match=r"within 0\.05 s"):
            link.read32(rm.ID)
        assert link.fileno() == -1


def test_a_board_that_does_not_greet_is_not_waited_for_as_for_an_answer(folder):
    with pytest.raises(errors.LinkTimeoutError), linked(folder, greets_after=PATIENCE, connect_timeout=0.1):
        pass


@pytest.mark.parametrize("words", range(DONE_BLOCK.size // 4))
def test_an_interrupt_without_all_its_registers_closes_the_link(folder, words):
    with linked(folder) as (link, board):
        board.sendall(interrupt(1, bytes(4 * words)))
        with pytest.raises(errors.ShortReadError):
            link.receive_done()
        with pytest.raises(errors.LinkClosedError):
            link.take_done()


def test_an_interrupt_without_results_is_taken(folder):
    with linked(folder) as (link, board):
        for sequence in (1, 2):
            board.sendall(interrupt(sequence, DONE_BLOCK.pack(7, 5, 2**40 + 1, 2**33)))
            assert link.receive_done() == (7, 5, 2**40 + 1, 2**33, b"")
            assert link.take_done() is None


@pytest.mark.parametrize(
    ("number", "status", "gone"), [(ALL_ONES, ALL_ONES, True), (ALL_ONES, 5, False), (7, ALL_ONES, False)]
)
def test_only_an_interrupt_of_all_ones_is_from_no_device(folder, number, status, gone):
    with linked(folder) as (link, board):
        board.sendall(interrupt(1, DONE_BLOCK.pack(number, status, 0, 0)))
        with pytest.raises(errors.DeviceGoneError) if gone else contextlib.nullcontext():
            assert link.receive_done() is not None
        assert (link.fileno() == -1) is gone


def test_an_answer_without_a_request_closes_the_link(folder):
    with linked(folder) as (link, board):
        board.sendall(framing.encode(framing.WRITE, framing.REPLY, 1, rm.START, 0))
        with pytest.raises(errors.SequenceError):
            link.receive_done()
        assert link.fileno() == -1


@pytest.mark.parametrize("code", [ErrorCode.BUSY, ErrorCode.STALE, 250])
def test_the_reason_that_a_board_sent_before_it_closed_is_reported(folder, code):
    with linked(folder) as (link, board):
        board.sendall(interrupt(1, DONE_BLOCK.pack(1, 5, 0, 0)) + refusal(code))
        board.close()
        with pytest.raises(errors.AccessError) as caught:
            link.write32(rm.START, 1)
        assert caught.value.code == code
        assert link.fileno() == -1


def test_a_board_that_closes_without_a_reason_is_gone(folder):
    with linked(folder) as (link, board):
        board.sendall(interrupt(1, DONE_BLOCK.pack(1, 5, 0, 0)))
        board.close()
        with pytest.raises(errors.LinkClosedError) as caught:
            link.write32(rm.START, 1)
        assert str(link.endpoint) in str(caught.value)
        assert link.fileno() == -1


@pytest.mark.parametrize(("address", "gone"), [(rm.ID, True), (rm.LIVENESS, False)])
def test_an_id_of_all_ones_is_no_device(folder, address, gone):
    with linked(folder) as (link, board):
        answer = framing.encode(framing.READ, framing.REPLY, 1, address, 1, b"\xff" * 4)
        board.sendall(answer)
        with pytest.raises(errors.DeviceGoneError) if gone else contextlib.nullcontext():
            assert link.read32(address) == ALL_ONES
        assert (link.fileno() == -1) is gone


@pytest.mark.parametrize("blocking", [True, False], ids=["blocking", "as uvloop leaves it"])
def test_a_board_that_reads_late_gets_everything(folder, blocking):
    block = (rm.INPUTS, bytes(4 * rm.INPUTS.words))
    with linked(folder) as (link, board):
        os.set_blocking(link.fileno(), blocking)
        posts = 2 + 2 * link._socket.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) // len(block[1])
        due, received = posts * (framing.HEADER_BYTES + len(block[1])), 0
        thread = threading.Thread(target=lambda: link.post([block] * posts))
        thread.start()
        while received < due:
            received += len(board.recv(1 << 16))
        thread.join()
        assert received == due


@pytest.mark.parametrize("blocking", [True, False], ids=["blocking", "as uvloop leaves it"])
def test_a_board_that_never_reads_is_given_up(folder, blocking):
    with linked(folder, timeout=0.05, connect_timeout=PATIENCE) as (link, _):
        os.set_blocking(link.fileno(), blocking)
        with pytest.raises(errors.LinkTimeoutError, match=r"did not accept the data within 0\.05 s"):
            link.post([(rm.INPUTS, bytes(4 * rm.INPUTS.words))] * 1000)
        assert link.fileno() == -1
