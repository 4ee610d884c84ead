"""pcie-app, the only process that drives boards (thesis 3.2, figure 3.3).

One blocking thread serves the master and all boards: it posts the readings and the start of a frame to every
board, collects the counts, and returns the result.
"""

import selectors
import socket
import time

from pcie_shim.endpoint import Endpoint, listen, remove_listener
from pcie_shim.errors import BoardError, PcieShimError
from pcie_shim.host.frame import FrameOutput
from services.boards.deployed import TICK, DeployedBoards
from services.boards.frames import frame_failed, result_record
from services.errors import LocalSocketError, OtherPeerError
from services.sockets.local_socket import BlockingRecordSocket, check_hello, own_hello
from services.sockets.records import (
    AnyRecord,
    Frame,
    LossReason,
    Notice,
    Ready,
    Record,
    Trouble,
)
from services.sockets.reporting import STUCK_S
from services.sockets.serving import outdated
from services.sockets.status import FrameCounts, ProcessStatus, reasons, seconds_since
from terminal.errors import ExitCode, exit_code_of
from terminal.logs import get_logger
from terminal.signals import check_signals

ROLE = "pcie-app"


class Progress:
    """Counts of frames for the status, and their log lines."""

    def __init__(self, boards: DeployedBoards, log_level: str) -> None:
        self._boards = boards
        self._logs_frames = log_level == "debug"
        self._log = get_logger(ROLE, log_level)
        self._computed = 0
        self._last: tuple[int, int, FrameOutput] | None = None
        self.asked = 0
        self.failed = 0
        self.ready: Ready | None = None

    def computed(self, number: int, output: FrameOutput) -> None:
        """Count and log a computed frame."""
        self._computed += 1
        self._last = (number, time.monotonic_ns(), output)
        if self._logs_frames:
            self._log.debug(
                "computed",
                frame=number,
                cycles=max(board.cycles for board in output.boards),
                compute_us=output.compute_ns // 1000,
            )

    def status(self) -> ProcessStatus:
        """Return the status of this process; may be called from another thread."""
        number, tick, output = self._last or (0, 0, None)
        gone = next(iter(dict(self._boards.gone).items()), None)
        if self.ready is None:
            why = "waiting for the boards to be opened and programmed"
        elif gone is not None:
            why = gone[1]  # the sentence names the board
        else:
            why = self.ready.sentence
        return ProcessStatus(
            ready=self.ready is not None and gone is None,
            why=why,
            deployment=self._boards.deployment.hash,
            boards=self._boards.status(output),
            frames=FrameCounts(
                received=self.asked,
                completed=self._computed,
                lost=reasons({LossReason.FAILED: self.failed}),
                last_number=number or None,
                last_age_s=seconds_since(tick),
            ),
        )


class PcieApp:
    """Service for one master at a time over a local socket."""

    def __init__(self, boards: DeployedBoards, endpoint: Endpoint, log_level: str = "info") -> None:
        self._boards = boards
        self._deployment = boards.deployment
        self._endpoint = endpoint
        self._where = f"{ROLE} at {endpoint}"
        self._master: BlockingRecordSocket | None = None
        self._greeted = False
        self._progress = Progress(boards, log_level)
        self._selector = selectors.DefaultSelector()
        self._turned = 0.0

    def serve(self) -> int:
        """Serve until a signal raises in this thread.

        Raises:
            PcieShimError: The boards cannot be opened, or a board came back with another image.
            OutdatedError: A master uses the current content of the folder, and this service an earlier one.
        """
        listener = listen(self._endpoint)
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)
        try:
            try:
                self._progress.ready = Ready(self._boards.open())
                while True:
                    check_signals()
                    self._turned = time.monotonic()
                    self._poll(listener, TICK)
                    self._recover_boards()
            except PcieShimError as error:
                self._report(listener, Trouble(exit_code_of(error), str(error)))
                raise
        finally:
            self._boards.close()
            if self._master is not None:
                self._master.close()
            remove_listener(self._endpoint, listener)

    def _poll(self, listener: socket.socket, timeout: float) -> None:
        """Handle what arrives within `timeout` seconds."""
        for key, _ in self._selector.select(timeout):
            if key.fileobj is listener:
                self._accept(listener)
            else:
                self._receive()

    def _accept(self, listener: socket.socket) -> None:
        connection = BlockingRecordSocket(listener.accept()[0], self._where)
        if self._master is not None:
            connection.send(Trouble(ExitCode.USAGE, f"the {self._where} serves another master already"))
            connection.close()
            return
        self._master = connection
        self._greeted = False
        self._selector.register(connection, selectors.EVENT_READ)
        connection.send(own_hello(ROLE, self._deployment.hash))

    def _drop(self) -> None:
        if self._master is not None:
            self._selector.unregister(self._master)
            self._master.close()
            self._master = None

    def _send(self, record: Record) -> None:
        if self._master is not None and self._greeted and not self._master.send(record):
            self._drop()

    def _report(self, listener: socket.socket, trouble: Trouble) -> None:
        # a master that was started with us may still be connecting
        deadline = time.monotonic() + 2
        while not self._greeted and time.monotonic() < deadline:
            self._poll(listener, 0.05)
        self._send(trouble)

    def _receive(self) -> None:
        master = self._master
        if master is None:
            return
        try:
            records = master.receive()
            if records is None:
                self._drop()
                return
            for record in records:
                if not self._greeted:
                    self._greet(record)
                elif isinstance(record, Frame):  # other records do not concern boards
                    self._compute(record)
        except (LocalSocketError, OtherPeerError) as error:
            master.send(Trouble(error.exit_code, str(error)))
            self._drop()

    def _greet(self, record: AnyRecord) -> None:
        try:
            check_hello(record, "master", self._deployment.hash, self._where)
        except OtherPeerError as error:
            if (reason := outdated(self._deployment, record)) is None:
                raise
            if self._master is not None:
                self._master.send(Trouble(error.exit_code, str(error)))
            raise reason from error
        self._greeted = True
        if self._progress.ready is not None:
            self._send(self._progress.ready)

    def status(self) -> ProcessStatus:
        """Return the status of this process; called from the thread of the status socket."""
        return self._progress.status()

    def is_alive(self) -> bool:
        """Return whether the boards' thread makes progress; opening the boards has its own limits."""
        return not self._turned or time.monotonic() - self._turned < STUCK_S

    def _compute(self, frame: Frame) -> None:
        progress = self._progress
        progress.asked += 1
        try:
            output = self._boards.run(frame)
        except BoardError as error:
            progress.failed += 1
            self._send(frame_failed(frame.number, error))
        else:
            self._send(result_record(frame.number, output))
            progress.computed(frame.number, output)

    def _recover_boards(self) -> None:
        for board in self._boards.recover():
            self._send(Notice("info", f"board {board} is back, programmed"))
