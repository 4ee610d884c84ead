"""Boards whose hardware is simulated by GHDL, compared with emulated ones, and their failures.

MiniCluster --link--> board --engine ghdl --pipe--> GHDL
RtlBoard and EmulatedBoard: the same accesses
"""

import contextlib
import errno
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from machines.bm1 import StopReason
from machines.bm1_kind import BM1
from machines.kind import FrameInput
from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from pcie_shim import register_map as rm
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.errors import AccessError, BoardError, SimulationError
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.programming_file import image_bytes
from pcie_shim.register_layout import next_doorbell
from pcie_shim.register_map import ErrorCode
from services.boards.hardware import Engine, SimulatedHardware
from services.commands.board import app
from tests.command_runner import invoke
from tests.patience import PROCESS_PATIENCE
from tests.pcie_shim.boards import expected, image, images, machine, never_stopping
from toolchain import hardware

needs_ghdl = pytest.mark.skipif(
    shutil.which("ghdl") is None, reason="ghdl is not installed (Debian: apt-get install ghdl)"
)


def simulating(test):
    """Mark a test that compiles hardware."""
    return pytest.mark.thorough(needs_ghdl(test))


NOT_COMPARED = {
    *range(rm.CAP_SPEED, rm.CAP_SPEED + 4),
    *range(rm.COMPUTE_NS, rm.COMPUTE_NS + 8),
    rm.STATUS + 1,  # the hardware's error is that of a single word; the answers to accesses show the code
}


@pytest.fixture(scope="module")
def compiled_into(tmp_path_factory):
    """The folder of compiled hardware."""
    return tmp_path_factory.mktemp("hardware")


@contextlib.contextmanager
def serving(folder, compiled_into, count=1):
    """Processes of the command `board --engine ghdl`, and their endpoints."""
    endpoints = [f"unix:{folder}/board{at}.sock" for at in range(count)]
    boards = []
    try:
        for at, endpoint in enumerate(endpoints):
            command = [str(Path(sys.executable).with_name("board")), "--listen", endpoint, "--index", str(at)]
            boards.append(
                subprocess.Popen(
                    [*command, "--engine", "ghdl", "--hardware", str(compiled_into)],
                    stderr=subprocess.PIPE,
                    text=True,
                    env=os.environ | {"BM_RUN_DIRECTORY": str(folder)},
                )
            )
        for board in boards:
            assert select.select([board.stderr], [], [], PROCESS_PATIENCE)[0]
            assert "listens" in board.stderr.readline()
        yield boards, endpoints
    finally:
        for board in boards:
            board.terminate()
            board.communicate(timeout=PROCESS_PATIENCE)


@simulating
def test_frames_over_the_link_are_the_same(tmp_path, compiled_into):
    parts = images(3, [5, 3], sensor_bits=(3, 4), prior_bits=1)
    random = np.random.default_rng(1)
    reasons = set()
    # programming does not wait for a compilation on a busy machine
    SimulatedHardware(Engine.GHDL, compiled_into, dict(enumerate(parts)))
    with serving(tmp_path, compiled_into, 2) as (boards, endpoints):
        with MiniCluster.open(endpoints, parts) as cluster:
            for number in range(12):
                addresses = [None if random.random() < 0.2 else int(random.integers(top)) for top in (7, 15)]
                frame = FrameInput(
                    addresses=tuple(addresses),
                    prior_address=number % 2,
                    target_count=int(random.integers(1, 256)),
                    max_cycles=int(random.choice([100, 1500, 1 << 17])),
                    bank=number % 16,
                    stop="own" if number % 3 == 0 and number < 9 else "slices",
                )
                output = cluster.run(frame)
                found = [(list(board.counts), board.cycles, board.reason) for board in output.boards]
                assert found == expected(parts, frame)
                reasons.update(board.reason for board in output.boards)
        assert {StopReason.OVERFLOW, StopReason.MAX_CYCLES} <= reasons
        hardware = [child.pid for board in boards for child in psutil.Process(board.pid).children()]
        assert len(hardware) == 2
    for board in boards:
        assert board.returncode == 128 + signal.SIGTERM
    assert not any(psutil.pid_exists(pid) for pid in hardware)


@simulating
def test_a_killed_simulation_is_an_error_of_the_board(tmp_path, compiled_into):
    part = image(never_stopping())
    SimulatedHardware(Engine.GHDL, compiled_into, {0: part})
    with serving(tmp_path, compiled_into) as ((board,), endpoints):
        with MiniCluster.open(endpoints, [part]) as cluster:
            (hardware,) = psutil.Process(board.pid).children()
            cluster.post(FrameInput(addresses=(1,), target_count=2**32 - 1, max_cycles=1 << 40))
            hardware.kill()
            with pytest.raises(BoardError):
                cluster.collect(PROCESS_PATIENCE)
        assert board.wait(PROCESS_PATIENCE) == 5
        errors = [line for line in board.stderr.read().splitlines() if "error: " in line]
        assert len(errors) == 1
        assert f"signal {int(signal.SIGKILL)}" in errors[0]


@simulating
def test_the_simulation_ends_with_a_killed_board(tmp_path, compiled_into):
    part = image(never_stopping())
    SimulatedHardware(Engine.GHDL, compiled_into, {0: part})
    with (
        serving(tmp_path, compiled_into) as ((board,), endpoints),
        MiniCluster.open(endpoints, [part]) as cluster,
    ):
        (hardware,) = psutil.Process(board.pid).children()
        cluster.post(FrameInput(addresses=(1,), target_count=2**32 - 1, max_cycles=1 << 40))
        board.kill()
        board.wait(PROCESS_PATIENCE)
        hardware.wait(PROCESS_PATIENCE)


def both_boards(of, compiled_into):
    """An emulated and a simulated board with an image."""
    content = image_bytes(image(of))
    simulated = SimulatedHardware(Engine.GHDL, compiled_into, {}).board(0)
    emulated = EmulatedBoard(sends_results=False)
    for board in (emulated, simulated):
        deadline = time.monotonic() + PROCESS_PATIENCE
        while True:
            try:
                board.load(content)
                break
            except RefusedError as error:
                assert error.code == ErrorCode.BUSY
                assert time.monotonic() < deadline
    return emulated, simulated


def compared(words, address):
    """Pairs of address and byte, of those that both boards must have."""
    return [pair for pair in enumerate(words, start=address) if pair[0] not in NOT_COMPARED]


def answer_blocks(of, board):
    """The address and the words of each block that a host reads from a board that has stopped."""
    answer = BM1.registers(of.parameters).answer
    return [(rm.BLOCKS[name], board.read(rm.BLOCKS[name], count)) for name, count in answer.items()]


def answered(board, access, *arguments):
    """The data of an access, or the code with which it is refused."""
    try:
        return getattr(board, access)(*arguments)
    except RefusedError as error:
        return error.code


@simulating
@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"prior_mode": PriorMode.WRITTEN, "rng": RngKind.LFSR16, "rng_reset": RngReset.FREE},
        {"sensor_mode": SensorMode.CELL, "replicas": 2, "lines": 4},
    ],
    ids=["plain", "written prior", "replicas of cells"],
)
def test_accesses_are_answered_and_refused_alike(parameters, compiled_into):
    of = machine(5, **parameters)
    plain = of.parameters.sensor_mode is SensorMode.COLUMN
    inputs = rm.SENSORS if plain else rm.INPUTS
    words = int(np.prod(of.parameters.input_shape))
    emulated, simulated = both_boards(of, compiled_into)
    random = np.random.default_rng(2)
    places = [
        *rm.BLOCKS.values(),
        *(inputs, inputs + 4 * 19, inputs + 4 * 21),
        *(rm.RESULTS, rm.RESULTS + 4 * 1199, rm.RESULTS + 4 * 1200),
        *(rm.PRIOR_CODES, rm.PRIOR_SELECTS, rm.OUTCOMES, rm.ID + 2, rm.BAR_SIZE - 4, rm.BAR_SIZE, 0xFFFFFFFC),
    ]
    refused = set()
    with contextlib.closing(simulated):
        for turn in range(240):
            if turn % 24 == 0:
                drawn = random.integers(0, 1 << min(of.parameters.sensor_bits), words)
                frame = [
                    (inputs, drawn.tolist()),
                    (rm.TARGET_COUNT, [int(random.integers(1, 100)), 400, 0, turn // 24, 0]),
                    (rm.RUN_UNTIL, [0, 0, next_doorbell(emulated.done), 0]),
                ]
                accesses = [("write", at, struct.pack(f"<{len(row)}I", *row)) for at, row in frame]
            else:
                place, count = int(random.choice(places)), int(random.choice([1, 1, 2, 5]))
                # a burst of zeros contains no doorbell, and is refused before its first word or not at all
                accesses = [("read", place, count), ("write", place, bytes(4))]
            for access in accesses:
                found, wanted = answered(simulated, *access), answered(emulated, *access)
                assert isinstance(found, type(wanted)), (access, found, wanted)
                if isinstance(wanted, bytes):
                    assert compared(found, access[1]) == compared(wanted, access[1]), access
                else:
                    assert found == wanted, access
                if isinstance(wanted, ErrorCode):
                    refused.add(wanted)
                for board in (emulated, simulated):
                    while board.running:
                        board.step()
            assert simulated.done == emulated.done
            for address, found in [(rm.DONE, simulated.interrupt_words()), *answer_blocks(of, simulated)]:
                wanted = emulated.read(address, len(found) // 4)
                assert compared(found, address) == compared(wanted, address)
    assert emulated.done == 10
    assert {ErrorCode.OUTSIDE, ErrorCode.TOO_LONG, ErrorCode.READ_ONLY, ErrorCode.MISALIGNED} <= refused


@simulating
def test_a_running_board_is_busy_until_it_is_released(compiled_into):
    emulated, simulated = both_boards(never_stopping(), compiled_into)
    with contextlib.closing(simulated):
        for board in (emulated, simulated):
            board.write(rm.TARGET_COUNT, struct.pack("<IQIIQI", 2**32 - 1, 2**40, 0, 0, 0, 1))
            assert board.running
            assert answered(board, "write", rm.BANK, bytes(4)) == ErrorCode.BUSY
            assert answered(board, "load", b"") == ErrorCode.BUSY
            board.step()
            assert board.running
            board.release()
            assert not board.running
            assert not board.interrupt_enabled
            assert board.done == 0


@simulating
def test_an_image_that_is_loaded_again_replaces_the_hardware(compiled_into):
    first, second = image(machine(1)), image(machine(2))
    board = SimulatedHardware(Engine.GHDL, compiled_into, {0: first}).board(0)
    with contextlib.closing(board):
        board.prepare(first)
        for number, part in enumerate((first, second, second), start=1):
            while answered(board, "load", image_bytes(part)) == ErrorCode.BUSY:
                pass
            assert board.image_hash == part.image_hash
            assert board.read(rm.IMAGE_HASH, 8).hex() == part.image_hash
            assert int.from_bytes(board.read(rm.PROGRAMMED, 1), "little") == board.programmed == number


@simulating
def test_a_machine_that_exists_only_emulated_is_refused(tmp_path, compiled_into):
    ideal = image(machine(1, rng=RngKind.IDEAL))
    with pytest.raises(SimulationError):
        SimulatedHardware(Engine.GHDL, compiled_into, {0: ideal})
    with serving(tmp_path, compiled_into) as (_, endpoints), pytest.raises(BoardError) as raised:
        MiniCluster.open(endpoints, [ideal])
    assert not isinstance(raised.value.__cause__, AccessError)
    assert raised.value.exit_code == 2


@pytest.mark.parametrize("engine", ["rtl", "ghdl", "verilator"])
def test_missing_tools_are_named(tmp_path, monkeypatch, engine):
    monkeypatch.setenv("PATH", str(tmp_path))
    command = ["--engine", engine, "--listen", f"unix:{tmp_path}/a.sock"]
    assert "--hardware DIR" in invoke(app, command).stderr
    ended = invoke(app, [*command, "--hardware", tmp_path / "hardware"])
    assert ended.exit_code == 2
    assert "apt-get install ghdl" in ended.stderr
    assert ("verilator g++" in ended.stderr.replace("make ", "")) == (engine == "verilator")


@needs_ghdl
def test_a_folder_of_others_is_not_used(tmp_path):
    tmp_path.chmod(0o777)
    with pytest.raises(SimulationError):
        SimulatedHardware(Engine.GHDL, tmp_path, {0: image(machine(1))})


@simulating
def test_a_full_disk_is_an_error_of_the_board(tmp_path, monkeypatch):
    def write(*_):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(hardware, "write_board_files", write)
    with pytest.raises(SimulationError) as raised:
        SimulatedHardware(Engine.GHDL, tmp_path / "hardware", {0: image(machine(1))})
    assert str(tmp_path) in str(raised.value)
