"""Conversion of frames to the driver's input, and of the driver's results to records."""

import math
from collections.abc import Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from machines.kind import BoardResult, FrameInput
from pcie_shim.errors import BoardError, FrameInputError
from pcie_shim.host.mini_cluster import FrameOutput
from services.sockets.records import Addresses, FailureReason, FrameFailed, FrameRequest, FrameResult
from terminal.errors import exit_code_of
from toolchain.deployment import Deployment, Variable

_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(list[BoardResult])

PriorRow = int | tuple[int, ...]
"""Number of a row in the prior's table. With replicas, a tuple with a row number for each replica."""


class BoardAwayError(BoardError):
    """Raised while a board that failed an earlier frame is not available again yet."""


def driver_input(deployment: Deployment, frame: FrameRequest, stop: str) -> FrameInput:
    """Return the driver's input for a frame, or raise a FrameInputError.

    `stop` says how boards stop: together at the end of a slice (`slices`), or each at its own overflow (`own`).
    """
    machine = deployment.machine
    prior = np.frombuffer(frame.prior_codes, "<u2") if frame.prior_codes else None
    addresses: tuple[int | None, ...] | npt.NDArray[np.int64]
    row: PriorRow = 0
    if machine.is_plain:
        addresses = tuple(each for each in frame.addresses if not isinstance(each, list))
        if len(addresses) != len(frame.addresses):
            raise FrameInputError(
                "The frame has several readings of a variable; this machine takes one of each"
            )
        # too few or too many addresses are the driver's error, which names both numbers
        if deployment.prior_select is not None and len(addresses) == len(deployment.variables):
            addresses, row = deployment.machine_addresses(addresses)
    else:
        addresses, row = machine_inputs(deployment, frame.addresses)
        if prior is not None and prior.size == machine.results and machine.replicas > 1:
            prior = prior.reshape(-1, machine.lines)
    return FrameInput(
        addresses=addresses,
        prior_address=row,
        prior_codes=prior,
        target_count=machine.target_count,
        max_cycles=machine.max_cycles,
        bank=frame.bank,
        stop="own" if stop == "own" else "slices",
    )


def machine_inputs(deployment: Deployment, addresses: Addresses) -> tuple[npt.NDArray[np.int64], PriorRow]:
    """Return a frame's inputs and its row of the prior, for a machine with the block INPUTS. A missing input is -1."""
    variables = deployment.variables
    if len(addresses) != len(variables):
        raise FrameInputError(
            f"The frame has {len(addresses)} readings; this deployment has {len(variables)} variables"
        )
    machine = deployment.machine
    replicas = machine.replicas
    sensors: list[npt.NDArray[np.int64]] = []
    row: PriorRow = 0
    for variable, given in zip(variables, addresses, strict=True):
        array = _row(deployment, variable, given)
        if variable.kind == "sensor":
            sensors.append(array.reshape(replicas, -1))
        else:
            # the top row is the prior without a selection
            rows = np.where(array == -1, 2**variable.bits - 1, array)
            row = tuple(rows.tolist()) if rows.ndim else int(rows)
    per_line = (machine.lines,) if machine.reads_lines else ()
    stacked = np.stack(sensors, axis=1) if sensors else np.empty((replicas, 0, *per_line), dtype=np.int64)
    shape = (len(sensors), *per_line)
    return stacked.reshape((replicas, *shape) if replicas > 1 else shape), row


def _row(deployment: Deployment, variable: Variable, given: int | list[int] | None) -> npt.NDArray[np.int64]:
    # numbers from a pipe or another program: the deployment's own readings have been checked by the subscriber
    shape = deployment.reading_shape(variable)
    if given is None:
        return np.full(shape, -1, dtype=np.int64)
    try:
        array = np.array(given, dtype=np.int64)
    except OverflowError:
        raise FrameInputError(
            f"The reading of {variable.name} has an address that exceeds every machine"
        ) from None
    expected = math.prod(shape)
    if array.size != expected or (array.ndim == 0 and shape):
        found = array.size if array.ndim else "one"
        noun = "address" if array.size == 1 else "addresses"
        raise FrameInputError(
            f"The reading of {variable.name} has {found} {noun}; this deployment takes {expected} of it"
        )
    return array.reshape(shape)


def encode_boards(boards: Sequence[BoardResult]) -> msgspec.Raw:
    """Encode the boards' results for `FrameResult.boards`."""
    return msgspec.Raw(_encoder.encode(boards))


def decode_boards(result: FrameResult) -> list[BoardResult]:
    """Return the boards' results, decoded from a record."""
    return _decoder.decode(result.boards)


def result_record(number: int, output: FrameOutput) -> FrameResult:
    """Return the boards' results as a record."""
    return FrameResult(
        number=number,
        boards=encode_boards(output.boards),
        register_writes_ns=output.register_writes_ns,
        compute_ns=output.compute_ns,
        reads_ns=output.reads_ns,
        boards_compute_ns=output.boards_compute_ns,
        link_bytes=output.link_bytes,
        link_transfers=output.link_transfers,
    )


def frame_failed(number: int, error: BoardError) -> FrameFailed:
    """Return a record that reports that frame `number` failed with a board's error."""
    reason = FailureReason.AWAY if isinstance(error, BoardAwayError) else FailureReason.FAILED
    return FrameFailed(number, error.board, exit_code_of(error), str(error), reason)
