"""Canaries between the frames of a run: which one is due, and whether its counts are right."""

from collections.abc import Sequence
from typing import Final

from pcie_shim.errors import BoardError
from pcie_shim.host.canary_walk import CanaryWalk
from pcie_shim.host.frame import FrameInput, FrameOutput
from pcie_shim.programming_file import Image

PAUSE: Final = 0.01
"""Seconds without a frame after which a canary is run, and between two of them."""


class DamagedBoardError(BoardError):
    """A board gave other counts for a canary than its image: a table or a counter is damaged."""


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
        board = self._walk.differing_board(self._next, output.boards)
        if board is not None:
            raise DamagedBoardError(
                f"board {board} gave wrong counts for a known reading: a table or a counter is damaged, so it is programmed "
                f"again, and results of at most {self._frames} frames may be wrong (integrity = canary)",
                board=board,
            )
        self._next = (self._next + 1) % len(self._walk)
        self._debt = max(0, self._debt - self._frames)
        self.passed += 1
