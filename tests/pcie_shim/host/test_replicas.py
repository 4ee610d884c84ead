"""Boards with replicas and with inputs per cell: their results equal those of machines that run alone, to the bit."""

import contextlib
import dataclasses
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.bm1 import StopReason
from machines.kind import OUTCOME, FrameInput
from machines.parameters import PriorMode, SensorMode
from pcie_shim import register_map as rm
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.endpoint import parse_endpoint
from pcie_shim.errors import FrameInputError, FramingError, ImageMismatchError, LinkClosedError
from pcie_shim.host.driven_board import DrivenBoard
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.programming_file import Image, image_bytes
from pcie_shim.register_map import ErrorCode
from tests.patience import PATIENCE
from tests.pcie_shim.boards import (
    board_fails,
    done_by,
    expected_of_replicas,
    image,
    images,
    loaded,
    machine,
    opened,
    refused,
    words,
)

JOINT_ORDER = (StopReason.OVERFLOW, StopReason.MAX_CYCLES, StopReason.IMPOSSIBLE, StopReason.SLICE)


@dataclasses.dataclass
class Case:
    """Boards that hold the parts of one model with several machines, or with an input for each cell."""

    parts: list[Image]
    cluster: MiniCluster

    @property
    def shape(self):
        """Of a frame's inputs, over all boards."""
        parameters = self.parts[0].machine.parameters
        lines = self.parts[0].partition.total_lines
        return dataclasses.replace(parameters, lines=lines).input_shape

    def frame(self, seed, **changed):
        parameters = self.parts[0].machine.parameters
        random = np.random.default_rng(seed)
        tops = (1 << np.array(parameters.sensor_bits)) - parameters.has_tables
        tops = tops if parameters.sensor_mode is SensorMode.COLUMN else tops[:, np.newaxis]
        inputs = random.integers(0, tops, self.shape)
        if not parameters.has_tables:
            inputs = np.where(random.random(self.shape) < 0.8, inputs | 128, inputs)
        columns = inputs.reshape(parameters.replicas * parameters.sensors, -1)
        columns[random.random(len(columns)) < 0.3] = -1
        settings_ = {"target_count": 100, "max_cycles": 3000} | changed
        return FrameInput(addresses=inputs, **settings_)

    def check(self, frame):
        output = self.cluster.run(frame)
        wanted = expected_of_replicas(self.parts, frame)
        for number, board in enumerate(output.boards):
            if len(wanted) == 1:
                assert (board.counts.tolist(), board.cycles, board.reason) == wanted[0][number]
                continue
            assert [
                (board.counts[at].tolist(), board.replica_cycles[at], board.replica_reasons[at])
                for at in range(len(wanted))
            ] == [of_replica[number] for of_replica in wanted]
            assert board.cycles == max(board.replica_cycles)
            assert board.reason == next(each for each in JOINT_ORDER if each in board.replica_reasons)
        return output


CASES = {
    "three replicas on one board": images(1, (6,), replicas=3, zeros=0.2),
    "33 replicas on two boards": images(2, (3, 2), replicas=33, zeros=0.25, prior_bits=1),
    "cells on two boards": images(3, (4, 3), sensor_mode=SensorMode.CELL),
    "cells in replicas": images(4, (4, 3), sensor_mode=SensorMode.CELL, replicas=3, rng="ideal"),
    "thresholds": images(5, (5, 4), sensor_mode=SensorMode.THRESHOLD, sensor_bits=(8, 8), replicas=2),
    "written priors": images(6, (3, 3), replicas=2, prior_mode=PriorMode.WRITTEN, zeros=0),
}


@pytest.fixture(scope="module", params=CASES, ids=str)
def case(request):
    """Boards opened once for many frames."""
    parts = CASES[request.param]
    # a host that reads OUTCOMES must see the same as one that gets them with the interrupt
    sends_results = request.param != "33 replicas on two boards"
    with opened(parts, sends_results=sends_results) as cluster:
        yield Case(parts, cluster)


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 2**31),
    st.integers(1, 255) | st.just(255),
    st.integers(1, 600) | st.sampled_from([256, 513, 4096, 2**16]),
    st.integers(0, 15),
    st.sampled_from(["slices", "own"]),
)
def test_frames_are_machines_that_run_alone(case, seed, target, cycles, bank, stop):
    parameters = case.parts[0].machine.parameters
    random = np.random.default_rng(seed)
    changed: dict = {}
    if parameters.prior_bits:
        changed["prior_address"] = tuple(random.integers(0, 2, parameters.replicas).tolist())
    if parameters.prior_mode is PriorMode.WRITTEN and seed % 3:
        shape = (parameters.replicas, 6) if seed % 3 == 1 else (6,)
        changed["prior_codes"] = random.integers(0, 256, shape).astype(np.uint16)
    case.check(case.frame(seed, target_count=target, max_cycles=cycles, bank=bank, stop=stop, **changed))


def test_each_replica_stops_with_its_own_parts():
    """Replicas that lie on two boards: one may be over in the first slice, another goes on."""
    parts = images(7, (3, 3), replicas=8, zeros=0)
    with opened(parts) as cluster:
        case = Case(parts, cluster)
        output = case.check(case.frame(3, target_count=255, max_cycles=2**17))
    ends = {
        board.replica_cycles[at]
        for board in output.boards
        for at in range(8)
        if board.replica_reasons[at] == StopReason.SLICE
    }
    assert len(ends) > 1
    assert output.slices > 1


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("three replicas on one board", {"addresses": (1, 2)}),
        ("three replicas on one board", {"addresses": np.zeros((3, 2))}),
        ("three replicas on one board", {"addresses": np.array([[0, 0], [0, 16], [0, 0]])}),
        ("three replicas on one board", {"prior_address": (0, 0)}),
        ("three replicas on one board", {"prior_address": (0, 0, 1)}),
        ("three replicas on one board", {"prior_address": (0, -1, 0)}),
        ("cells on two boards", {"addresses": np.array([[-1, -1, -1, -1, -1, -1, 0], [0] * 7])}),
        ("thresholds", {"addresses": np.full((2, 2, 9), 256)}),
        ("written priors", {"prior_codes": np.zeros((3, 6), np.uint16)}),
    ],
)
def test_a_frame_that_does_not_fit_is_refused(name, change):
    case = Case(CASES[name], MiniCluster.__new__(MiniCluster))
    boards = [DrivenBoard(at, parse_endpoint("unix:/tmp/x.sock"), part) for at, part in enumerate(case.parts)]
    case.cluster.__init__(boards, timeout=1, slack=1)
    with pytest.raises(FrameInputError):
        case.cluster.post(dataclasses.replace(case.frame(1), **change))


def test_a_replaced_board_gets_the_prior_selects_again(start_board):
    parts = images(8, (4,), replicas=2, prior_bits=1, zeros=0)
    board = start_board()
    with MiniCluster.open([board.endpoint], parts, timeout=PATIENCE) as cluster:
        case = Case(parts, cluster)
        frame = case.frame(1, prior_address=(1, 0), target_count=255, max_cycles=2**17)
        # no other board decides about the replicas of the only one
        assert case.check(frame).slices == 1
        board.stop()
        with board_fails(LinkClosedError):
            cluster.run(frame)
        start_board(board.endpoint)
        cluster.reopen(0)
        case.check(frame)


# ---- images and capabilities ----


def test_capabilities_and_windows():
    of = machine(1, lines=5, sensor_bits=(3, 2), replicas=3, sensor_mode=SensorMode.CELL, prior_bits=1)
    board = EmulatedBoard()
    with pytest.raises(RefusedError):
        board.read(rm.INPUTS, 1)
    board.load(image_bytes(dataclasses.replace(image(of), interface_sensors=40, interface_results=16)))
    assert board.read(rm.CAP_REPLICAS, 1) == words(3)
    assert board.read(rm.CAP_INTERFACE, 1) == words(40 | 16 << 16)
    assert len(board.read(rm.INPUTS, 40)) == 160
    assert len(board.read(rm.RESULTS, 16)) == 64
    assert len(board.read(rm.PRIOR_SELECTS, 3)) == 12
    for address, count in ((rm.INPUTS, 41), (rm.RESULTS, 17), (rm.PRIOR_SELECTS, 4), (rm.OUTCOMES, 13)):
        with refused(ErrorCode.TOO_LONG):
            board.read(address, count)
    with pytest.raises(RefusedError):
        board.read(rm.SENSORS, 1)


def test_a_replica_that_is_not_there_is_not_halted():
    """Run a frame as a host in any language would: inputs, settings, start, outcomes."""
    board = loaded(image(machine(2, lines=4, sensor_bits=(3,), replicas=2, zeros=0)))
    board.write(rm.INPUTS, words(2, 5))
    board.write(rm.TARGET_COUNT, struct.pack("<IQIIQ", 255, 2**17, 3, 0, 128))
    board.write(rm.START, words(1))
    assert board.read(rm.OUTCOMES, 8) == words(3, 0, 128, 0, 3, 0, 128, 0)
    assert len(board.interrupt_words()) == 24 + 4 * 8 + 16 * 2
    board.write(rm.HALT, words(0b1000))  # of no replica that there is
    board.write(rm.RUN_UNTIL, struct.pack("<Q", 0))
    with refused(ErrorCode.BAD_VALUE):
        board.write(rm.RESUME, words(2))
    board.reset()
    assert board.read(rm.OUTCOMES, 8) == bytes(32)


@pytest.mark.parametrize(("replicas", "inputs"), [(2, 4), (3, 5000)])
def test_a_board_of_other_capabilities_is_refused(start_board, monkeypatch, replicas, inputs):
    """A board that shows the right image hash and has fewer machines or words all the same."""
    (part,) = CASES["three replicas on one board"]
    endpoints = [start_board().endpoint]
    MiniCluster.open(endpoints, [part]).close()
    parameters = dataclasses.replace(part.machine.parameters, replicas=replicas)
    other = dataclasses.replace(part, machine=dataclasses.replace(part.machine, parameters=parameters))
    known = part.image_hash
    monkeypatch.setattr(Image, "image_hash", property(lambda _: known))
    registers = dataclasses.replace(other.registers, input_words=inputs)
    monkeypatch.setattr(Image, "registers", property(lambda _: registers))
    with board_fails(ImageMismatchError):
        MiniCluster.open(endpoints, [other])


@pytest.mark.parametrize("reason", [StopReason.MAX_CYCLES, StopReason.NONE, 99])
def test_a_replica_that_stopped_for_an_unknown_reason_breaks_the_link(reason):
    part = images(1, (3,), replicas=2)[0]
    board = DrivenBoard(0, parse_endpoint("unix:/nowhere"), part)
    board.waiting = board.sends_results = True
    outcomes = np.array([(StopReason.MAX_CYCLES, 0, 9), (reason, 0, 9)], OUTCOME).tobytes()
    results = bytes(4 * part.registers.result_words)
    board._take(done_by(board, StopReason.MAX_CYCLES, results + outcomes))
    is_known = reason is StopReason.MAX_CYCLES
    with contextlib.nullcontext() if is_known else pytest.raises(FramingError, match="replica"):
        board.fetch()
