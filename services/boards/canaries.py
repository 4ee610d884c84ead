"""Canaries between the frames of a run: which one is due, and whether its counts are right."""

from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

from pcie_shim.errors import BoardError
from pcie_shim.host.canary_walk import CanaryWalk
from pcie_shim.host.frame import FrameInput, FrameOutput
from pcie_shim.programming_file import Image

PAUSE: Final = 0.01
"""Seconds without a frame after which a canary is run, and between two of them."""


class Position(NamedTuple):
    """A position in a walk of a shape: the next canary, and how many are owed and have passed."""

    shape: tuple[object, ...]
    next: int
    debt: int
    passed: int


class DamagedBoardError(BoardError):
    """Boards gave other counts for a canary than their images: a table or a counter is damaged."""

    def __init__(self, boards: Sequence[int], frames: int) -> None:
        """Take the numbers of the boards, and the frames within which canaries find a flipped bit."""
        several = len(boards) > 1
        names = f"{'boards' if several else 'board'} {' and '.join(map(str, boards))}"
        super().__init__(
            f"{names} gave wrong counts for a known reading: a table or a counter is damaged, so "
            f"{'they are' if several else 'it is'} programmed again, and results of at most {frames} frames may be wrong "
            "(integrity = canary)",
            board=boards[0],
        )
        self.boards = tuple(boards)


class Canaries:
    """The position in the walk of canaries, and the number that the computed frames require.

    Frames are counted so that any `frames` of them are accompanied by one whole walk. Canaries that ran while no
    frame came do not replace later ones, since a bit may flip at any time.
    """

    def __init__(self, images: Sequence[Image], frames: int) -> None:
        """Make the kernels that compute the right counts."""
        self._walk = CanaryWalk(images)
        self._walk.prepare()
        self._frames = frames
        self._next = 0
        self._debt = 0
        self.passed = 0

    @property
    def length(self) -> int:
        """Number of canaries in the walk."""
        return len(self._walk)

    @property
    def is_owed(self) -> bool:
        """True if a canary must run before the next frame."""
        return self._debt >= self._frames

    def count_frame(self) -> None:
        """Count a computed frame."""
        self._debt += len(self._walk)

    def next(self) -> FrameInput:
        """Return the canary to run."""
        return self._walk.canary(self._next)

    def judge(self, output: FrameOutput) -> None:
        """Advance to the next canary, or raise a DamagedBoardError and stay at this one."""
        damaged = self._walk.differing_boards(self._next, output.boards)
        if damaged:
            raise DamagedBoardError(damaged, self._frames)
        self._next = (self._next + 1) % len(self._walk)
        self._debt = max(0, self._debt - self._frames)
        self.passed += 1

    def check(self, output: FrameOutput, boards: Collection[int]) -> None:
        """Judge only reprogrammed boards, and owe this canary, which judges all boards before the next frame.

        Raises:
            DamagedBoardError: They still give wrong counts.
        """
        if damaged := [
            each for each in self._walk.differing_boards(self._next, output.boards) if each in boards
        ]:
            raise DamagedBoardError(damaged, self._frames)
        self._debt = max(self._debt, self._frames)

    @property
    def position(self) -> Position:
        """The position, from which the canaries of another deployment may go on."""
        return Position(self._walk.shape, self._next, self._debt, self.passed)

    def go_on(self, position: Position) -> None:
        """Go on from the position in a walk of the same shape, so that frequent reloads do not favour its beginning."""
        if position.shape == self._walk.shape:
            self._next, self._debt, self.passed = position.next, position.debt, position.passed
