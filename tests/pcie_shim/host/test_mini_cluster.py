"""The mini-cluster against emulated boards: results equal the kernels' to the bit, and every fault is an error.

MiniCluster (the test's thread) ══ 4 links ══ 4 boards (a thread each)
"""

import contextlib
import dataclasses
import itertools
import os
import re
import select
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.bm1 import StopReason
from machines.kind import FrameInput, FrameSettings
from machines.parameters import PriorMode
from pcie_shim import errors
from pcie_shim import register_map as rm
from pcie_shim.board.emulated_board import EmulatedBoard
from pcie_shim.endpoint import Endpoint, parse_endpoint
from pcie_shim.host import mini_cluster
from pcie_shim.host.driven_board import DrivenBoard
from pcie_shim.host.loader import program
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.host.socket_link import SocketLink
from pcie_shim.register_map import BoardState
from tests.patience import PATIENCE, PROCESS_PATIENCE
from tests.pcie_shim.boards import (
    board_fails,
    done_by,
    endpoints_of,
    expected,
    image,
    images,
    machine,
    never_stopping,
    opened,
)

LINES = (5, 4, 4, 4)
PARTS = images(10, LINES, zeros=0.3)


def test_a_board_that_is_not_open_has_no_link_and_no_result():
    board = DrivenBoard(0, Endpoint(path="/nowhere"), PARTS[0])
    with pytest.raises(errors.LinkClosedError):
        board.receive()
    with pytest.raises(errors.SequenceError):
        board.result()


def outcome(output):
    return [(board.counts.tolist(), board.cycles, board.reason) for board in output.boards]


def frame(*addresses, **changed):
    given = {"target_count": 100, "max_cycles": 3000, "bank": 0, "stop": "slices"} | changed
    return FrameInput(addresses=addresses or (1, 2), **given)


addresses = st.tuples(st.none() | st.integers(0, 7), st.none() | st.integers(0, 15))
frames = st.builds(
    FrameInput,
    addresses=addresses,
    target_count=st.integers(1, 255) | st.just(255),
    max_cycles=st.integers(1, 600) | st.sampled_from([256, 257, 511, 512, 513, 4096]),
    bank=st.integers(0, 15),
    stop=st.sampled_from(["slices", "own"]),
)


# ---- to the bit ----


@pytest.fixture(scope="module", params=["unix", "tcp", "unix, results read"])
def cluster(request):
    """Four boards that misbehave in nothing, opened once for many frames."""
    sends_results = "read" not in request.param
    with opened(PARTS, tcp=request.param == "tcp", sends_results=sends_results) as cluster:
        assert all(board.sends_results is sends_results for board in cluster._boards)
        for board in () if sends_results else cluster._boards:
            os.set_blocking(board.link.fileno(), False)  # as uvloop does when it watches them
        yield cluster


@settings(max_examples=40, deadline=None)
@given(st.lists(frames, min_size=1, max_size=4))
def test_frames_are_the_kernels_to_the_bit(cluster, given_frames):
    for each in given_frames:
        assert outcome(cluster.run(each)) == expected(PARTS, each)


def test_a_frame_in_pieces_is_the_same_frame(cluster):
    whole = frame(5, 8, target_count=255, max_cycles=2**17)
    assert cluster.awaited is None
    with pytest.raises(errors.FrameInputError):
        cluster.collect(0)
    cluster.post(whole)
    with pytest.raises(errors.FrameInputError):
        cluster.post(whole)
    output = None
    while output is None:
        assert cluster.seconds_left > 0
        descriptor = cluster.awaited
        assert descriptor is not None
        assert select.select([descriptor], [], [], PATIENCE)[0]
        output = cluster.collect(0)
    assert output.slices > 1
    assert outcome(output) == expected(PARTS, whole)
    assert cluster.awaited is None
    assert outcome(cluster.run(whole)) == expected(PARTS, whole)


def test_an_output_says_how_each_board_ended_and_where_the_time_went(cluster, monkeypatch):
    # a clock that goes on by one each time the host looks at it
    ticks = itertools.count()
    clock = SimpleNamespace(monotonic=time.monotonic, perf_counter_ns=lambda: next(ticks))
    monkeypatch.setattr(mini_cluster, "time", clock)
    output = cluster.run(frame(None, None, target_count=255, max_cycles=2**17))
    kept = outcome(output)
    ends = {board.cycles for board in output.boards if board.reason == StopReason.SLICE}
    stopped = [board.cycles for board in output.boards if board.reason == StopReason.OVERFLOW]
    assert ends == {512 << output.slices - 1}
    assert 0 < max(stopped) <= min(ends)
    spent = output.register_writes_ns, output.compute_ns, output.reads_ns
    assert spent == (output.slices, output.slices, output.slices + 1)
    assert output.boards_compute_ns > 0
    cluster.run(frame(3, 4))  # the results are the caller's own
    assert outcome(output) == kept
    assert output.boards[0].counts.dtype == np.uint32
    assert output.boards[0].counts.flags.owndata


def test_all_boards_are_asked_for_their_results_before_any_is_waited_for(start_board, monkeypatch):
    parts = images(10, (3, 2, 2))
    boards = [start_board(index=at, sends_results=False) for at in range(3)]
    calls = []
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        for name in ("ask", "answers"):
            good = getattr(SocketLink, name)
            monkeypatch.setattr(
                SocketLink, name, lambda *given, good=good, name=name: calls.append(name) or good(*given)
            )
        assert outcome(cluster.run(frame(stop="own"))) == expected(parts, frame(stop="own"))
    assert calls == ["ask"] * 3 + ["answers"] * 3


def test_the_computing_times_of_the_slices_are_added(start_board, monkeypatch):
    times, take = [], DrivenBoard._take

    def taken(board, done):
        times.append(done.compute_ns)
        take(board, done)

    monkeypatch.setattr(DrivenBoard, "_take", taken)
    with MiniCluster.open([start_board().endpoint], [image(never_stopping())]) as cluster:
        output = cluster.run(FrameInput(addresses=(1,), target_count=255, max_cycles=2**17, stop="slices"))
    assert output.slices == len(times) > 1
    assert output.boards_compute_ns == sum(times)


@pytest.mark.parametrize(
    "bad",
    [
        {"target_count": 0}, {"target_count": 256}, {"max_cycles": 0}, {"bank": 16}, {"bank": -1},
        {"prior_address": 1}, {"prior_address": (0, 0)}, {"prior_codes": np.zeros(17, np.uint16)},
        {"stop": "line"}, {"addresses": (1,)}, {"addresses": (8, 0)}, {"addresses": (0, -1)},
    ],
)  # fmt: skip
def test_a_frame_that_does_not_fit_is_refused(cluster, bad):
    given_frame = {"addresses": (1, 1), "target_count": 5, "max_cycles": 10} | bad
    with pytest.raises(errors.FrameInputError) as caught:
        cluster.run(FrameInput(**given_frame))
    assert caught.value.exit_code == 2
    assert outcome(cluster.run(frame())) == expected(PARTS, frame())


@pytest.fixture
def boards(start_board):
    """Two blank boards."""
    return [start_board(index=index) for index in range(2)]


def written_addresses(cluster, monkeypatch):
    """Return a list to which the addresses of all writes of the first board will be added."""
    written: list[int] = []
    link = cluster._boards[0].link
    good = link.post

    def post(writes):
        written.extend(address for address, _ in writes)
        good(writes)

    monkeypatch.setattr(link, "post", post)
    return written


def test_written_priors_are_split_over_the_boards(boards, monkeypatch):
    parts = images(20, (3, 2), prior_mode=PriorMode.WRITTEN, zeros=0)
    random = np.random.default_rng(1)
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        written = written_addresses(cluster, monkeypatch)
        first = random.integers(1, 256, 5).astype(np.uint16)
        second = random.integers(1, 256, 5).astype(np.uint16)
        known = None
        for codes in (None, first, first, second, None, first):
            written.clear()
            given_frame = frame(prior_codes=codes)
            assert outcome(cluster.run(given_frame)) == expected(parts, given_frame)
            assert (rm.PRIOR_CODES in written) is (codes is not known or codes is None)
            known = codes
        first[:] = second  # changed in place, after it was written
        assert outcome(cluster.run(given_frame)) == expected(parts, given_frame)
        for codes in (first[:4], np.full(5, 256, np.uint16)):
            with pytest.raises(errors.FrameInputError):
                cluster.run(frame(prior_codes=codes))


def test_what_did_not_change_is_not_written(boards, monkeypatch):
    parts = images(30, (3, 2), prior_bits=2)
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        written = written_addresses(cluster, monkeypatch)
        for changed, first in (
            ({}, rm.TARGET_COUNT),
            ({}, rm.RUN_UNTIL),
            ({"bank": 1}, rm.BANK),
            ({"bank": 1, "prior_address": 3}, rm.PRIOR_SELECT),
            ({"bank": 1, "prior_address": 3, "max_cycles": 99}, rm.TARGET_COUNT),
            ({"bank": 1, "prior_address": 3, "max_cycles": 99, "target_count": 7}, rm.TARGET_COUNT),
        ):
            written.clear()
            given_frame = frame(**{"stop": "own"} | changed)
            assert outcome(cluster.run(given_frame)) == expected(parts, given_frame)
            assert written == ([rm.SENSORS] if not changed and first == rm.TARGET_COUNT else []) + [first]


@pytest.mark.parametrize(
    ("parts", "given_frame"),
    [
        (images(40, (3, 2), sensor_bits=()), FrameInput(addresses=(), target_count=9, max_cycles=500)),
        (images(50, (3, 2), zeros=1.0), frame()),
    ],
    ids=["no sensors", "impossible on every board"],
)
def test_frames_that_need_no_readings_or_no_cycles(boards, parts, given_frame):
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        assert outcome(cluster.run(given_frame)) == expected(parts, given_frame)


# ---- opening ----


def test_boards_are_programmed_once_and_found_again(boards):
    parts = images(60, (3, 2))
    for expected_number in range(3):
        with MiniCluster.open(endpoints_of(boards), parts) as cluster:
            assert cluster._boards[0].link.read32(rm.PROGRAMMED) == 1
            # the link's own numbers go on where the last host's ended
            assert cluster._boards[0].number == expected_number
            assert outcome(cluster.run(frame(stop="own"))) == expected(parts, frame(stop="own"))


def test_another_image_is_refused_with_both_hashes(boards):
    parts, others = images(60, (3, 2)), images(61, (3, 2))
    program(boards[1].endpoint, others[1])
    with board_fails(errors.ImageMismatchError) as caught:
        MiniCluster.open(endpoints_of(boards), parts)
    assert re.search(
        rf"Board 1: .*holds image {others[1].image_hash}, the deployment's is {parts[1].image_hash}: program it",
        str(caught.value),
    )
    assert caught.value.board == 1
    assert caught.value.exit_code == 2
    # the boards that were opened before it were let go
    with MiniCluster.open(endpoints_of(boards), parts, reprogram=True) as cluster:
        assert outcome(cluster.run(frame())) == expected(parts, frame())
        assert [board.link.read32(rm.PROGRAMMED) for board in cluster._boards] == [1, 2]
        program(boards[1].endpoint, others[1], token=cluster._boards[1].link.token)
        with board_fails(errors.StaleHandleError):
            cluster.run(frame())
        cluster.reopen(1)
        assert outcome(cluster.run(frame())) == expected(parts, frame())


def test_a_held_board_is_refused(boards):
    parts = images(60, (3, 2))
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        with board_fails(errors.HeldError) as caught:
            MiniCluster.open(endpoints_of(boards), parts)
        assert caught.value.exit_code == 5
        assert outcome(cluster.run(frame())) == expected(parts, frame())


ONE, TWO = images(1, (3, 2))


@pytest.mark.parametrize(
    ("parts", "endpoints"),
    [
        ([], ""),
        ([ONE], "a"),
        ([TWO, ONE], "ab"),
        ([ONE, images(1, (4, 2))[1]], "ab"),
        ([image(machine(1), total=99)], "a"),
        ([ONE, dataclasses.replace(TWO, model_hash="cd" * 32)], "ab"),
        ([ONE, TWO], "a"),
    ],
)
def test_images_that_are_not_the_parts_of_one_model_are_refused(parts, endpoints):
    with pytest.raises(errors.ImageMismatchError):
        MiniCluster.open([f"unix:/tmp/{name}.sock" for name in endpoints], parts)


# ---- boards that fail ----


@pytest.fixture
def clock(monkeypatch):
    """The mini-clusters' clock, which only the test moves, by `clock.now += SECONDS`."""
    clock = SimpleNamespace(now=100.0, perf_counter_ns=time.perf_counter_ns)
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr(mini_cluster, "time", clock)
    return clock


def run_past_the_deadline(cluster, given_frame, clock, *, slices=0):
    """Run a frame until, after so many slices, only board 1 has not answered, and then past its deadline."""
    others = [board for at, board in enumerate(cluster._boards) if at != 1]
    cluster.post(given_frame)
    while cluster._progress.slices < slices or any(board.waiting for board in others):
        assert cluster.collect(0.01) is None
    clock.now += 1000
    return cluster.collect(0)


OWN = {"stop": "own"}


@pytest.mark.parametrize(
    ("kind", "error", "on_opening"),
    [
        ("drop", errors.LinkTimeoutError, True), ("stall", errors.LinkTimeoutError, True),
        ("never-done", errors.LinkTimeoutError, False), ("endless", errors.LinkTimeoutError, True),
        ("short-read", errors.FramingError, True), ("wrong-sequence", errors.FramingError, True),
        ("wrong-crc", errors.FramingError, True), ("done-twice", errors.FramingError, False),
        ("done-early", errors.FramingError, False), ("stale-result", errors.FramingError, False),
        ("all-ones", errors.DeviceGoneError, True), ("no-results", errors.ShortReadError, False),
        ("more-results", errors.ShortReadError, False), ("reset-after-done", errors.SequenceError, False),
    ],
)  # fmt: skip
def test_a_misbehaving_board_fails_the_frame_and_comes_back(start_board, clock, kind, error, on_opening):
    sends_results = kind not in {"more-results", "reset-after-done"}
    boards = [start_board(index=at, sends_results=sends_results) for at in (0, 2)]
    boards.insert(1, start_board(index=1, misbehave=f"{kind}:1:1", sends_results=sends_results))
    parts = images(70, (3, 2, 2))
    with MiniCluster.open(endpoints_of(boards), parts, timeout=PATIENCE) as cluster:
        assert outcome(cluster.run(frame(**OWN))) == expected(parts, frame(**OWN))
        link = cluster._boards[0].link
        silent = error is errors.LinkTimeoutError
        with board_fails(error) as caught:
            run_past_the_deadline(cluster, frame(**OWN), clock) if silent else cluster.run(frame(**OWN))
        assert (caught.value.board, caught.value.exit_code) == (1, 5)
        assert [cluster.is_open(at) for at in (0, 1)] == [True, False]
        if silent:  # meanwhile the others have finished, so their links stay
            assert cluster._boards[0].link is link
        with board_fails(errors.LinkClosedError):
            cluster.run(frame(**OWN))
        cluster.reopen(1, timeout=PATIENCE)
        for given_frame in (frame(bank=3, **OWN), frame(bank=3)):
            assert outcome(cluster.run(given_frame)) == expected(parts, given_frame)
    if on_opening:
        refuse_on_opening(start_board(index=3, misbehave=kind), error)


def refuse_on_opening(board, error):
    limit = 0.2 if error is errors.LinkTimeoutError else PATIENCE
    with board_fails(error):
        MiniCluster.open([board.endpoint], images(1, (3,)), timeout=limit)


def test_a_board_of_another_register_map_is_refused(start_board):
    refuse_on_opening(start_board(misbehave="wrong-map"), errors.GreetingMismatchError)


def interrupted(state=BoardState.DONE, reason=StopReason.OVERFLOW, words=3):
    """A board of three lines after an interrupt of this state, with these words of results."""
    board = DrivenBoard(0, parse_endpoint("unix:/nowhere"), images(1, (3,))[0])
    board.waiting = board.sends_results = True
    return board, done_by(board, reason, bytes(4 * words), state=state)


@pytest.mark.parametrize("words", [2, 3, 4])
def test_an_interrupt_has_exactly_the_results_of_its_board(words):
    board, done = interrupted(words=words)
    with pytest.raises(errors.ShortReadError) if words != 3 else contextlib.nullcontext():
        board._take(done)
    assert board.waiting is (words != 3)


@pytest.mark.parametrize(
    ("state", "reason"),
    [(BoardState.RUNNING, StopReason.OVERFLOW), (BoardState.DONE, StopReason.NONE), (BoardState.DONE, 15)],
)
def test_an_interrupt_is_of_a_board_that_has_stopped_for_a_reason(state, reason):
    board, done = interrupted(state, reason)
    with pytest.raises(errors.FramingError):
        board._take(done)
    assert board.waiting


def test_the_slowest_board_sets_the_deadline(boards, clock):
    with MiniCluster.open(endpoints_of(boards), images(100, (3, 2)), slack=5) as cluster:
        cluster._boards[0].speed, cluster._boards[1].speed = 1e6, 1e3
        cluster.post(frame(stop="own", max_cycles=3000))
        # both boards' 3000 cycles may have to share a core
        assert cluster.seconds_left == 11
        clock.now += 4
        assert cluster.seconds_left == 7
        while cluster.collect(1) is None:
            pass


def test_a_later_slice_has_the_time_of_its_own_cycles(boards, clock):
    parts = [image(never_stopping(), total=8, count=2, index=at, offset=4 * at) for at in range(2)]
    with MiniCluster.open(endpoints_of(boards), parts, slack=5) as cluster:
        cluster._boards[0].speed = cluster._boards[1].speed = 1e3
        cluster.post(FrameInput(addresses=(1,), target_count=255, max_cycles=2**17, stop="slices"))
        for slices, cycles in enumerate((512, 512, 1024)):  # they end at 512, 1024 and 2048
            while cluster._progress.slices < slices:
                assert cluster.collect(1) is None
            assert cluster.seconds_left == pytest.approx(5 + 2 * cycles / 1e3)


def test_a_failure_in_a_later_slice(start_board, clock):
    boards = [start_board(index=0), start_board(index=1, misbehave="drop:2:1")]
    parts = images(70, (3, 2), zeros=0.0, counter_bits=16)
    slow = frame(5, 8, target_count=500, max_cycles=100000)
    with MiniCluster.open(endpoints_of(boards), parts, timeout=PATIENCE) as cluster:
        with board_fails(errors.LinkTimeoutError):
            run_past_the_deadline(cluster, slow, clock, slices=1)
        cluster.reopen(1)
        assert outcome(cluster.run(slow)) == expected(parts, slow)


def test_a_board_that_ends_is_gone_and_its_successor_is_programmed(boards, start_board):
    parts = images(80, (3, 2))
    with MiniCluster.open(endpoints_of(boards), parts, timeout=PATIENCE) as cluster:
        cluster.run(frame())
        boards[0].stop()
        with board_fails(errors.LinkClosedError):
            cluster.run(frame())
        with board_fails(errors.LinkUnreachableError):
            cluster.reopen(0, timeout=0.05)
        with board_fails(errors.LinkClosedError):
            cluster.run(frame())
        start_board(boards[0].endpoint)
        cluster.reopen(0)
        assert outcome(cluster.run(frame())) == expected(parts, frame())


@pytest.mark.process
def test_a_board_that_is_killed_while_it_computes(folder):
    endpoints = [f"unix:{folder}/board{at}.sock" for at in range(2)]
    command = str(Path(sys.executable).with_name("board"))
    boards = [subprocess.Popen([command, "--listen", each], stderr=subprocess.PIPE) for each in endpoints]
    part = image(never_stopping(), total=8, count=2)
    other = image(never_stopping(), total=8, count=2, index=1, offset=4)
    endless = FrameInput(addresses=(1,), target_count=2**32 - 1, max_cycles=2**45, stop="own")
    with MiniCluster.open(endpoints, [part, other], timeout=PROCESS_PATIENCE) as cluster:
        cluster.post(endless)
        assert cluster._boards[1].open_link.read32(rm.STATUS) & 15 == rm.BoardState.RUNNING
        boards[1].kill()
        with board_fails(errors.LinkClosedError):
            while cluster.collect(1) is None:
                pass
        # the other board was computing: it was stopped, and is ready
        assert cluster.is_open(0)
        program(endpoints[0], part, timeout=PATIENCE)
        with board_fails(errors.LinkClosedError):
            cluster.run(FrameInput(addresses=(1,), target_count=1, max_cycles=5))
    for board in boards:
        board.terminate()
        board.communicate(timeout=PROCESS_PATIENCE)
    assert boards[0].returncode == 143


def interrupt(patch, cluster):
    def interrupted(*_):
        raise KeyboardInterrupt

    patch.setattr(cluster, "_receive", interrupted)


def expect_another_number(patch, cluster):
    good = cluster._expect_done

    def expecting_another(course):
        cluster._boards[1].number += 1
        good(course)

    patch.setattr(cluster, "_expect_done", expecting_another)


def write_what_is_refused(patch, cluster):
    begin = cluster._machines.begin

    def refused(frame):
        course = begin(frame)
        course.settings, course.starts = FrameSettings(0, 0, 0, 0), [{}] * 2
        return course

    patch.setattr(cluster._machines, "begin", refused)


def program_behind_the_hosts_back(_, cluster):
    board = cluster._boards[1]
    program(str(board.endpoint), board.image, token=board.link.greeting.token)


@pytest.mark.parametrize(
    ("breaks", "error", "stays_open"),
    [
        (interrupt, KeyboardInterrupt, None),
        (expect_another_number, errors.FramingError, False),
        (write_what_is_refused, errors.AccessError, True),
        (program_behind_the_hosts_back, errors.StaleHandleError, False),
    ],
)
def test_a_frame_that_fails_leaves_boards_that_can_be_used_again(boards, breaks, error, stays_open):
    parts = images(90, (3, 2))
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        with pytest.MonkeyPatch.context() as patch:
            breaks(patch, cluster)
            with pytest.raises(error) if stays_open is None else board_fails(error):
                cluster.run(frame())
        if stays_open is not None:
            assert [cluster.is_open(at) for at in (0, 1)] == [True, stays_open]
        if stays_open is False:
            cluster.reopen(1)
        assert outcome(cluster.run(frame(bank=5))) == expected(parts, frame(bank=5))


def test_doorbell_numbers_go_round(start_board, monkeypatch):
    good = EmulatedBoard.load

    def load(board, content):
        good(board, content)
        board.done = 0xFFFFFFFD
        board.reset()

    monkeypatch.setattr(EmulatedBoard, "load", load)
    parts = images(97, (3,))
    with MiniCluster.open([start_board().endpoint], parts) as cluster:
        for number in (0xFFFFFFFE, 0xFFFFFFFF, 1, 2):
            assert outcome(cluster.run(frame(stop="own"))) == expected(parts, frame(stop="own"))
            assert cluster._boards[0].number == number


def test_an_interrupted_opening_leaves_boards_that_can_be_opened(boards, monkeypatch):
    open_board = DrivenBoard.open

    def interrupted(board, *limits):
        open_board(board, *limits)
        raise KeyboardInterrupt

    parts = images(10, (3, 2))
    with monkeypatch.context() as patch:
        patch.setattr(DrivenBoard, "open", interrupted)
        with pytest.raises(KeyboardInterrupt):
            MiniCluster.open(endpoints_of(boards), parts)
    with MiniCluster.open(endpoints_of(boards), parts) as cluster:
        assert outcome(cluster.run(frame())) == expected(parts, frame())


def test_a_closed_cluster_runs_nothing(boards):
    cluster = MiniCluster.open(endpoints_of(boards), images(1, (3, 2)))
    cluster.close()
    cluster.close()
    with board_fails(errors.LinkClosedError):
        cluster.run(frame())
