"""`pcie-app` without a master. It takes readings from standard input, runs them on boards, and prints the counts."""

from collections.abc import Mapping

import msgspec
import numpy as np

from pcie_shim.errors import FrameInputError
from pcie_shim.host.mini_cluster import FrameOutput
from services.boards.deployed import DeployedBoards
from services.boards.frames import result_record
from services.errors import InputLineError
from services.pipeline.inference import infer
from services.pipes.lines import LineBoard, LineReading, LineResult, blocking_lines, decoded
from services.sockets.records import FrameRequest
from terminal.output import print_json_line, say, say_if_slow


def reading_from_line(line: bytes, number: int) -> LineReading:
    """Decode the reading in line `number` of standard input, or raise an InputLineError."""
    reading: LineReading = decoded(
        line, number, LineReading, 'a reading such as {"addresses": [12, null, 7]}'
    )
    return reading


def compute_lines(boards: DeployedBoards, banks: int) -> int:
    """Compute a frame for each reading of standard input, and print its result.

    Frames use the boards' seed banks from 0 to `banks` - 1, and then begin again with bank 0.

    Raises:
        InputLineError: A line is not a reading for this deployment.
        BoardError: A board failed.
    """
    # boards that compile their kernels take a minute
    with say_if_slow("waiting for the boards"):
        opened = boards.open()
    say(opened)
    deployment = boards.deployment
    reasons, own = deployment.machine.kind.reasons, deployment.new_filter()
    try:
        for number, line in blocking_lines():
            reading = reading_from_line(line, number)
            prior = np.array(reading.prior_codes, "<u2") if own is None else own.predict()
            codes = prior.astype("<u2").tobytes()
            # as the master chooses it, so that the same readings give the same counts
            frame = FrameRequest(number, reading.addresses, number % banks, codes)
            try:
                output = boards.run(frame)
            except FrameInputError as error:
                raise InputLineError(f"line {number} of standard input: {error}") from error
            if own is not None:
                own.update(infer(result_record(number, output), deployment).posterior)
            print_json_line(msgspec.to_builtins(_line(number, output, reading, reasons)))
    finally:
        boards.close()
    return 0


def _line(number: int, output: FrameOutput, reading: LineReading, reasons: Mapping[int, str]) -> LineResult:
    return LineResult(
        number=number,
        stamp_ns=reading.stamp_ns,
        addresses=[-1 if isinstance(each, list) else each for each in reading.addresses],
        values=reading.values,
        boards=[
            LineBoard(
                np.frombuffer(board.words, "<u4").tolist(),
                board.cycles,
                board.reason,
                reasons[board.reason],
                board.replica_cycles,
                board.replica_reasons,
                board.kept,
            )
            for board in output.boards
        ],
    )
