"""The board's server: one host, a second one, one that disconnects, one that breaks the protocol, and loaders.

the test ──socket── a board's thread (registers, machine)
     └─────socket── its programming port
"""

import hashlib
import socket
import struct
import time
from types import SimpleNamespace

import pytest

from machines import make_kernel
from machines.bm1 import Start, StopReason
from pcie_shim import errors, framing
from pcie_shim import register_map as rm
from pcie_shim.board import connection as connection_module
from pcie_shim.board import server as board_module
from pcie_shim.board.emulated_board import EmulatedBoard
from pcie_shim.endpoint import connect, listen, parse_endpoint
from pcie_shim.host import socket_link
from pcie_shim.host.loader import program
from pcie_shim.host.socket_link import SocketLink
from pcie_shim.programming_file import image_bytes
from pcie_shim.register_map import BoardState, ErrorCode
from tests.patience import PATIENCE
from tests.pcie_shim.boards import image, machine, never_stopping, tcp_endpoint, words

ENABLE = rm.CONTROL_INTERRUPT_ENABLE_MASK
MACHINE = machine(1)


def open_link(board):
    return SocketLink.open(parse_endpoint(board.endpoint), timeout=PATIENCE)


def programmed(start_board, of):
    board = start_board()
    program(board.endpoint, image(of))
    return board


def refused(code):
    return pytest.raises(errors.AccessError, check=lambda error: error.code == code)


def run_for_minutes(link):
    """Start a machine that does not stop by itself."""
    link.write32(rm.CONTROL, ENABLE)
    link.write_block(rm.SENSORS, words(1))
    link.write_block(rm.TARGET_COUNT, struct.pack("<IQ", 2**32 - 1, 2**60))
    link.write32(rm.START, link.read32(rm.DONE) + 1)
    assert link.read32(rm.STATUS) & 15 == BoardState.RUNNING


def wait_done(link, number):
    deadline = time.monotonic() + PATIENCE
    while (done := link.take_done() or link.receive_done()) is None:
        assert time.monotonic() < deadline, f"the board does not finish start {number}"
    assert done.number == number
    return done


# ---- the register port ----


@pytest.mark.parametrize("kind", ["unix", "tcp"])
def test_a_frame_over_a_link(start_board, kind):
    board = start_board("" if kind == "unix" else tcp_endpoint(), index=3)
    program(board.endpoint, image(MACHINE))
    kernel = make_kernel(MACHINE)
    kernel.start(Start(addresses=(2, 5), target_count=50, max_cycles=4000, bank=1, run_until=30))
    with open_link(board) as link:
        assert link.greeting.board == 3
        assert link.greeting.image_hash == image(MACHINE).image_hash
        assert link.read32(rm.ID) == rm.ID_VALUE
        link.write32(rm.LIVENESS, 0x55AA0001)
        assert link.read32(rm.LIVENESS) == 0xAA55FFFE
        link.write32(rm.CONTROL, ENABLE)
        link.write_block(rm.SENSORS, words(2, 5))
        link.write_block(rm.TARGET_COUNT, struct.pack("<IQIIQI", 50, 4000, 1, 0, 30, 1))
        done = wait_done(link, 1)
        assert (done.number, done.state, done.reason) == (1, BoardState.DONE, StopReason.SLICE)
        assert done.cycles == kernel.cycles == 30
        assert bytes(done.results) == kernel.counts.tobytes() == link.read_block(rm.RESULTS, 8)
        assert done.compute_ns == struct.unpack("<Q", link.read_block(rm.COMPUTE_NS, 2))[0] > 0
        # posted: both frames in one send, nothing acknowledged but by the interrupt
        link.post([(rm.RUN_UNTIL, struct.pack("<Q", 0)), (rm.RESUME, words(2))])
        done = wait_done(link, 2)
        kernel.resume(0)
        assert (done.reason, done.cycles) == (kernel.reason, kernel.cycles)
        assert bytes(done.results) == kernel.counts.tobytes()


def test_results_of_an_interrupt_outlive_later_reads(start_board):
    with open_link(programmed(start_board, MACHINE)) as link:
        link.write32(rm.CONTROL, ENABLE)
        link.write_block(rm.SENSORS, words(2, 5))
        link.write_block(rm.TARGET_COUNT, struct.pack("<IQIIQI", 50, 4000, 1, 0, 0, 1))
        while link.read32(rm.DONE) != 1:
            pass
        # the interrupt came before this answer; these reads fill the buffer in which it was received
        results = link.read_block(rm.RESULTS, 1200)[:32]
        link.read_block(rm.MAP_HASH, 8)
        assert bytes(wait_done(link, 1).results) == results != bytes(32)


def test_without_interrupts_the_host_reads_done(start_board):
    with open_link(programmed(start_board, MACHINE)) as link:
        link.write_block(rm.SENSORS, words(1, 1))
        link.write_block(rm.TARGET_COUNT, struct.pack("<IQIIQI", 5, 4000, 0, 0, 0, 1))
        assert link.read32(rm.DONE) == 1
        assert link.take_done() is None


def test_a_refused_posted_write_is_heard_of(start_board):
    with open_link(start_board()) as link:
        link.post([(rm.RESULTS, words(1))])
        with refused(ErrorCode.BLANK):
            wait_done(link, 1)


def test_a_running_board_answers_and_can_be_reset(start_board):
    board = programmed(start_board, never_stopping())
    with open_link(board) as link:
        run_for_minutes(link)
        with refused(ErrorCode.BUSY):
            link.write32(rm.TARGET_COUNT, 1)
        first = link.read_block(rm.CYCLES, 2)
        while link.read_block(rm.CYCLES, 2) == first:
            pass
        link.write32(rm.CONTROL, rm.CONTROL_RESET_MASK | ENABLE)
        assert link.read32(rm.STATUS) == BoardState.IDLE | ErrorCode.NONE << 8
        link.write32(rm.TARGET_COUNT, 10)
        link.write32(rm.START, 1)
        assert wait_done(link, 1).reason == StopReason.OVERFLOW


# ---- one host at a time ----


def test_a_second_host_is_refused_and_the_first_goes_on(start_board):
    board = programmed(start_board, never_stopping())
    with open_link(board) as silent, open_link(board) as link:
        # the first connection made no request, and so does not hold the board
        assert link.read32(rm.ID) == rm.ID_VALUE
        for attempt in (open_link, lambda _: silent.read32(rm.ID)):
            with pytest.raises(errors.HeldError):
                attempt(board)
        run_for_minutes(link)
        with pytest.raises(errors.HeldError):
            open_link(board)
        assert link.read32(rm.STATUS) & 15 == BoardState.RUNNING
    with open_link(board) as link:
        assert link.read32(rm.ID) == rm.ID_VALUE


@pytest.mark.parametrize("programming", [False, True])
def test_silent_connections_are_bounded_and_keep_nobody_out(start_board, programming):
    board = start_board()
    opens = open_programming if programming else open_link
    silent = [opens(board) for _ in range(board_module.MAX_SILENT + 1)]
    with pytest.raises(errors.LinkClosedError):
        silent[0].read32(rm.ID)
    if programming:
        program(board.endpoint, image(MACHINE))
    with opens(board) as link:
        assert link.read32(rm.ID) == rm.ID_VALUE
    for each in silent[3:]:
        assert each.read32(rm.ID) == rm.ID_VALUE
        each.close()
    for each in silent[1:3]:
        each.close()


def test_a_host_that_vanishes_leaves_the_board_well(start_board):
    board = programmed(start_board, never_stopping())
    for _ in range(20):
        link = open_link(board)
        run_for_minutes(link)
        link.close()
    with open_link(board) as link:
        assert link.read32(rm.STATUS) == BoardState.IDLE
        assert link.read32(rm.CONTROL) == 0
        assert link.read32(rm.DONE) == 0
    with pytest.raises(errors.LinkClosedError):
        link.read32(rm.ID)


def test_a_host_that_has_just_left_does_not_hold_the_board(folder):
    endpoint = parse_endpoint(f"unix:{folder}/a.sock")
    stop = board_module.StopSignal()
    server = board_module.BoardServer(endpoint, 0, stop, EmulatedBoard())
    for where, accept in ((endpoint, server._accept_host), (endpoint.programming, server._accept_loader)):
        first = connect(where, timeout=PATIENCE)
        accept()
        # a request that was not yet answered, and the end: both come before the next connection is looked at
        first.sendall(framing.encode(framing.READ, 0, 1, 0, 1))
        first.close()
        with connect(where, timeout=PATIENCE) as second:
            accept()
            decoder = framing.FrameDecoder()
            decoder.received(second.recv_into(decoder.room()))
            assert decoder.next_frame().operation == framing.GREET
    stop.set()
    server.run()
    server.close()
    stop.close()


def test_a_host_whose_machine_is_gone_does_not_hold_the_board_for_ever():
    endpoint = parse_endpoint(tcp_endpoint())
    with listen(endpoint) as server, connect(endpoint, timeout=PATIENCE):
        connection = connection_module.Connection(server.accept()[0], b"", b"").socket
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == connection_module.KEEPALIVE_S
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        connection.close()


@pytest.mark.parametrize(
    "nonsense",
    [
        b"GET / HTTP/1.1\r\nHost: board\r\n\r\n",
        framing.encode(framing.READ, 0, 2, 0, 1),
        framing.encode(framing.READ, 0, 1, 0, 1)[:-1] + b"\xff",
        framing.encode(framing.READ, 0, 1, 0, 9000),
        framing.encode(framing.IRQ, 0, 1, 0, 0),
        framing.encode(framing.PROGRAM, 0, 1, 0, 0),
    ],
)
def test_a_host_that_breaks_the_protocol_loses_its_link(start_board, nonsense):
    board = start_board()
    with connect(parse_endpoint(board.endpoint), timeout=PATIENCE) as raw:
        raw.settimeout(PATIENCE)
        raw.sendall(nonsense)
        decoder = framing.FrameDecoder()
        while count := raw.recv_into(decoder.room()):
            decoder.received(count)
    assert decoder.next_frame().operation == framing.GREET
    assert framing.decode_error(decoder.next_frame())[0] == ErrorCode.BAD_FRAME
    with open_link(board) as link:
        assert link.read32(rm.ID) == rm.ID_VALUE


def test_the_host_hears_why_its_link_was_closed(start_board):
    with open_link(start_board()) as link:
        link._sequence += 1
        with pytest.raises(errors.AccessError):
            link.read32(rm.ID)
        assert link.fileno() == -1


# ---- starting and stopping ----


def test_sockets_are_private_and_go_away_though_the_machine_runs(start_board, folder):
    board = programmed(start_board, never_stopping())
    assert {path.name for path in folder.iterdir()} == {"board0.sock", "board0.program.sock"}
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in folder.iterdir())
    with open_link(board) as link:
        run_for_minutes(link)
        board.stop()
        with pytest.raises(errors.LinkClosedError):
            link.read32(rm.ID)
    assert list(folder.iterdir()) == []


def test_a_taken_programming_port_leaves_no_socket_behind(start_board, folder):
    start_board(f"unix:{folder}/a.program.sock")
    with pytest.raises(errors.EndpointError):
        board_module.serve_board(f"unix:{folder}/a.sock", index=1, stop=board_module.StopSignal(), pin=False)
    assert not (folder / "a.sock").exists()


def test_a_stop_signal_can_be_set_early_and_often(folder):
    stop = board_module.StopSignal()
    for _ in range(100_000):
        stop.set()
    board_module.serve_board(f"unix:{folder}/a.sock", index=0, stop=stop, pin=False)
    stop.close()
    stop.set()
    assert list(folder.iterdir()) == []


# ---- programming ----


def test_a_blank_board_is_programmed_and_programmed_again(start_board):
    board = start_board()
    first, second = image(machine(3, lines=300, sensor_bits=(7, 7, 7, 7))), image(machine(2, lines=3))
    with open_link(board) as link:
        assert not any(bytes.fromhex(link.greeting.image_hash))
    assert len(image_bytes(first)) > 300_000  # it comes in parts
    assert program(board.endpoint, first) == first.image_hash
    assert program(board.endpoint, second) == second.image_hash
    with open_link(board) as link:
        assert link.read_block(rm.IMAGE_HASH, 8).hex() == link.greeting.image_hash == second.image_hash
        assert link.read32(rm.CAP_LINES) == 3
        assert link.read32(rm.PROGRAMMED) == 2


def test_a_link_over_tcp_waits_for_the_end_of_the_one_before(start_board, monkeypatch):
    # two connections have no order on a network: the former one's end may come after the next one's beginning
    board = start_board(tcp_endpoint())
    former = open_link(board)
    assert former.read32(rm.ID) == rm.ID_VALUE
    # the former one ends when the next one has been refused and is about to try again
    monkeypatch.setattr(socket_link, "_ENDS_S", PATIENCE)
    clock = SimpleNamespace(monotonic=time.monotonic, sleep=lambda _: former.close())
    monkeypatch.setattr(socket_link, "time", clock)
    with open_link(board) as link:
        assert former.fileno() == -1
        assert link.read32(rm.ID) == rm.ID_VALUE


def test_the_loader_is_refused_while_a_host_holds_the_board(start_board):
    board = programmed(start_board, MACHINE)
    with open_link(board) as link:
        assert link.read32(rm.PROGRAMMED) == 1
        with pytest.raises(errors.HeldError):
            program(board.endpoint, image(machine(2)))
        # before the loader sends the file
        with open_programming(board) as loader, pytest.raises(errors.HeldError):
            begin(loader, 12, hashlib.sha256(words(1, 2, 3)).digest())
        assert link.read32(rm.PROGRAMMED) == 1
    assert program(board.endpoint, image(machine(2))) == image(machine(2)).image_hash


def test_one_loader_at_a_time(start_board):
    board = start_board()
    first = open_programming(board)
    first.read32(rm.ID)
    with pytest.raises(errors.HeldError):
        program(board.endpoint, image(MACHINE))
    first.close()
    program(board.endpoint, image(MACHINE))


def test_a_loader_that_says_nothing_loses_its_turn(start_board, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(board_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    board = start_board()
    silent = open_programming(board)
    for _ in range(2):
        silent.read32(rm.ID)
        open_link(board).close()  # a greeting shows that the board has noted the time of the frame before
        now[0] += board_module.PROGRAMMING_SILENCE_S
        with pytest.raises(errors.HeldError):
            program(board.endpoint, image(MACHINE))
    now[0] += 1
    open_link(board).close()  # the board looks at its clock when something happens
    with pytest.raises(errors.LinkClosedError):
        wait_done(silent, 1)
    program(board.endpoint, image(MACHINE))


def test_a_loader_keeps_its_turn_while_the_board_loads_for_long(start_board, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(board_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    load = EmulatedBoard.load

    def slow(self, content):
        load(self, content)
        now[0] += board_module.PROGRAMMING_SILENCE_S + 1

    monkeypatch.setattr(EmulatedBoard, "load", slow)
    assert program(start_board().endpoint, image(MACHINE)) == image(MACHINE).image_hash


def begin(link, size, digest):
    payload = framing.ProgramBegin(size=size, sha256=digest, token=framing.NO_TOKEN).encode()
    link.request(framing.PROGRAM, framing.BEGIN, 0, len(payload) // 4, payload)


def open_programming(board):
    return SocketLink.open(parse_endpoint(board.endpoint).programming, timeout=PATIENCE)


def foreign(content):
    """A file for another register map."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rm, "MAP_SHA256", "77" * 32)
        return image_bytes(image(MACHINE))


@pytest.mark.parametrize(
    ("announced", "sent"),
    [(bytes, lambda content: content[:-4] + bytes(4)), (foreign, foreign)],
    ids=["changed on the way", "for another map"],
)
def test_a_file_that_no_loader_has_checked_is_checked_by_the_board(start_board, announced, sent):
    content = image_bytes(image(MACHINE))
    announced_content, sent_content = announced(content), sent(content)
    with open_programming(start_board()) as link:
        begin(link, len(announced_content), hashlib.sha256(announced_content).digest())
        padded = sent_content + bytes(-len(sent_content) % 4)
        link.request(framing.PROGRAM, 0, 0, len(padded) // 4, padded)
        with pytest.raises(errors.AccessError):
            link.request(framing.PROGRAM, framing.END, len(sent_content), 0)
        assert link.read_block(rm.IMAGE_HASH, 8) == bytes(32)


def test_the_loader_refuses_a_file_for_another_map(start_board, folder):
    (folder / "other.bm").write_bytes(foreign(b""))
    with pytest.raises(errors.ImageMismatchError):
        program(start_board().endpoint, folder / "other.bm")


def test_the_programming_port_takes_no_registers_writes_no_part_out_of_turn_and_no_endless_file(start_board):
    board = start_board()
    with open_programming(board) as link, refused(ErrorCode.BAD_FRAME):
        link.write32(rm.CONTROL, 1)
    with open_programming(board) as link, refused(ErrorCode.BAD_FRAME):
        link.request(framing.PROGRAM, 0, 0, 1, words(1))
    with open_programming(board) as link, pytest.raises(errors.AccessError):
        begin(link, 2**40, hashlib.sha256().digest())
    for second in (0, 8):  # repeated, and lost
        with open_programming(board) as link:
            begin(link, 12, hashlib.sha256(words(1, 2, 3)).digest())
            link.request(framing.PROGRAM, 0, 0, 1, words(1))
            with refused(ErrorCode.BAD_FRAME):
                link.request(framing.PROGRAM, 0, second, 1, words(2))


def test_a_host_that_opens_the_board_during_a_transfer_keeps_it(start_board):
    board = start_board()
    content = image_bytes(image(MACHINE))
    with open_programming(board) as loader, open_link(board) as host:
        begin(loader, len(content), hashlib.sha256(content).digest())
        loader.post_part(0, content + bytes(-len(content) % 4))
        assert host.read32(rm.PROGRAMMED) == 0
        with pytest.raises(errors.HeldError):
            loader.request(framing.PROGRAM, framing.END, len(content), 0)
        assert host.read_block(rm.IMAGE_HASH, 8) == bytes(32)


# ---- the loader ----


def test_a_damaged_or_missing_file_is_refused_before_the_board_is_touched(folder):
    nowhere = f"unix:{folder}/nobody.sock"
    path = folder / "board0.bm"
    with pytest.raises(errors.ImageError):
        program(nowhere, path)
    path.write_bytes(image_bytes(image(machine(1)))[:-2] + b"xx")
    with pytest.raises(errors.DamagedImageError):
        program(nowhere, path)


def test_a_board_that_does_not_become_what_was_loaded_is_an_error(start_board, monkeypatch):
    board = start_board()
    good = SocketLink.read_block

    def other(link, address, count):
        return bytes(4 * count) if address == rm.IMAGE_HASH else good(link, address, count)

    monkeypatch.setattr(SocketLink, "read_block", other)
    with pytest.raises(errors.ImageMismatchError):
        program(board.endpoint, image(machine(1)))
