"""Boards whose tables or counters are damaged: found by a canary, named, programmed again, and used again.

DeployedBoards ──▶ four boards in processes of their own, some of which misbehave
"""

import itertools
from collections.abc import Iterator

import pytest

from machines.kernel import warm_up
from pcie_shim.endpoint import parse_endpoint
from services.boards.canaries import DamagedBoardError
from services.boards.deployed import DeployedBoards
from services.settings import Settings
from services.sockets.records import Frame
from tests.pcie_shim.boards import BoardProcess
from toolchain.deployment.sections import Integrity

pytestmark = pytest.mark.thorough
FRAMES = 1000
"""The setting `integrity_frames`."""
_numbers = itertools.count()


@pytest.fixture
def open_boards(boat, tmp_path) -> Iterator:
    """A function that starts four boards with these misbehaviours, by number, and opens them."""
    warm_up()  # the boards' processes inherit the kernels
    processes, opened = [], []

    def open_boards(misbehaviours: dict[int, str], **settings) -> DeployedBoards:
        folder = tmp_path / str(next(_numbers))
        folder.mkdir(mode=0o700)
        started = [
            BoardProcess(f"unix:{folder}/b{at}", index=at, misbehave=misbehaviours.get(at, ""))
            for at in range(len(boat.boards))
        ]
        processes.extend(started)
        rule = {"integrity": Integrity.CANARY, "integrity_frames": FRAMES}
        boards = DeployedBoards(
            Settings(**(rule | settings)), boat, [parse_endpoint(each.endpoint) for each in started]
        )
        opened.append(boards)
        boards.open()
        return boards

    yield open_boards
    for boards in opened:
        boards.close()
    for process in processes:
        process.stop()


def damaged(boards: DeployedBoards) -> list[int]:
    return [each.damaged for each in boards.status(None)]


def canaries_until_damaged(boards: DeployedBoards) -> DamagedBoardError:
    for _ in range(boards.canaries.length + 1):
        try:
            boards.run_canary()
        except DamagedBoardError as error:
            return error
    raise AssertionError("no canary has shown the damage")


def counts(boards: DeployedBoards, number: int) -> bytes:
    return b"".join(each.words for each in boards.run(Frame(number, [1, 2, 3, 4, 5, 6], 3, b"")).boards)


def test_boards_that_are_damaged_at_once_are_all_named_and_counted(open_boards):
    boards = open_boards({1: "flip-counter:3:1", 3: "flip-counter:3:1"})
    error = canaries_until_damaged(boards)
    assert error.boards == (1, 3)
    assert boards.gone.keys() == {1, 3}
    assert damaged(boards) == [0, 1, 0, 1]
    assert sorted(boards.recover()) == [1, 3]
    boards.run_canary()
    assert not boards.gone
    assert damaged(boards) == [0, 1, 0, 1]
    assert counts(boards, 1) == counts(open_boards({}, integrity=Integrity.OFF), 1)


def test_a_board_that_is_damaged_while_another_one_is_programmed_is_found_before_the_next_frame(open_boards):
    # start 6 shows board 0, start 7 is the check of board 0
    boards = open_boards({0: "flip-counter:6:1", 2: "flip-counter:7"})
    assert canaries_until_damaged(boards).boards == (0,)
    assert boards.recover() == [0]
    assert boards.is_canary_owed
    with pytest.raises(DamagedBoardError) as caught:
        boards.run_canary()
    assert caught.value.boards == (2,)
    assert damaged(boards) == [1, 0, 1, 0]
    assert boards.recover() == []
    assert damaged(boards) == [1, 0, 2, 0]
    assert boards.gone.keys() == {2}


def test_recovery_tries_again_until_the_board_is_back_or_the_time_is_over(open_boards):
    boards = open_boards({1: "flip-counter:5:4"})
    canaries_until_damaged(boards)
    assert boards.recover() == []  # one attempt is not enough
    boards.recover_in_time()
    assert not boards.gone
    boards = open_boards({1: "flip-counter:5"}, peer_timeout=0.5)
    canaries_until_damaged(boards)
    boards.recover_in_time()
    assert boards.gone.keys() == {1}
