"""Drives the mini-cluster: one blocking thread, all boards (thesis 3.2, figure 3.3).

A frame's sensors and its start are posted to every board before the first is waited for; then the
results are taken as the boards stop. Boards that hold parts of one model stop together
(``slices``) or each for itself (``own``, as in the thesis).
"""

from __future__ import annotations

import select
import struct
import time
from typing import TYPE_CHECKING, Final, NoReturn, Self

import numpy as np

from machines.bm1 import StopReason, first_slice
from machines.parameters import CYCLES_MAX, PriorMode, SensorMode
from pcie_shim.endpoint import parse_endpoint
from pcie_shim.errors import (
    AccessError,
    BoardGoneError,
    FrameInputError,
    ImageMismatchError,
    LinkError,
    PcieShimError,
    StaleHandleError,
)
from pcie_shim.host.driven_board import DrivenBoard, board_error
from pcie_shim.host.frame import FrameInput, FrameOutput
from pcie_shim.host.link import LONGEST_POLL_S
from pcie_shim.programming_file import is_plain

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType

    import numpy.typing as npt

    from machines.parameters import BM1Parameters
    from pcie_shim.endpoint import Endpoint
    from pcie_shim.programming_file import Image

SLACK_S: Final = 5.0
"""Seconds that a board may take beyond what its cycles need at its measured speed."""
FIRST_WAIT_S: Final = 0.01
"""Seconds for which only the board that was started last is watched."""
PROGRAMMING_S: Final = 30.0
"""Seconds for each step of programming a blank board, at least."""

_SETTINGS: Final = struct.Struct("<IQII")  # TARGET_COUNT, MAX_CYCLES, BANK, PRIOR_SELECT


class _Course:
    """How far the posted frame is."""

    def __init__(self, max_cycles: int, end: int, boards: Sequence[DrivenBoard]) -> None:
        self.max_cycles = max_cycles
        self.begun = 0  # where the slice began
        self.end = end  # where it ends; 0: where the frame does
        self.running = boards
        self.halted: frozenset[int] = frozenset()
        self.left = 0  # boards of the slice that have not said done
        self.cycles = 0
        self.limit = 0.0
        self.deadline = 0.0
        self.slices = 0
        self.writes_ns = self.waits_ns = self.computing_ns = 0
        self.clock_ns = time.perf_counter_ns()


class MiniCluster:
    """All boards of a deployment, in the order of their partition; used by one thread."""

    def __init__(self, boards: Sequence[DrivenBoard], *, timeout: float, slack: float) -> None:
        """Use :meth:`open`."""
        self._boards = tuple(boards)
        self._parameters: BM1Parameters = self._boards[0].image.machine.parameters
        self._timeout = timeout
        self._slack = slack
        self._interrupted: list[DrivenBoard] = []
        self._course: _Course | None = None
        self._poll = select.poll()
        self._by_descriptor: dict[int, DrivenBoard] = {}
        self._replicas = self._parameters.replicas
        self._is_plain = is_plain(self._parameters)
        self._sensor_words = struct.Struct(f"<{self._parameters.sensors}I")
        self._missing = tuple((1 << bits) - 1 for bits in self._parameters.sensor_bits)

    @classmethod
    def open(
        cls,
        endpoints: Sequence[Endpoint | str],
        images: Sequence[Image],
        *,
        timeout: float = 10.0,
        slack: float = SLACK_S,
    ) -> Self:
        """Open all boards: identity, liveness and image are checked, blank boards programmed, machines reset.

        Args:
            endpoints: Where the boards listen, in the order of the partition.
            images: What they (are to) hold.
            timeout: Seconds for a board to listen, and for each of its answers.
            slack: Seconds that a frame may take beyond what its cycles need at the boards' speed.

        Raises:
            EndpointError: An endpoint's text is wrong.
            ImageMismatchError: The images are not the parts of one model.
            BoardError: A board cannot be opened; those opened before it are closed.
        """
        places = [parse_endpoint(place) if isinstance(place, str) else place for place in endpoints]
        _check_images(len(places), images)
        boards = [
            DrivenBoard(index, place, image)
            for index, (place, image) in enumerate(zip(places, images, strict=True))
        ]
        cluster = cls(boards, timeout=timeout, slack=slack)
        try:
            for board in boards:
                cluster._open(board, timeout)
        except BaseException:
            cluster.close()
            raise
        return cluster

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def total_lines(self) -> int:
        """Lines of the whole model."""
        return sum(board.lines for board in self._boards)

    def is_open(self, board: int) -> bool:
        """Whether board number ``board`` can be used; else :meth:`reopen` it."""
        return self._boards[board].link is not None or self._boards[board] in self._interrupted

    def reopen(self, board: int, *, timeout: float | None = None) -> None:
        """Open a board again, after its restart or a broken link; a blank one is programmed.

        Args:
            board: Its number.
            timeout: Seconds for it to listen and greet; None: as when the mini-cluster was opened.

        Raises:
            BoardError: It cannot be opened.
        """
        self._open(self._boards[board], self._timeout if timeout is None else timeout)

    def close(self) -> None:
        """Close all links; boards that run stop."""
        self._course = None
        for board in self._boards:
            self._close(board, "the mini-cluster was closed")

    # ---- a frame --------------------------------------------------------------------------------------

    def run(self, frame: FrameInput) -> FrameOutput:
        """Compute one frame on all boards.

        After an error the frame is lost, and nothing of it is kept. The boards that did not fail can be used
        again at once; the one that failed must be opened again (:meth:`reopen`), unless it only refused.

        Raises:
            FrameInputError: The frame does not fit the machine; no board was touched.
            BoardError: A board failed; ``error.board`` is its number.
        """
        self.post(frame)
        while (output := self.collect(LONGEST_POLL_S)) is None:
            pass
        return output

    def post(self, frame: FrameInput) -> None:
        """Start a frame on all boards without waiting for any; :meth:`collect` has its result. Errors as :meth:`run`."""
        if self._course is not None:
            raise FrameInputError("A frame is under way; collect its result before the next is posted")
        settings, sensors, selects = self._words(frame)
        priors = self._priors(frame)
        self._make_ready()
        end = first_slice(frame.target_count) if frame.stop == "slices" else 0
        if end >= frame.max_cycles or (self._replicas > 1 and len(self._boards) == 1):
            end = 0  # one slice, which ends where the frame does
        course = self._course = _Course(frame.max_cycles, end, self._boards)
        try:
            for board, own, prior in zip(self._boards, sensors, priors, strict=True):
                try:
                    board.start(settings, own, selects, prior, end)
                except LinkError as error:
                    self._fail(board, error)
            self._posted(course)
        except BaseException:
            self._abandon()
            raise

    def collect(self, seconds: float) -> FrameOutput | None:
        """Take what the boards have said of the posted frame, and go on with its next slice where there is one.

        Args:
            seconds: To wait at most, if nothing has come yet; 0 for a look.

        Returns:
            The frame's result, or None while boards still run: then :attr:`awaited` says which link to watch.

        Raises:
            BoardError: As :meth:`run`.
        """
        course = self._course
        if course is None:
            raise FrameInputError("There is no frame under way: post one first")
        try:
            if not self._receive(course, seconds):
                return None
            output = self._next_slice(course)
        except BaseException:
            self._abandon()
            raise
        if output is not None:
            self._course = None
        return output

    @property
    def awaited(self) -> int | None:
        """Descriptor of the link that is worth watching until the next :meth:`collect`; None if no frame is under way."""
        course = self._course
        if course is None:
            return None
        board = next((board for board in reversed(course.running) if board.waiting), None)
        return None if board is None or board.link is None else board.link.fileno()

    @property
    def seconds_left(self) -> float:
        """Seconds until a board of the posted frame is late: :meth:`collect` is to be called then at the latest."""
        return 0.0 if self._course is None else max(0.0, self._course.deadline - time.monotonic())

    def _posted(self, course: _Course) -> None:
        """All boards of a slice have been started: from now on they are waited for."""
        # emulated boards may all share one core
        cycles = (course.end or course.max_cycles) - course.begun
        course.cycles = cycles
        course.limit = self._slack + cycles * len(self._boards) / min(board.speed for board in self._boards)
        course.deadline = time.monotonic() + course.limit
        course.left = len(course.running)
        now = time.perf_counter_ns()
        course.writes_ns += now - course.clock_ns
        course.clock_ns = now

    def _receive(self, course: _Course, seconds: float) -> bool:
        """Hear the boards, for so many seconds at most; True once every running board has said done."""
        # The board that was started last is mostly the last to be done: waking for each of the others would only
        # take their cores from those that compute. Who fails or takes longer is seen by the poll of all.
        if seconds and course.left == len(course.running):
            course.running[-1].readable.poll(min(seconds, FIRST_WAIT_S) * 1000)
        while course.left:
            remaining = course.deadline - time.monotonic()
            events = self._poll.poll(min(max(remaining, 0.0), seconds) * 1000)
            if not events:
                if remaining <= 0:
                    late = next(board for board in course.running if board.waiting)
                    assert late.link is not None  # noqa: S101 - it is waited for
                    self._fail(late, late.link.late(course.limit, f"say done after {course.cycles} cycles"))
                return False
            for descriptor, _ in events:
                board = self._by_descriptor[descriptor]
                try:
                    course.left -= board.receive()
                except LinkError as error:
                    self._fail(board, error)
        return True

    def _next_slice(self, course: _Course) -> FrameOutput | None:
        """After a slice: the frame's result, or None where boards go on with the next one."""
        now = time.perf_counter_ns()
        course.waits_ns += now - course.clock_ns
        course.clock_ns = now
        course.slices += 1
        course.computing_ns += max(
            board.done.compute_ns for board in course.running if board.done is not None
        )
        halts = b""
        if self._replicas > 1:
            running, halts = self._going_on(course)
        else:
            running = [board for board in course.running if board.reason == StopReason.SLICE]
            if any(board.reason == StopReason.OVERFLOW for board in self._boards):
                running = []
        if running:
            course.running = running
            course.begun, course.end = course.end, 2 * course.end
            if course.end >= course.max_cycles:
                course.end = 0  # the last slice ends where the frame does
            for board in running:
                try:
                    board.resume(course.end, halts)
                except LinkError as error:
                    self._fail(board, error)
            self._posted(course)
            return None
        results = tuple(board.result() for board in self._boards)
        return FrameOutput(
            boards=results,
            register_writes_ns=course.writes_ns,
            compute_ns=course.waits_ns,
            reads_ns=time.perf_counter_ns() - course.clock_ns,
            boards_compute_ns=course.computing_ns,
            slices=course.slices,
        )

    def _going_on(self, course: _Course) -> tuple[list[DrivenBoard], bytes]:
        """Replicas stop by themselves: the boards on which one goes on, and the words of HALT for all that do not.

        A replica goes on if no board's part of it has overflowed; where its own part has stopped there is nothing to halt.
        """
        reasons = np.stack([board.outcomes["reason"] for board in self._boards])
        over = (reasons == StopReason.OVERFLOW).any(axis=0)
        course.halted |= frozenset(np.flatnonzero(over).tolist())
        running = [
            board
            for board in course.running
            if bool(((board.outcomes["reason"] == StopReason.SLICE) & ~over).any())
        ]
        mask = sum(1 << replica for replica in course.halted)
        return running, mask.to_bytes(4 * -(-self._replicas // 32), "little")

    def _abandon(self) -> None:
        """The frame is lost. What the other boards still compute is of no use: a closed link stops them."""
        self._course = None
        for board in self._boards:
            if board.waiting and board.link is not None:
                self._close(board, "another board failed the frame")
                self._interrupted.append(board)

    def _fail(self, board: DrivenBoard, error: LinkError) -> NoReturn:
        """The frame fails because of this board; only one that merely refused stays usable."""
        if isinstance(error, AccessError) and not isinstance(error, StaleHandleError):
            board.waiting = True  # it may have started all the same: run() has it opened again
        else:
            self._close(board, str(error))
        raise board_error(board, error) from error

    def _make_ready(self) -> None:
        """Open again what the last, failed frame left interrupted."""
        while self._interrupted:
            self._open(self._interrupted.pop(), self._timeout)
        for board in self._boards:
            if board.link is None:
                raise BoardGoneError(
                    f"Board {board.index} at {board.endpoint} is not open ({board.broken}): open it again",
                    board=board.index,
                )

    def _open(self, board: DrivenBoard, connect_timeout: float) -> None:
        self._close(board, "it is being opened")
        try:
            board.open(self._timeout, connect_timeout, max(self._timeout, PROGRAMMING_S))
        except PcieShimError as error:
            board.broken = str(error)
            raise board_error(board, error) from error
        assert board.link is not None  # noqa: S101 - open() has made it
        self._by_descriptor[board.link.fileno()] = board
        self._poll.register(board.link.fileno(), select.POLLIN)

    def _close(self, board: DrivenBoard, reason: str) -> None:
        if board in self._interrupted:
            self._interrupted.remove(board)
        if board.link is not None and (descriptor := self._descriptor(board)) is not None:
            self._poll.unregister(descriptor)
            del self._by_descriptor[descriptor]
        board.close(reason)

    def _descriptor(self, board: DrivenBoard) -> int | None:
        """Where a board was polled; a link that closed itself no longer knows."""
        return next((known for known, owner in self._by_descriptor.items() if owner is board), None)

    # ---- what goes into the registers -----------------------------------------------------------------

    def _words(self, frame: FrameInput) -> tuple[bytes, list[bytes], bytes]:
        """Settings, each board's inputs, and the replicas' prior selects, as register words."""
        parameters = self._parameters
        prior_address, selects = (
            (frame.prior_address, b"")
            if self._is_plain and isinstance(frame.prior_address, int)
            else self._prior_selects(frame)
        )
        for name, value, lowest, highest in (
            ("The target count", frame.target_count, 1, parameters.target_count_max),
            ("The most cycles", frame.max_cycles, 1, CYCLES_MAX),
            ("The RNG bank", frame.bank, 0, parameters.rng_banks - 1),
            ("The prior's address", prior_address, 0, parameters.prior_addresses - 1),
        ):
            if not lowest <= value <= highest:
                raise FrameInputError(f"{name} is {value}; this machine takes {lowest} to {highest}")
        if frame.stop not in {"slices", "own"}:
            raise FrameInputError(f"The boards cannot stop by '{frame.stop}': use slices or own")
        settings = _SETTINGS.pack(frame.target_count, frame.max_cycles, frame.bank, prior_address)
        if not self._is_plain:
            return settings, self._input_words(np.asarray(frame.addresses)), selects
        addresses = frame.addresses
        if len(addresses) != parameters.sensors:
            raise FrameInputError(
                f"The frame has {len(addresses)} readings; this machine has {parameters.sensors} sensors"
            )
        words = []
        for column, (address, missing) in enumerate(zip(addresses, self._missing, strict=True), start=1):
            if address is not None and not 0 <= address <= missing:
                raise FrameInputError(
                    f"The address of sensor column {column} is {address}; this machine takes 0 to "
                    f"{missing - 1}, or none"
                )
            words.append(missing if address is None else address)
        return settings, [self._sensor_words.pack(*words)] * len(self._boards), selects

    def _prior_selects(self, frame: FrameInput) -> tuple[int, bytes]:
        """The prior's address (the worst of replicas', for the check of its range), and the words of PRIOR_SELECTS."""
        given = frame.prior_address
        if isinstance(given, tuple):
            if self._replicas == 1 or len(given) != self._replicas:
                raise FrameInputError(
                    f"The frame has {len(given)} addresses of the prior; this machine takes "
                    + (f"one, or {self._replicas}" if self._replicas > 1 else "one")
                )
        elif self._replicas == 1:
            return given, b""
        else:
            given = (given,) * self._replicas
        worst = min(given) if min(given) < 0 else max(given)
        fits = 0 <= worst < self._parameters.prior_addresses
        return worst, np.array(given, dtype="<u4").tobytes() if fits else b""

    def _input_words(self, inputs: npt.NDArray[np.integer]) -> list[bytes]:
        """Each board's words of INPUTS: where cells have inputs, those of its lines."""
        parameters = self._parameters
        per_cell = parameters.sensor_mode is not SensorMode.COLUMN
        replicas, sensors, lines = self._replicas, parameters.sensors, self.total_lines
        shape = (sensors, lines) if per_cell else (sensors,)
        if replicas > 1:
            shape = (replicas, *shape)
        if not sensors:
            return [b""] * len(self._boards)
        if inputs.shape != shape or inputs.dtype.kind not in "ui":
            raise FrameInputError(
                f"The frame's readings have the shape {inputs.shape} and are {inputs.dtype}; this machine takes "
                f"integers of the shape {shape}"
            )
        missing = np.array(self._missing, dtype=np.int64)[:, np.newaxis]
        words = inputs.reshape(replicas, sensors, -1).astype(np.int64)
        absent = words == -1
        partly = absent.any(axis=2) & ~absent.all(axis=2)
        wrong = np.argwhere((~absent & ((words < 0) | (words > missing))) | partly[:, :, np.newaxis] & absent)
        if len(wrong):
            replica, column, line = (int(at) for at in wrong[0])
            where = f" at line {line}" if per_cell else ""
            where += f" of replica {replica}" if replicas > 1 else ""
            top = int(missing[column, 0])
            value = int(words[replica, column, line])
            raise FrameInputError(
                f"The input of sensor column {column + 1}{where} is {value}; this machine takes 0 to "
                f"{top - 1 if parameters.has_tables else top}"
                + (", or -1 in all lines of a missing reading" if per_cell else ", or -1 for none")
            )
        words = np.where(absent, missing, words).astype("<u4")
        if not per_cell:
            return [words.tobytes()] * len(self._boards)
        offsets = [board.image.partition.line_offset for board in self._boards]
        return [
            words[:, :, offset : offset + board.lines].tobytes()
            for offset, board in zip(offsets, self._boards, strict=True)
        ]

    def _priors(self, frame: FrameInput) -> list[npt.NDArray[np.uint16] | None]:
        """Each board's part of the written prior; None where the prior is a table."""
        codes = frame.prior_codes
        if self._parameters.prior_mode is not PriorMode.WRITTEN:
            if codes is not None:
                raise FrameInputError("The frame has a prior to write, but the machine's prior is a table")
            return [None] * len(self._boards)
        if codes is None:
            own = [board.image.machine.prior[0] for board in self._boards]
            return list(own) if self._replicas == 1 else [np.tile(codes, self._replicas) for codes in own]
        several = codes.shape == (self._replicas, self.total_lines) and self._replicas > 1
        if (
            not (several or codes.shape == (self.total_lines,))
            or int(codes.max()) > self._parameters.ones_code
        ):
            raise FrameInputError(
                f"The prior to write has shape {codes.shape} and codes up to {codes.max()}; this machine takes "
                f"{self.total_lines} codes from 0 to {self._parameters.ones_code}"
                + (f", or so many for each of its {self._replicas} replicas" if self._replicas > 1 else "")
            )
        offsets = [board.image.partition.line_offset for board in self._boards]
        by_line = np.broadcast_to(codes, (self._replicas, self.total_lines))
        return [
            by_line[:, offset : offset + board.lines].reshape(-1)
            for offset, board in zip(offsets, self._boards, strict=True)
        ]


def _check_images(boards: int, images: Sequence[Image]) -> None:
    """Refuse images that are not the parts of one model, in order."""
    if boards != len(images) or not images:
        raise ImageMismatchError(f"There are {boards} endpoints for {len(images)} images; one each is needed")
    offset = 0
    first = images[0]
    for index, image in enumerate(images):
        part = image.partition
        if (part.index, part.count, part.line_offset) != (index, len(images), offset):
            raise ImageMismatchError(
                f"Image {index} is part {part.index} of {part.count} from line {part.line_offset} on; part "
                f"{index} of {len(images)} from line {offset} on is needed here"
            )
        if image.model_hash != first.model_hash or part.total_lines != first.partition.total_lines:
            raise ImageMismatchError(
                f"Image {index} belongs to model {image.model_hash}, image 0 to {first.model_hash}"
            )
        offset += image.machine.parameters.lines
    if offset != first.partition.total_lines:
        raise ImageMismatchError(
            f"The images hold {offset} lines, the model has {first.partition.total_lines}"
        )
