"""The emulated board without sockets: its registers, the accesses that it refuses, and its machine."""

import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines import make_kernel
from machines.bm1 import Start, StopReason
from machines.parameters import CYCLES_MAX, PriorMode, RngKind, RngReset
from pcie_shim import register_map as rm
from pcie_shim.board import emulated_board
from pcie_shim.board.emulated_board import CHUNK_S, EmulatedBoard, RefusedError
from pcie_shim.programming_file import image_bytes
from pcie_shim.register_layout import field_of, next_doorbell
from pcie_shim.register_map import BoardState, ErrorCode
from tests.pcie_shim.boards import finish, image, loaded, machine, never_stopping, refused, words

MACHINE = machine(1)


@pytest.fixture
def board():
    """A programmed board."""
    return programmed(MACHINE)


def programmed(of):
    return loaded(image(of, total=100, offset=3, count=5, index=2))


def read(board, address):
    return struct.unpack("<I", board.read(address, 1))[0]


def read64(board, address):
    return struct.unpack("<Q", board.read(address, 2))[0]


def status(board):
    value = read(board, rm.STATUS)
    return BoardState(value & 15), StopReason(value >> 4 & 15), ErrorCode(value >> 8 & 255)


def configure(board, *, target=20, max_cycles=5000, bank=0, prior=0, until=0):
    board.write(rm.TARGET_COUNT, struct.pack("<IQIIQ", target, max_cycles, bank, prior, until))


def start(board, *addresses, number=0, **settings_):
    board.write(rm.SENSORS, words(*addresses))
    configure(board, **settings_)
    board.write(rm.START, words(number or next_doorbell(board.done)))


# ---- identity and capabilities ----


def test_a_blank_board_identifies_itself_and_computes_nothing():
    board = EmulatedBoard()
    assert board.turned == 0.0
    assert read(board, rm.ID).to_bytes(4, "little") == b"BM01"
    board.write(rm.LIVENESS, words(0x1234ABCD))
    assert read(board, rm.LIVENESS) == 0xEDCB5432
    assert read(board, rm.MAP_VERSION) == rm.MAP_VERSION_VALUE
    assert board.read(rm.MAP_HASH, 8).hex() == rm.MAP_SHA256
    assert board.read(rm.IMAGE_HASH, 8) == bytes(32)
    assert status(board) == (BoardState.BLANK, StopReason.NONE, ErrorCode.NONE)
    assert read(board, rm.CAP_MACHINE) == read(board, rm.PROGRAMMED) == 0
    for address in (rm.SENSORS, rm.RESULTS, rm.PRIOR_CODES):
        with refused(ErrorCode.BLANK):
            board.read(address, 1)
    with refused(ErrorCode.BLANK):
        board.write(rm.START, words(1))
    board.write(rm.CONTROL, words(rm.CONTROL_RESET_MASK))
    assert status(board)[0] is BoardState.BLANK


def test_capabilities_are_the_images():
    of = machine(
        2, lines=5, sensor_bits=(2, 3, 4, 5, 6), prior_bits=1, counter_bits=12, rng=RngKind.LFSR24,
        rng_banks=3, rng_reset=RngReset.FREE, steps_per_clock=16, prob_bits=7,
    )  # fmt: skip
    board = programmed(of)
    found = read(board, rm.CAP_MACHINE)
    assert found & rm.CAP_MACHINE_KIND_MASK == 1
    assert field_of(rm.CAP_MACHINE_RNG_MASK, found) == 3
    assert found & rm.CAP_MACHINE_SHARED_MASK
    assert found & rm.CAP_MACHINE_FREE_MASK
    assert not found & rm.CAP_MACHINE_PRIOR_WRITTEN_MASK
    assert [read(board, at) for at in (rm.CAP_LINES, rm.CAP_TOTAL_LINES, rm.CAP_LINE_OFFSET)] == [5, 100, 3]
    assert read(board, rm.CAP_PARTITION) == 2 | 5 << 16
    assert read(board, rm.CAP_SENSORS) == 5
    assert read(board, rm.CAP_WIDTHS) == 7 | 12 << 8 | 1 << 16
    assert read(board, rm.CAP_BANKS) == 3
    assert read(board, rm.CAP_REPLICAS) == 1
    assert read(board, rm.CAP_STEPS) == 16
    assert read(board, rm.CAP_INTERFACE) == 20 | 1200 << 16
    assert board.read(rm.CAP_SENSOR_BITS, 2) == bytes([2, 3, 4, 5, 6, 0, 0, 0])
    assert read(board, rm.CAP_SPEED) > 0


# ---- access ----


@pytest.mark.parametrize(
    ("address", "count", "code"),
    [
        (rm.ID + 2, 1, ErrorCode.MISALIGNED), (rm.RESUME + 4, 1, ErrorCode.OUTSIDE),
        (rm.OUTCOMES, 1, ErrorCode.OUTSIDE), (rm.PRIOR_SELECTS, 1, ErrorCode.OUTSIDE),
        (rm.BAR_SIZE, 1, ErrorCode.OUTSIDE), (0xFFFFFFFC, 1, ErrorCode.OUTSIDE),
        (rm.ID, 0, ErrorCode.OUTSIDE), (rm.ID, 5, ErrorCode.TOO_LONG),
        (rm.ID, 0xFFFFFFFF, ErrorCode.TOO_LONG), (rm.SENSORS, 21, ErrorCode.TOO_LONG),
        (rm.RESULTS, 1201, ErrorCode.TOO_LONG), (rm.RESULTS + 4 * 1200, 1, ErrorCode.OUTSIDE),
        (rm.PRIOR_CODES, 1, ErrorCode.OUTSIDE), (rm.BAR_SIZE - 4, 2, ErrorCode.OUTSIDE),
        (rm.TARGET_COUNT + 1, bytes(4), ErrorCode.MISALIGNED),
        (rm.RESUME + 4, bytes(4), ErrorCode.OUTSIDE), (rm.SENSORS, b"", ErrorCode.OUTSIDE),
        (rm.START, bytes(12), ErrorCode.TOO_LONG), (rm.SENSORS, bytes(84), ErrorCode.TOO_LONG),
        (rm.ID, bytes(4), ErrorCode.READ_ONLY), (rm.RESULTS, bytes(4), ErrorCode.READ_ONLY),
        (rm.DONE, bytes(4), ErrorCode.READ_ONLY), (rm.LIVENESS, bytes(8), ErrorCode.READ_ONLY),
    ],
)  # fmt: skip
def test_accesses_outside_the_map_are_refused(board, address, count, code):
    """Reads of so many words, and writes of these bytes."""
    with refused(code):
        board.write(address, count) if isinstance(count, bytes) else board.read(address, count)
    assert status(board)[2] is code
    board.write(rm.CONTROL, words(rm.CONTROL_RESET_MASK))
    assert status(board)[2] is ErrorCode.NONE


@settings(max_examples=300)
@given(st.integers(0, 2 * rm.BAR_SIZE), st.integers(0, 5000), st.booleans(), st.integers(0, 0xFFFFFFFF))
def test_no_access_breaks_a_board(address, count, reading, value):
    board = SHARED_BOARD
    try:
        if reading:
            assert len(board.read(address, count)) == 4 * count
        else:
            board.write(address, words(value) * count)
    except RefusedError:
        pass
    for _ in range(3):
        board.step()
    board.reset()
    assert len(board._memory) == rm.BAR_SIZE
    assert read(board, rm.ID) == rm.ID_VALUE


SHARED_BOARD = loaded(image(MACHINE))


def test_settings_are_kept_over_a_reset(board):
    configure(board, target=7, max_cycles=2**40 + 3, bank=2, until=2**33)
    board.write(rm.SENSORS, words(1, 2))
    board.write(rm.CONTROL, words(rm.CONTROL_RESET_MASK))
    assert read(board, rm.TARGET_COUNT) == 7
    assert read64(board, rm.MAX_CYCLES) == 2**40 + 3
    assert read64(board, rm.RUN_UNTIL) == 2**33
    assert board.read(rm.SENSORS, 2) == words(1, 2)


def test_a_long_value_is_never_torn(board):
    board.done = 5
    board._publish(BoardState.RUNNING, StopReason.NONE, 0x1_FFFFFFFF)
    low = read(board, rm.CYCLES)
    board._publish(BoardState.RUNNING, StopReason.NONE, 0x2_00000000)
    assert low | read(board, rm.CYCLES + 4) << 32 == 0x1_FFFFFFFF
    # the latch serves one read
    assert read(board, rm.CYCLES + 4) == 2
    assert read64(board, rm.CYCLES) == 0x2_00000000


# ---- the machine ----


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_chunks_and_slices_do_not_change_a_bit(data):
    rng = data.draw(st.sampled_from(RngKind))
    of = machine(
        data.draw(st.integers(0, 99)),
        lines=data.draw(st.integers(1, 9)),
        sensor_bits=data.draw(st.lists(st.integers(1, 3), max_size=3)),
        rng=rng,
        prob_bits=7,
        shared=data.draw(st.booleans()),
        rng_reset=data.draw(st.sampled_from(RngReset)),
        prior_bits=data.draw(st.integers(0, 1)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emulated_board, "CHUNK_S", 1e-12)  # as short as chunks can be
        board = loaded(image(of))
        kernel = make_kernel(of)
        for _ in range(2):
            compare_a_frame(data, board, kernel)


def compare_a_frame(data, board, kernel):
    parameters = kernel.machine.parameters
    addresses = [data.draw(st.integers(0, (1 << bits) - 1)) for bits in parameters.sensor_bits]
    target = data.draw(st.integers(1, 255))
    max_cycles = data.draw(st.integers(1, 1500))
    bank = data.draw(st.integers(0, 15))
    prior = data.draw(st.integers(0, parameters.prior_addresses - 1))
    ends = sorted(data.draw(st.sets(st.integers(1, 1500), max_size=3)))
    kernel.start(
        Start(
            addresses=tuple(addresses),
            target_count=target,
            max_cycles=max_cycles,
            bank=bank,
            prior_address=prior,
        )
    )
    if addresses:
        board.write(rm.SENSORS, words(*addresses))
    configure(board, target=target, max_cycles=max_cycles, bank=bank, prior=prior, until=(ends or [0])[0])
    board.write(rm.START, words(next_doorbell(board.done)))
    rounds = finish(board)
    for end in [*ends[1:], 0]:
        if status(board)[1] is not StopReason.SLICE:
            break
        board.write(rm.RUN_UNTIL, struct.pack("<QII", end, 0, next_doorbell(board.done)))
        rounds += finish(board)
    assert board.read(rm.RESULTS, parameters.lines) == kernel.counts.tobytes()
    assert read64(board, rm.CYCLES) == kernel.cycles
    assert status(board)[1] is kernel.reason
    assert np.array_equal(board._machine._kernel.rng_state, kernel.rng_state)
    assert rounds >= kernel.cycles // 64 - len(ends) - 1


def test_a_long_run_is_cut_into_chunks_that_can_be_reset():
    board = programmed(never_stopping())
    start(board, 1, target=2**32 - 1, max_cycles=CYCLES_MAX)
    assert board.running
    first = read64(board, rm.CYCLES)
    board.step()
    assert read64(board, rm.CYCLES) > first > 0
    assert status(board) == (BoardState.RUNNING, StopReason.NONE, ErrorCode.NONE)
    for address, value in ((rm.TARGET_COUNT, 1), (rm.START, 1), (rm.CONTROL, 2), (rm.LIVENESS, 1)):
        with refused(ErrorCode.BUSY):
            board.write(address, words(value))
    with refused(ErrorCode.BUSY):
        board.load(image_bytes(image(MACHINE)))
    board.write(rm.CONTROL, words(rm.CONTROL_RESET_MASK))
    assert not board.running
    assert status(board) == (BoardState.IDLE, StopReason.NONE, ErrorCode.NONE)
    assert read64(board, rm.CYCLES) == read64(board, rm.COMPUTE_NS) == read(board, rm.DONE) == 0
    assert board.read(rm.RESULTS, 4) == bytes(16)
    # the number that never finished is still due, and a burst cannot ring twice
    configure(board, target=2**32 - 1, max_cycles=CYCLES_MAX)
    with refused(ErrorCode.DOORBELL):
        board.write(rm.START, words(1, 1))
    assert board.running


def test_a_chunk_takes_its_time_whatever_the_speed(monkeypatch):
    board = programmed(never_stopping())
    start(board, 1, target=2**32 - 1, max_cycles=CYCLES_MAX)
    for nanoseconds in (1_000, 20_000, 1_000):  # per cycle, of a clock that stands still between chunks
        clock = SimpleNamespace(perf_counter_ns=lambda each=nanoseconds: board._machine._kernel.cycles * each)
        monkeypatch.setattr(emulated_board, "time", clock)
        for _ in range(20):
            before = read64(board, rm.CYCLES)
            board.step()
        seconds = (read64(board, rm.CYCLES) - before) * nanoseconds * 1e-9
        assert 0.4 * CHUNK_S < seconds < 1.6 * CHUNK_S


def test_a_reset_restarts_the_rngs_and_keeps_done():
    of = machine(5, rng_reset=RngReset.FREE)
    board = programmed(of)
    start(board, 1, 1, max_cycles=100)
    first = board.read(rm.RESULTS, 8)
    start(board, 1, 1, max_cycles=100)
    assert board.read(rm.RESULTS, 8) != first
    board.write(rm.CONTROL, words(rm.CONTROL_RESET_MASK))
    assert read(board, rm.DONE) == 2
    start(board, 1, 1, max_cycles=100)
    assert board.read(rm.RESULTS, 8) == first


def test_doorbells_take_the_next_number_only(board):
    start(board, 1, 1)
    results = board.read(rm.RESULTS, 8)
    for number in (1, 3, 0xFFFFFFFF):
        with refused(ErrorCode.DOORBELL):
            board.write(rm.START, words(number))
    board.write(rm.START, words(0))
    assert read(board, rm.DONE) == read(board, rm.START) == 1
    assert board.read(rm.RESULTS, 8) == results
    board.done = 0xFFFFFFFF
    start(board, 1, 1, number=1)
    assert read(board, rm.DONE) == 1


def test_only_a_slice_can_be_resumed(board):
    with refused(ErrorCode.DOORBELL):
        board.write(rm.RESUME, words(1))
    start(board, 7, 15, target=255, max_cycles=5000, until=10)
    assert status(board)[1] is StopReason.SLICE
    for until in (10, 3):
        with refused(ErrorCode.BAD_VALUE):
            board.write(rm.RUN_UNTIL, struct.pack("<QII", until, 0, 2))
    board.write(rm.RUN_UNTIL, struct.pack("<QII", 0, 0, 2))
    assert read(board, rm.DONE) == read(board, rm.RESUME) == 2
    assert read(board, rm.START) == 1
    assert status(board)[1] is not StopReason.SLICE
    with refused(ErrorCode.DOORBELL):
        board.write(rm.RESUME, words(3))


@pytest.mark.parametrize(
    "bad",
    [
        {"addresses": (8, 0)}, {"target": 0}, {"target": 256}, {"max_cycles": 0}, {"max_cycles": 2**63},
        {"bank": 16}, {"prior": 1}, {"until": 2**63},
    ],
)  # fmt: skip
def test_impossible_values_are_refused_at_the_start(board, bad):
    with refused(ErrorCode.BAD_VALUE):
        start(board, *bad.pop("addresses", (1, 1)), **bad)
    assert status(board)[0] is BoardState.IDLE
    assert read(board, rm.DONE) == 0
    start(board, 1, 1)
    assert read(board, rm.DONE) == 1


def test_a_written_prior_is_the_images_until_it_is_written():
    of = machine(6, lines=5, prior_mode=PriorMode.WRITTEN, zeros=0)
    board = programmed(of)
    kernel = make_kernel(of)
    assert board.read(rm.PRIOR_CODES, 5) == of.prior[0].astype("<u4").tobytes()
    for codes in (None, np.array([0, 255, 1, 2, 200], np.uint16)):
        if codes is not None:
            board.write(rm.PRIOR_CODES, codes.astype("<u4").tobytes())
        start(board, 2, 2)
        kernel.start(Start(addresses=(2, 2), prior_codes=codes, target_count=20, max_cycles=5000))
        assert board.read(rm.RESULTS, 5) == kernel.counts.tobytes()
    with refused(ErrorCode.TOO_LONG):
        board.write(rm.PRIOR_CODES, bytes(24))
    wide = programmed(machine(6, lines=5, prior_mode=PriorMode.WRITTEN, prob_bits=16, zeros=0))
    for refusing, code in ((board, 256), (board, 65536), (wide, 0x1FFFF)):
        refusing.write(rm.PRIOR_CODES, words(code))
        with refused(ErrorCode.BAD_VALUE):
            start(refusing, 2, 2)
    wide.write(rm.PRIOR_CODES, words(0xFFFF))
    start(wide, 2, 2)


# ---- programming ----


def test_programming_again_makes_another_board(board):
    start(board, 1, 1)
    before = board.read(rm.IMAGE_HASH, 8)
    other = image(machine(9, lines=2, sensor_bits=(2,)))
    board.load(image_bytes(other))
    assert board.read(rm.IMAGE_HASH, 8).hex() == other.image_hash == board.image_hash
    assert board.read(rm.IMAGE_HASH, 8) != before
    assert read(board, rm.PROGRAMMED) == 2
    assert read(board, rm.DONE) == read(board, rm.START) == read(board, rm.TARGET_COUNT) == 0
    assert status(board) == (BoardState.IDLE, StopReason.NONE, ErrorCode.NONE)
    start(board, 1)
    assert read(board, rm.DONE) == 1


def test_programming_forgets_half_a_read_value(board):
    board._publish(BoardState.IDLE, StopReason.NONE, 0x1_FFFFFFFF)
    read(board, rm.CYCLES)
    board.load(image_bytes(image(MACHINE)))
    assert read(board, rm.CYCLES + 4) == 0


def test_a_bad_image_leaves_the_board_as_it_was(board):
    start(board, 1, 1)
    with refused(ErrorCode.BAD_IMAGE):
        board.load(image_bytes(image(MACHINE))[:-1])
    assert read(board, rm.PROGRAMMED) == read(board, rm.DONE) == 1


def test_measuring_the_speed_leaves_no_trace():
    of = machine(8, rng_reset=RngReset.FREE)
    board = programmed(of)
    fresh = make_kernel(of)
    fresh.reset()
    assert np.array_equal(board._machine._kernel.rng_state, fresh.rng_state)
