"""The PCIe application: the only process that drives boards (thesis 3.2, figure 3.3).

One blocking thread serves the master and all boards: a frame comes in, its readings and the start are
posted to every board, the counts are collected, and the result goes back.
"""

from __future__ import annotations

import selectors
import socket
import sys
import time
from typing import Annotated

import typer

from pcie_shim.endpoint import Endpoint, listen, remove_listener
from pcie_shim.errors import (
    BoardError,
    PcieShimError,
)
from pcie_shim.host.frame import FrameOutput
from services.commands import flags as options
from services.errors import LocalSocketError, OtherPeerError, SettingsError
from services.pipeline.mini_cluster import TICK, Boards, frame_failed, result_record
from services.pipeline.standard_input import compute_lines
from services.settings import load_settings
from services.sockets.local_socket import BlockingRecordSocket, check_hello, own_hello
from services.sockets.records import (
    AnyRecord,
    Frame,
    Hello,
    LossReason,
    Notice,
    Prepare,
    Ready,
    Record,
    Switch,
    Trouble,
)
from services.sockets.serving import board_endpoints, deployment_for, endpoint_from, outdated
from services.sockets.status import (
    FrameCounts,
    ProcessStatus,
    reasons,
    seconds_since,
    status_thread,
)
from services.supervision.parent import end_with_parent
from terminal.command_line import CommandLine
from terminal.errors import ExitCode, exit_code_of
from terminal.logs import get_logger
from terminal.signals import check_signals
from toolchain.deployment import Deployment

ROLE = "pcie-app"


class Progress:
    """What was asked of the boards and what became of it: counts for the status, lines for the log."""

    def __init__(self, boards: Boards, log_level: str) -> None:
        self._boards = boards
        self._follows = log_level == "debug"
        self._log = get_logger(ROLE, log_level)
        self._computed = 0
        self._last: tuple[int, int, FrameOutput] | None = None
        self.asked = 0
        self.failed = 0
        self.ready: Ready | None = None

    def computed(self, number: int, output: FrameOutput) -> None:
        """A frame has its result."""
        self._computed += 1
        self._last = (number, time.monotonic_ns(), output)
        if self._follows:
            self._log.debug(
                "computed",
                frame=number,
                cycles=max(board.cycles for board in output.boards),
                compute_us=output.compute_ns // 1000,
            )

    def status(self) -> ProcessStatus:
        """What this process knows; may be called by another thread."""
        number, tick, output = self._last or (0, 0, None)
        gone = next(iter(dict(self._boards.gone).items()), None)
        if self.ready is None:
            why = "waiting for the boards to be opened and programmed"
        elif gone is not None:
            why = gone[1]  # names the board
        else:
            why = self.ready.sentence
        return ProcessStatus(
            ready=self.ready is not None and gone is None,
            why=why,
            deployment=self._boards.generations.deployment.hash,
            generation=self._boards.generations.number,
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
    """Serves one master at a time over a local socket."""

    def __init__(self, boards: Boards, endpoint: Endpoint, log_level: str = "info") -> None:
        self._boards = boards
        self._endpoint = endpoint
        self._where = f"{ROLE} at {endpoint}"
        self._master: BlockingRecordSocket | None = None
        self._greeted = False
        self._progress = Progress(boards, log_level)
        self._selector = selectors.DefaultSelector()

    @property
    def _deployment(self) -> Deployment:
        return self._boards.generations.deployment

    def serve(self) -> int:
        """Serve until a signal raises in this thread.

        Raises:
            PcieShimError: the boards can't be opened, or one came back as another.
            OutdatedError: the folder was changed, and a master asks for what is there now.
        """
        listener = listen(self._endpoint)
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)
        try:
            try:
                self._progress.ready = Ready(self._boards.open())
                while True:
                    check_signals()
                    for key, _ in self._selector.select(TICK):
                        if key.fileobj is listener:
                            self._accept(listener)
                        else:
                            self._receive()
                    self._mend_boards()
            except PcieShimError as error:
                self._report(listener, Trouble(exit_code_of(error), str(error)))
                raise
        finally:
            self._boards.close()
            if self._master is not None:
                self._master.close()
            remove_listener(self._endpoint, listener)

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
        # a master that started with us may need a moment to connect
        deadline = time.monotonic() + 2
        while not self._greeted and time.monotonic() < deadline:
            for key, _ in self._selector.select(0.05):
                if key.fileobj is listener:
                    self._accept(listener)
                else:
                    self._receive()
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
                if self._greeted:
                    self._take(record)
                else:
                    self._greet(record)
        except (LocalSocketError, OtherPeerError) as error:
            master.send(Trouble(error.exit_code, str(error)))
            self._drop()

    def _greet(self, record: AnyRecord) -> None:
        try:
            check_hello(record, "master", self._deployment.hash, self._where)
        except OtherPeerError as error:
            if (why := outdated(self._deployment, record)) is None:
                raise
            if self._master is not None:
                self._master.send(Trouble(error.exit_code, str(error)))
            raise why from error
        self._greeted = True
        self._take(record)
        if self._progress.ready is not None:
            self._send(self._progress.ready)

    def _take(self, record: AnyRecord) -> None:
        match record:
            case Frame():
                self._compute(record)
            case Hello():
                self._boards.generations.greeted(record)
            case Prepare():
                self._send(self._boards.generations.prepare(record))
            case Switch():
                self._send(self._boards.switch(record))
            case _:
                pass  # nothing else is for boards

    def status(self) -> ProcessStatus:
        """What this process knows; called by the status socket's thread."""
        return self._progress.status()

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

    def _mend_boards(self) -> None:
        for board in self._boards.mend():
            self._send(Notice("info", f"board {board} is back, programmed"))


app = CommandLine(
    help="Drive the boards of a mini-cluster.\n\n"
    "Alone it reads readings from standard input (what `subscriber --deployment` prints) and prints counts:\n\n"
    "`echo '{\"addresses\": [71, 50, 50, 45, 18, 72]}' | pcie-app -d build/boat --boards unix:/tmp/b/board0.sock,...`\n\n"
    "With `--listen ENDPOINT` it serves a master."
)


@app.command(help=app.info.help)
def pcie_app(
    deployment: options.Deployment = None,
    boards: options.Boards = None,
    listen_at: options.Listen = None,
    stop: options.Stop = None,
    peer_timeout: options.PeerTimeout = None,
    board_timeout: options.BoardTimeout = None,
    reprogram: Annotated[
        bool,
        typer.Option(
            "--reprogram/--no-reprogram",
            help="Program boards that hold another image, instead of refusing them.",
        ),
    ] = False,
    log_level: options.LogLevel = None,
) -> int:
    """Drive the boards of a mini-cluster."""
    end_with_parent()
    settings = load_settings(
        deployment=deployment,
        boards=boards,
        stop=stop,
        peer_timeout=peer_timeout,
        board_timeout=board_timeout,
        log_level=log_level,
    )
    loaded = deployment_for(settings, images=True)
    opened = Boards(settings, loaded, board_endpoints(settings, loaded), reprogram=reprogram)
    if listen_at is not None:
        pcie = PcieApp(opened, endpoint_from(listen_at, "--listen"), settings.log_level)
        with status_thread(settings.run_directory, ROLE, pcie.status):
            return pcie.serve()
    if sys.stdin.isatty():
        msg = "pcie-app reads readings from standard input, which is a terminal: pipe them in, or use --listen (pcie-app --help)"
        raise SettingsError(msg)
    return compute_lines(opened, loaded.machine.rng_banks)


def main() -> None:
    """Entry point of the command `pcie-app`."""
    app()
