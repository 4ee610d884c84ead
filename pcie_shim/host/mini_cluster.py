"""The mini-cluster: all boards of a model, driven by one blocking thread (thesis 3.2, figure 3.3).

    post ──▶ start to board 0, 1, ... ─┐
                                       ├─ collect: all have answered ──▶ the last slice? ──▶ FrameOutput
             resume to those that ◀────┘                                      │
             have not stopped      ◀──────────────── no ──────────────────────┘

The host posts the sensors and the start of a frame to every board, and only then waits. When all boards have
stopped, it reads their results. Boards stop together (`slices`) or independently (`own`, as in the thesis).
"""

import select
import time
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Thread
from typing import Final, NoReturn, Self

from machines.errors import StartError
from machines.kind import BoardResult, FrameCourse, FrameInput
from pcie_shim.endpoint import Endpoint, parse_endpoint
from pcie_shim.errors import (
    AccessError,
    FrameInputError,
    ImageMismatchError,
    LinkClosedError,
    LinkError,
    PcieShimError,
    StaleHandleError,
)
from pcie_shim.host.driven_board import DrivenBoard, board_error
from pcie_shim.host.socket_link import LONGEST_POLL_S
from pcie_shim.programming_file import Image

SLACK_S: Final = 5.0
"""Default of `slack`: seconds that each slice of a frame may take in addition to the time for the slice's cycles."""
FIRST_WAIT_S: Final = 0.01
"""Maximum number of seconds for which `collect` polls only the board that was started last."""
PROGRAMMING_S: Final = 30.0
"""Minimum timeout of each step of programming a blank board, in seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOutput:
    """The results of a frame, and its durations in nanoseconds (thesis figure 4.5).

    Attributes:
        boards: One result per board, in the order of the partition.
        register_writes_ns: Time for posting settings, sensors, starts and resumes.
        compute_ns: Time spent waiting for the boards, for computing and for transport.
        reads_ns: Time for reading the results, or for copying results that came with the interrupts.
        boards_compute_ns: Computing time of the slowest board of each slice, summed over the slices. Unlike
            `compute_ns`, `boards_compute_ns` does not contain the transport. If emulated boards share a core,
            `boards_compute_ns` also contains computing times of the other boards on the core.
        slices: Number of slices.
        link_bytes: Bytes between the host and all boards, in both directions, with the headers of the link.
        link_transfers: Number of transfers between the host and all boards.
    """

    boards: tuple[BoardResult, ...]
    register_writes_ns: int
    compute_ns: int
    reads_ns: int
    boards_compute_ns: int
    slices: int
    link_bytes: int
    link_transfers: int


class _Progress:
    """Progress of the posted frame."""

    def __init__(self, max_cycles: int, course: FrameCourse, boards: Sequence[DrivenBoard]) -> None:
        self.max_cycles = max_cycles
        self.course = course

        # The boards that were started for this slice, and how many of them have not answered yet.
        self.running = boards
        self.left = 0

        # The cycles of the slice, the seconds that they may take, and the monotonic time when these seconds are over.
        self.cycles = 0
        self.limit = 0.0
        self.deadline = 0.0

        # For the output: finished slices, and nanoseconds of each stage since the last look at the clock.
        self.slices = 0
        self.writes_ns = self.waits_ns = self.reads_ns = self.computing_ns = 0
        self.clock_ns = time.perf_counter_ns()

        # Bytes and transfers of the boards' links before this frame.
        self.traffic = _traffic(boards)


class MiniCluster:
    """All boards of a deployment, in the order of the partition. Only one thread may use a MiniCluster."""

    def __init__(self, boards: Sequence[DrivenBoard], *, timeout: float, slack: float) -> None:
        """Store the boards without connecting. Use `open`, which also connects."""
        self._boards = tuple(boards)
        first = self._boards[0].image
        self._machines = first.kind.on_host([board.image.machine for board in self._boards])
        self._timeout = timeout
        self._slack = slack

        # The posted frame, from `post` until `collect` returns its result or either raises an error.
        self._progress: _Progress | None = None

        # Boards that were still computing or answering when another one failed the frame. Their links were closed,
        # which stops them, and the next frame opens them again; for the caller they are open.
        self._interrupted: list[DrivenBoard] = []

        # The links of all open boards: registered in the poll when a board is opened, removed when it is closed.
        self._poll = select.poll()
        self._by_descriptor: dict[int, DrivenBoard] = {}

    @classmethod
    def open(
        cls,
        endpoints: Sequence[Endpoint | str],
        images: Sequence[Image],
        *,
        timeout: float = 10.0,
        slack: float = SLACK_S,
        reprogram: bool = False,
    ) -> Self:
        """Open all boards.

        For each board, check the identity, the liveness and the image. Blank boards are programmed, and all machines
        are reset.

        Args:
            endpoints: The boards, in the order of the partition.
            images: The image of each board.
            timeout: Maximum time in seconds until a board listens, and until a board answers a request.
            slack: Number of seconds added to the time limit of each slice of a frame. The rest of the limit is computed
                from the number of cycles and the boards' measured speed.
            reprogram: If True, program a board that has another image, now and at each `reopen`. If False, refuse
                the board.

        Raises:
            EndpointError: An endpoint is invalid.
            ImageMismatchError: The images are not the parts of one model.
            BoardError: A board cannot be opened. The boards that are already open are closed.
        """
        places = [parse_endpoint(place) if isinstance(place, str) else place for place in endpoints]
        _check_images(len(places), images)
        boards = [
            DrivenBoard(index, place, image, reprogram=reprogram)
            for index, (place, image) in enumerate(zip(places, images, strict=True))
        ]
        cluster = cls(boards, timeout=timeout, slack=slack)
        try:
            cluster._open_all()
        except BaseException:
            cluster.close()
            raise
        return cluster

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def is_open(self, board: int) -> bool:
        """Return whether the board with the index `board` is usable. If it is not, call `reopen`."""
        return self._boards[board].link is not None or self._boards[board] in self._interrupted

    def reopen(self, board: int, *, timeout: float | None = None) -> None:
        """Reopen a board that has restarted or lost its link. Program the board if it is blank.

        Raises a BoardError if the board cannot be reopened.
        """
        self._open(self._boards[board], self._timeout if timeout is None else timeout)

    def close(self) -> None:
        """Close all links. This stops the boards that are running."""
        self._progress = None
        for board in self._boards:
            self._close(board, "the mini-cluster was closed")

    # ---- a frame --------------------------------------------------------------------------------------

    def run(self, frame: FrameInput) -> FrameOutput:
        """Compute one frame on all boards.

        After an error, the frame is lost. If a board only refused an access, all boards stay usable. Otherwise, the
        failed board must be reopened with `reopen`, and only the other boards stay usable.

        Raises:
            FrameInputError: The frame does not fit the machine. No board was accessed.
            BoardError: The board with the number `error.board` failed.
        """
        self.post(frame)
        while (output := self.collect(LONGEST_POLL_S)) is None:
            pass
        return output

    def post(self, frame: FrameInput) -> None:
        """Start a frame on all boards without waiting. `collect` returns the result. Raises the errors of `run`."""
        if self._progress is not None:
            raise FrameInputError("A frame is in progress; collect its result before posting the next")
        try:
            course = self._machines.begin(frame)
        except StartError as error:
            raise FrameInputError(str(error)) from error
        self._make_ready()
        progress = self._progress = _Progress(frame.max_cycles, course, self._boards)
        try:
            settings, end = course.settings, course.end
            for board, blocks in zip(self._boards, course.starts, strict=True):
                try:
                    board.start(settings, blocks, end)
                except LinkError as error:
                    self._fail(board, error)
            self._expect_done(progress)
        except BaseException:
            self._abandon()
            raise

    def collect(self, seconds: float) -> FrameOutput | None:
        """Receive the answers to the posted frame. After the last answer, start the next slice, if any.

        `collect` waits for at most `seconds`. It returns the frame's result, or None if boards are still running.
        After None, wait until the file descriptor `awaited` is readable, and call `collect` again. Raises the errors
        of `run`.
        """
        progress = self._progress
        if progress is None:
            raise FrameInputError("No frame is in progress: post one first")
        try:
            if not self._receive(progress, seconds):
                return None
            output = self._next_slice(progress)
        except BaseException:
            self._abandon()
            raise
        if output is not None:
            self._progress = None
        return output

    @property
    def awaited(self) -> int | None:
        """Descriptor to poll before the next `collect`, or None if no board is running."""
        progress = self._progress
        if progress is None:
            return None
        board = next((board for board in reversed(progress.running) if board.waiting), None)
        return None if board is None or board.link is None else board.link.fileno()

    @property
    def seconds_left(self) -> float:
        """Seconds until the deadline of the running slice, or 0 without a frame."""
        return 0.0 if self._progress is None else max(0.0, self._progress.deadline - time.monotonic())

    def _expect_done(self, progress: _Progress) -> None:
        """Set the deadline of a slice that has just been started."""
        # emulated boards may all run on one core
        cycles = (progress.course.end or progress.max_cycles) - progress.course.begun
        progress.cycles = cycles
        progress.limit = self._slack + cycles * len(self._boards) / min(board.speed for board in self._boards)
        progress.deadline = time.monotonic() + progress.limit
        progress.left = len(progress.running)
        now = time.perf_counter_ns()
        progress.writes_ns += now - progress.clock_ns
        progress.clock_ns = now

    def _receive(self, progress: _Progress, seconds: float) -> bool:
        """Receive from the boards, for at most `seconds`; return whether every running board is done."""
        # The board that was started last is usually the last to be done, and waking up for each of the others
        # would take CPU time from those that compute. The poll of all boards detects a failed or slower one.
        if seconds and progress.left == len(progress.running):
            progress.running[-1].readable.poll(min(seconds, FIRST_WAIT_S) * 1000)
        while progress.left:
            remaining = progress.deadline - time.monotonic()
            events = self._poll.poll(min(max(remaining, 0.0), seconds) * 1000)
            if not events:
                if remaining <= 0:
                    late = next(board for board in progress.running if board.waiting)
                    self._fail(
                        late, late.open_link.timeout_error(progress.limit, f"finish {progress.cycles} cycles")
                    )
                return False
            for descriptor, _ in events:
                board = self._by_descriptor[descriptor]
                try:
                    progress.left -= board.receive()
                except LinkError as error:
                    self._fail(board, error)
        return True

    def _next_slice(self, progress: _Progress) -> FrameOutput | None:
        """If the last slice of the frame is done, return the result. Otherwise start the next slice and return None."""
        # a board reports its computing time in this slice: the longest one of each slice is added up
        now = time.perf_counter_ns()
        progress.waits_ns += now - progress.clock_ns
        progress.clock_ns = now
        progress.slices += 1
        progress.computing_ns += max(
            board.done.compute_ns for board in progress.running if board.done is not None
        )
        # all are asked before any is waited for: their round trips overlap
        for act in (DrivenBoard.ask, DrivenBoard.fetch):
            for board in progress.running:
                try:
                    act(board)
                except LinkError as error:
                    self._fail(board, error)
        now = time.perf_counter_ns()
        progress.reads_ns += now - progress.clock_ns
        progress.clock_ns = now
        course = progress.course
        numbers, blocks = course.proceed(
            [board.reasons for board in self._boards], [board.answer for board in self._boards]
        )
        if numbers:
            progress.running = [self._boards[number] for number in numbers]
            for board in progress.running:
                try:
                    board.resume(course.settings, blocks, course.end)
                except LinkError as error:
                    self._fail(board, error)
            self._expect_done(progress)
            return None
        results = course.conclude([board.result() for board in self._boards])
        (size, transfers), (size_before, transfers_before) = _traffic(self._boards), progress.traffic
        return FrameOutput(
            boards=tuple(results),
            register_writes_ns=progress.writes_ns,
            compute_ns=progress.waits_ns,
            reads_ns=progress.reads_ns + time.perf_counter_ns() - progress.clock_ns,
            boards_compute_ns=progress.computing_ns,
            slices=progress.slices,
            link_bytes=size - size_before,
            link_transfers=transfers - transfers_before,
        )

    def _abandon(self) -> None:
        """Drop the frame, and close the links of boards that are still computing or sending an answer."""
        self._progress = None
        # only closing its link stops a board, or drops its answers; those that are done stay open
        for board in self._boards:
            if board.waiting or board.asked:
                self._close(board, "another board failed the frame")
                self._interrupted.append(board)

    def _fail(self, board: DrivenBoard, error: LinkError) -> NoReturn:
        """Raise a BoardError for this board, after closing its link unless the board only refused an access."""
        if isinstance(error, AccessError) and not isinstance(error, StaleHandleError):
            board.waiting = True  # it may have started anyway: the next frame reopens it
        else:
            self._close(board, str(error))
        raise board_error(board, error) from error

    def _make_ready(self) -> None:
        """Reopen the boards whose frame was abandoned."""
        while self._interrupted:
            self._open(self._interrupted.pop(), self._timeout)
        for board in self._boards:
            try:
                _ = board.open_link
            except LinkClosedError as error:
                raise board_error(board, error) from error

    def _open_all(self) -> None:
        """Open all boards at the same time, because each takes a tenth of a second to load its machine."""
        failed: dict[int, BaseException] = {}

        def attempt(board: DrivenBoard) -> None:
            try:
                self._connect(board, self._timeout)
            except BaseException as error:
                failed[board.index] = error

        # unlike those of an executor, these threads do not delay the end of the process
        threads = [Thread(target=attempt, args=(board,), daemon=True) for board in self._boards]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if failed:
            raise failed[min(failed)]
        for board in self._boards:
            self._register(board)

    def _open(self, board: DrivenBoard, connect_timeout: float) -> None:
        # this board's link may still be open, if only another board has failed
        self._close(board, "it is being opened")
        self._connect(board, connect_timeout)
        self._register(board)

    def _connect(self, board: DrivenBoard, connect_timeout: float) -> None:
        try:
            board.open(self._timeout, connect_timeout, max(self._timeout, PROGRAMMING_S))
        except PcieShimError as error:
            board.broken = str(error)
            raise board_error(board, error) from error

    def _register(self, board: DrivenBoard) -> None:
        descriptor = board.open_link.fileno()
        self._by_descriptor[descriptor] = board
        self._poll.register(descriptor, select.POLLIN)

    def _close(self, board: DrivenBoard, reason: str) -> None:
        if board in self._interrupted:
            self._interrupted.remove(board)
        # its link does not know the descriptor any more if it has closed itself; none if its opening was interrupted
        for descriptor in [known for known, owner in self._by_descriptor.items() if owner is board]:
            self._poll.unregister(descriptor)
            del self._by_descriptor[descriptor]
        board.close(reason)


def _traffic(boards: Sequence[DrivenBoard]) -> tuple[int, int]:
    links = [board.open_link for board in boards]
    return sum(link.bytes_moved for link in links), sum(link.transfers for link in links)


def _check_images(boards: int, images: Sequence[Image]) -> None:
    """Raise an error unless the images are all parts of one model, in the order of the parts."""
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
        offset += image.registers.lines
    if offset != first.partition.total_lines:
        raise ImageMismatchError(
            f"The images hold {offset} lines, the model has {first.partition.total_lines}"
        )
