"""The boards of a deployment: programming, opening, frames, and recovery after restarts."""

from collections.abc import Sequence

from machines.kind import FrameInput
from pcie_shim.endpoint import Endpoint
from pcie_shim.errors import BoardError
from pcie_shim.host.mini_cluster import FrameOutput, MiniCluster
from pcie_shim.programming_file import Image, read_image
from services.boards.frames import BoardAwayError, driver_input
from services.settings import Settings
from services.sockets.records import FrameRequest
from services.sockets.status import BoardStatus
from terminal.errors import ExitCode
from toolchain.deployment import Deployment

TICK = 0.2
"""Seconds between attempts to reopen a board, and timeout of each attempt."""


class DeployedBoards:
    """The boards of a deployment. A restarted board is programmed and opened again.

    Any thread may call `status`. Only one thread at a time may call the other methods.
    """

    def __init__(
        self,
        settings: Settings,
        deployment: Deployment,
        endpoints: Sequence[Endpoint],
        *,
        reprogram: bool = False,
    ) -> None:
        """Read the images. With `reprogram`, a board that has another image is programmed; otherwise it is refused."""
        self._settings = settings
        self.deployment = deployment
        self._images = images_of(deployment)
        self._reprogram = reprogram
        self._endpoints = list(endpoints)

        # None until `open` has succeeded; from then on the same cluster, whose boards are reopened one by one.
        self._cluster: MiniCluster | None = None

        # Why a board is unusable, by its number: from the failure until `recover` has reopened it. While a board is in
        # here, no frame is posted.
        self.gone: dict[int, str] = {}

        # How often each board was gone, for the status.
        self._times_gone = [0] * len(self._endpoints)

    def open(self) -> str:
        """Open all boards and program the blank ones. Return a sentence for the user, or raise a PcieShimError."""
        self._cluster = MiniCluster.open(
            self._endpoints,
            self._images,
            timeout=self._settings.peer_timeout,
            slack=self._settings.board_timeout,
            reprogram=self._reprogram,
        )
        count = len(self._endpoints)
        return f"{count} {'board' if count == 1 else 'boards'} programmed and open"

    def status(self, output: FrameOutput | None) -> list[BoardStatus]:
        """Return the state of each board. Any thread may call this method.

        `output` is the output of the last frame. The states contain the boards' cycles from `output`.
        """
        # a copy, because the boards' thread changes it meanwhile
        gone = dict(self.gone)
        return [
            BoardStatus(
                index=at,
                endpoint=str(endpoint),
                state="not opened yet" if self._cluster is None else "gone" if at in gone else "programmed",
                image=image.image_hash,
                restarts=self._times_gone[at],
                last_cycles=None if output is None else output.boards[at].cycles,
                why=gone.get(at, ""),
            )
            for at, (endpoint, image) in enumerate(zip(self._endpoints, self._images, strict=True))
        ]

    def run(self, frame: FrameRequest) -> FrameOutput:
        """Compute one frame, or raise a BoardError. Lost boards are then in `gone` until `recover` reopens them."""
        try:
            return self._whole_cluster().run(self._input(frame))
        except BoardError as error:
            self.find_lost_boards(error)
            raise

    def post(self, frame: FrameRequest) -> None:
        """Start a frame, whose result `collect` returns. The caller must call `find_lost_boards` after a BoardError."""
        self._whole_cluster().post(self._input(frame))

    def collect(self) -> FrameOutput | None:
        """Return the posted frame's result, or None while boards run; see `post` about BoardErrors."""
        return self._whole_cluster().collect(0)

    @property
    def awaited(self) -> int | None:
        """File descriptor that becomes readable when `collect` has data to read, or None if no board is awaited."""
        return None if self._cluster is None else self._cluster.awaited

    @property
    def is_late(self) -> bool:
        """True if a board exceeded the deadline of the posted frame. `collect` then raises an error about the board."""
        return self._cluster is not None and not self._cluster.seconds_left

    def _whole_cluster(self) -> MiniCluster:
        if self._cluster is None or self.gone:
            board, why = next(iter(self.gone.items()), (0, "it was not opened"))
            raise BoardAwayError(f"board {board} is not back yet ({why})", board=board)
        return self._cluster

    def _input(self, frame: FrameRequest) -> FrameInput:
        return driver_input(self.deployment, frame, self._settings.stop or self.deployment.machine.stop)

    def find_lost_boards(self, error: BoardError) -> None:
        """After a failure, find all boards that are gone. So boards that fail together cost only one frame."""
        # a BoardAwayError is about a board that is already known to be gone
        if self._cluster is None or isinstance(error, BoardAwayError):
            return
        # a board that only refused an access is still open
        lost = {} if self._cluster.is_open(error.board) else {error.board: error}
        for board in sorted(set(range(len(self._endpoints))) - {error.board, *self.gone}):
            # only reopening a board tells whether it is alive
            try:
                self._cluster.reopen(board, timeout=TICK)
            except BoardError as other:
                lost[board] = other
        for board, reason in lost.items():
            self.gone[board] = str(reason)
            self._times_gone[board] += 1

    def recover(self) -> list[int]:
        """Try once to reopen each missing board. Return the numbers of the reopened boards.

        Raises a BoardError if a board has another image or key, because only the user can solve this.
        """
        back: list[int] = []
        if self._cluster is None:
            return back
        for board in list(self.gone):
            try:
                self._cluster.reopen(board, timeout=TICK)
            except BoardError as error:
                # a board with another image or key needs the user, so waiting would not help
                if error.exit_code == ExitCode.USAGE:
                    raise
                self.gone[board] = str(error)
            else:
                del self.gone[board]
                back.append(board)
        return back

    def close(self) -> None:
        """Close the links to all boards."""
        if self._cluster is not None:
            self._cluster.close()


def images_of(deployment: Deployment) -> list[Image]:
    """Return the images of a deployment's boards."""
    return [read_image(deployment.image_path(at)) for at in range(len(deployment.boards))]
