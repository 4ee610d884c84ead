"""A mini-cluster's boards as pcie-app uses them: opened, programmed, given frames, mended, given another deployment."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from machines.parameters import SensorMode
from pcie_shim.endpoint import Endpoint
from pcie_shim.errors import (
    BoardError,
    BoardHeldError,
    BoardLinkError,
    BoardMismatchError,
    FrameInputError,
    GreetingMismatchError,
    HeldError,
    ImageError,
    PcieShimError,
)
from pcie_shim.host.frame import FrameInput, FrameOutput
from pcie_shim.host.loader import program
from pcie_shim.host.mini_cluster import PROGRAMMING_S, MiniCluster
from pcie_shim.programming_file import Image, read_image
from services.errors import StackError
from services.pipeline.generations import Generations
from services.pipeline.results import encode_boards
from services.settings import Settings
from services.sockets.records import (
    Addresses,
    FailureReason,
    Frame,
    FrameFailed,
    FrameResult,
    NotReloaded,
    Switch,
    Switched,
)
from services.sockets.status import BoardStatus
from terminal.errors import exit_code_of
from toolchain.deployment import Deployment

TICK = 0.2
"""Seconds between attempts to open a board that is gone, and for each of them."""


class BoardAwayError(BoardError):
    """A board that failed an earlier frame is not back yet."""


class Boards:
    """A deployment's boards, opened and programmed; a board that restarts is opened and programmed again.

    Attributes:
        generations: The deployments that the boards can be given, with their images.
        gone: Why a board can't be used, by its number.
    """

    def __init__(
        self,
        settings: Settings,
        deployment: Deployment,
        endpoints: Sequence[Endpoint],
        *,
        reprogram: bool = False,
    ) -> None:
        """Read the images.

        Args:
            settings: The settings.
            deployment: The deployment.
            endpoints: Where the boards are.
            reprogram: Whether a board that holds another image is programmed; else it is somebody else's.
        """
        self._settings = settings
        self.generations = Generations(deployment, _images_of, images=True)
        self._reprogram = reprogram
        self._use()
        self._endpoints = list(endpoints)
        self._cluster: MiniCluster | None = None
        self.gone: dict[int, str] = {}
        self._times_gone = [0] * len(self._endpoints)

    def open(self) -> str:
        """Open all boards, programming blank ones; gives a sentence.

        Raises:
            PcieShimError: a board is not there, holds another image, or does not behave.
        """
        mended: set[int] = set()
        while self._cluster is None:
            try:
                self._cluster = self._opened(self._images)
            except BoardMismatchError as error:
                if not self._reprogram or error.board in mended:
                    raise
                mended.add(error.board)
                self._program(error.board, self._images[error.board])
        count = len(self._endpoints)
        return f"{count} {'board' if count == 1 else 'boards'} programmed and open"

    def _opened(self, images: Sequence[Image]) -> MiniCluster:
        return MiniCluster.open(
            self._endpoints,
            images,
            timeout=self._settings.peer_timeout,
            slack=self._settings.board_timeout,
        )

    def _use(self) -> None:
        """Take what is needed for every frame from the deployment in force."""
        self._deployment = self.generations.deployment
        self._images: list[Image] = self.generations.made
        self._machine = self._deployment.machine
        self._selects = self._deployment.prior_select is not None

    # --- another deployment --------------------------------------------------------------------

    def switch(self, record: Switch) -> Switched | NotReloaded:
        """Give the boards the images of another generation, or none of them: a failure has the old ones put back.

        No frame may be under way. It takes as long as programming does; boards that hold the right image already
        are left alone.
        """
        try:
            _, images = self.generations.of(record.generation)
            cluster = self._whole_cluster()
            self._reprogram = True  # from here on a board may hold either image
            try:
                self._cluster = self._given(cluster, images)
            except PcieShimError:
                self._put_back(cluster)
                raise
        except (PcieShimError, StackError) as error:
            return NotReloaded(record.generation, exit_code_of(error), str(error))
        answer = self.generations.switch(record)
        self._use()
        return answer

    def _given(self, cluster: MiniCluster, images: Sequence[Image]) -> MiniCluster:
        """Boards that hold these images, open."""
        cluster.close()
        for board, (held, wanted) in enumerate(zip(self._images, images, strict=True)):
            if held.image_hash != wanted.image_hash:
                self._program(board, wanted)
        return self._opened(images)

    def _put_back(self, cluster: MiniCluster) -> None:
        """Use the boards as before; those that do not come back in time stay in `gone`, to be mended later."""
        self._cluster = cluster
        cluster.close()
        self.gone = dict.fromkeys(range(len(self._endpoints)), "it gets its old image back")
        deadline = time.monotonic() + self._settings.peer_timeout
        while self.gone and time.monotonic() < deadline:
            self.mend()
            time.sleep(TICK / 4 if self.gone else 0)

    def _program(self, board: int, image: Image) -> None:
        """Program a board that this process does not have open.

        Raises:
            BoardError: It can't be programmed.
        """
        deadline = time.monotonic() + self._settings.peer_timeout
        while True:
            try:
                program(
                    self._endpoints[board], image, timeout=max(self._settings.peer_timeout, PROGRAMMING_S)
                )
            except HeldError as error:
                # over TCP a board may hear of our own link's end after the loader's beginning
                if time.monotonic() > deadline:
                    raise BoardHeldError(f"Board {board}: {error}", board=board) from error
                time.sleep(TICK / 4)
            except (GreetingMismatchError, ImageError) as error:
                raise BoardMismatchError(f"Board {board}: {error}", board=board) from error
            except PcieShimError as error:
                raise BoardLinkError(f"Board {board}: {error}", board=board) from error
            else:
                return

    def status(self, output: FrameOutput | None) -> list[BoardStatus]:
        """What is known of each board, with its part of the last output; may be called by another thread."""
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

    def run(self, frame: Frame) -> FrameOutput:
        """Compute one frame.

        Raises:
            BoardError: a board failed; it is then in `gone` until `mend` has it back.
        """
        cluster = self._whole_cluster()
        try:
            return cluster.run(self._input(frame))
        except BoardError as error:
            self.look(error)
            raise

    def post(self, frame: Frame) -> None:
        """Start a frame without waiting for it: `collect` has its result.

        Raises:
            BoardError: a board failed, or is not back yet; `look` is to be called.
        """
        self._whole_cluster().post(self._input(frame))

    def collect(self) -> FrameOutput | None:
        """The posted frame's result, or None while boards still run.

        Raises:
            BoardError: a board failed, or is late; `look` is to be called.
        """
        return self._whole_cluster().collect(0)

    @property
    def awaited(self) -> int | None:
        """The descriptor that is worth watching until the next `collect`."""
        return None if self._cluster is None else self._cluster.awaited

    @property
    def is_late(self) -> bool:
        """Whether a board of the posted frame has had its time: `collect` says which."""
        return self._cluster is not None and not self._cluster.seconds_left

    def _whole_cluster(self) -> MiniCluster:
        if self._cluster is None or self.gone:
            board, why = next(iter(self.gone.items()), (0, "it was not opened"))
            msg = f"board {board} is not back yet ({why})"
            raise BoardAwayError(msg, board=board)
        return self._cluster

    def _input(self, frame: Frame) -> FrameInput:
        machine = self._machine
        prior = np.frombuffer(frame.prior_codes, "<u2") if frame.prior_codes else None
        addresses: tuple[int | None, ...] | npt.NDArray[np.int64]
        row: int | tuple[int, ...] = 0
        if machine.is_plain:
            addresses = tuple(_one(address) for address in frame.addresses)
            if self._selects and len(addresses) == len(self._deployment.variables):
                addresses, row = self._deployment.machine_addresses(addresses)
        else:
            addresses, row = machine_inputs(self._deployment, frame.addresses)
            if prior is not None and prior.size == machine.results:
                prior = prior.reshape(-1, machine.lines) if machine.replicas > 1 else prior
        return FrameInput(
            addresses=addresses,
            prior_address=row,
            prior_codes=prior,
            target_count=machine.target_count,
            max_cycles=machine.max_cycles,
            bank=frame.bank,
            stop="own" if (self._settings.stop or machine.stop) == "own" else "slices",
        )

    def look(self, error: BoardError) -> None:
        """After a failure: find all boards that are gone, so that several deaths at once fail one frame."""
        if self._cluster is None:
            return
        if not self._cluster.is_open(error.board):
            self._is_gone(error.board, error)
        for board in range(len(self._endpoints)):
            if board != error.board and board not in self.gone:
                try:
                    self._cluster.reopen(board, timeout=TICK)
                except BoardError as other:
                    self._is_gone(board, other)

    def _is_gone(self, board: int, error: BoardError) -> None:
        self.gone[board] = str(error)
        self._times_gone[board] += 1

    def mend(self) -> list[int]:
        """Try once to open the boards that are gone; the numbers of those that are back.

        Raises:
            BoardMismatchError: a board is back with another image; waiting would not help.
        """
        back = []
        for board in list(self.gone):
            if self._cluster is None:
                break
            try:
                self._reopen(self._cluster, board)
            except BoardMismatchError:
                raise
            except BoardError as error:
                self.gone[board] = str(error)
            else:
                del self.gone[board]
                back.append(board)
        return back

    def _reopen(self, cluster: MiniCluster, board: int) -> None:
        try:
            cluster.reopen(board, timeout=TICK)
        except BoardMismatchError:
            if not self._reprogram:
                raise
            self._program(board, self._images[board])
            cluster.reopen(board, timeout=TICK)

    def close(self) -> None:
        """Let go of all boards."""
        if self._cluster is not None:
            self._cluster.close()


def _images_of(deployment: Deployment) -> list[Image]:
    return [read_image(deployment.image_path(at)) for at in range(len(deployment.boards))]


def _one(address: int | list[int] | None) -> int | None:
    if isinstance(address, list):
        msg = f"The frame has {len(address)} readings of one variable; this machine takes one of each"
        raise FrameInputError(msg)
    return address


def machine_inputs(
    deployment: Deployment, addresses: Addresses
) -> tuple[npt.NDArray[np.int64], int | tuple[int, ...]]:
    """A frame's inputs where replicas or lines have readings of their own, as the driver takes them.

    Args:
        deployment: what the shapes come from.
        addresses: a row for each variable, in their order; None where all of it is missing.

    Returns:
        The sensors' inputs, -1 in all lines of a missing one, and the row of the prior's table of each replica.

    Raises:
        FrameInputError: another number of variables, or a row of another length; says which and how long it is to be.
    """
    variables = deployment.variables
    if len(addresses) != len(variables):
        msg = f"The frame has {len(addresses)} readings; this deployment has {len(variables)} variables"
        raise FrameInputError(msg)
    machine = deployment.machine
    replicas = machine.replicas
    sensors: list[npt.NDArray[np.int64]] = []
    row: int | tuple[int, ...] = 0
    for variable, given in zip(variables, addresses, strict=True):
        shape = deployment.reading_shape(variable)
        if given is None:
            array = np.full(shape, -1, dtype=np.int64)
        else:
            try:
                array = np.array(given, dtype=np.int64)
            except OverflowError:
                msg = f"The reading of {variable.name} has an address beyond all that a machine has"
                raise FrameInputError(msg) from None
            if array.size != math.prod(shape) or (array.ndim == 0 and shape):
                msg = (
                    f"The reading of {variable.name} has {array.size if array.ndim else 'one'} "
                    f"{'addresses' if array.size != 1 else 'address'}; this deployment takes {math.prod(shape)} of it"
                )
                raise FrameInputError(msg)
            array = array.reshape(shape)
        if variable.kind == "sensor":
            sensors.append(array.reshape(replicas, -1))
        else:
            top = 2**variable.bits - 1
            row = (
                tuple(np.where(array == -1, top, array).tolist())
                if array.ndim
                else top
                if array == -1
                else int(array)
            )
    per_line = machine.sensor_mode is not SensorMode.COLUMN
    inner = (machine.lines,) if per_line else ()
    stacked = np.stack(sensors, axis=1) if sensors else np.empty((replicas, 0, *inner), dtype=np.int64)
    shape = (len(sensors), *inner)
    return stacked.reshape((replicas, *shape) if replicas > 1 else shape), row


def result_record(number: int, output: FrameOutput) -> FrameResult:
    """The boards' outcome as a record."""
    return FrameResult(
        number=number,
        boards=encode_boards(output.boards),
        register_writes_ns=output.register_writes_ns,
        compute_ns=output.compute_ns,
        reads_ns=output.reads_ns,
        boards_compute_ns=output.boards_compute_ns,
    )


def frame_failed(number: int, error: BoardError) -> FrameFailed:
    """A frame that the boards did not finish, as a record."""
    reason = FailureReason.AWAY if isinstance(error, BoardAwayError) else FailureReason.FAILED
    return FrameFailed(number, error.board, exit_code_of(error), str(error), reason)
