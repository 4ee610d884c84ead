"""Replicas and readings for each line: rows of addresses in, posteriors one after the other out."""

from dataclasses import replace

import numpy as np
import pytest

from machines.bm1 import StopReason
from machines.kind import BoardResult
from machines.parameters import PriorMode, SensorMode
from pcie_shim.errors import FrameInputError
from services.boards.frames import encode_boards, machine_inputs
from services.errors import VariableError
from services.pipeline.frames import FrameAssembler
from services.pipeline.inference import infer
from services.sockets.records import FrameResult
from tests.toolchain.running import OPTIONS
from toolchain.building.build import assemble
from toolchain.building.machine import plan_machine
from toolchain.models.model import Known, Model, PriorSelect, dimension


def deployment(*, written=False, **changes):
    """Two lines, one variable of three values, a prior that is selected or written."""
    model = Model(
        name="m",
        searched=(dimension("s", size=2),),
        known=(Known(name="K", table=np.full((3, 2), 1 / 3), on_missing="missing"),),
        prior_select=None
        if written
        else PriorSelect(name="P", table=np.full((2, 2), 0.5), on_missing="missing"),
    )
    return assemble(plan_machine(model, replace(OPTIONS, **changes))).deployment


CELLS = deployment(replicas=3, sensor_mode=SensorMode.CELL)


def test_a_message_becomes_rows():
    message = {"K": [0, 1, 2, 2, None, None], "P": [1, None, 0]}
    (reading,) = FrameAssembler(CELLS).take(0, message, 5, 6)
    assert reading.addresses == [[0, 1, 2, 2, -1, -1], [1, -1, 0]]
    inputs, rows = machine_inputs(CELLS, reading.addresses)
    assert inputs.tolist() == [[[0, 1]], [[2, 2]], [[-1, -1]]]
    assert rows == (1, 3, 0)


def test_a_written_prior_is_for_all_replicas_or_each():
    of = deployment(written=True, replicas=2, prior_mode=PriorMode.WRITTEN, prior_path="belief")
    for belief, codes in (([1, 2], [128, 255, 128, 255]), ([1, 2, 3, 0], [128, 255, 255, 0])):
        (reading,) = FrameAssembler(of).take(0, {"K": [0, 1], "belief": belief}, 5, 6)
        assert np.frombuffer(reading.prior_codes, "<u2").tolist() == codes


WRITTEN = {"written": True, "replicas": 2, "prior_mode": PriorMode.WRITTEN, "prior_path": "belief"}


@pytest.mark.parametrize(
    ("of", "message"),
    [(CELLS, {"K": [0] * 6, "P": [0, 0]}), (deployment(**WRITTEN), {"K": [0, 1], "belief": [1, 2, 3]})],
)
def test_an_array_of_another_length_is_refused(of, message):
    with pytest.raises(VariableError):
        FrameAssembler(of).take(0, message, 5, 6)


@pytest.mark.parametrize(
    ("changes", "addresses", "inputs", "rows"),
    [
        ({}, [1, 0], [1], 0),
        ({}, [None, None], [-1], 3),
        ({"replicas": 2}, [[1, 2], None], [[1], [2]], (3, 3)),
        ({"replicas": 2}, [None, [0, 1]], [[-1], [-1]], (0, 1)),
        ({"sensor_mode": SensorMode.CELL}, [[1, 2], 1], [[1, 2]], 1),
    ],
)
def test_addresses_become_the_drivers_inputs(changes, addresses, inputs, rows):
    found, row = machine_inputs(deployment(**changes), addresses)
    assert (found.tolist(), row) == (inputs, rows)


@pytest.mark.parametrize(
    "addresses",
    [[[0] * 6], [[0] * 5, [0] * 3], [7, [0] * 3], [[0] * 6, [0] * 4], [[0] * 5 + [2**70], [0] * 3]],
)
def test_rows_that_do_not_fit_are_refused(addresses):
    with pytest.raises(FrameInputError):
        machine_inputs(CELLS, addresses)


OVERFLOW, SLICE, IMPOSSIBLE = StopReason.OVERFLOW, StopReason.SLICE, StopReason.IMPOSSIBLE


def result(*boards):
    return FrameResult(7, encode_boards(boards), 1, 2, 3, 4)


def board(counts, cycles, reasons):
    words = np.array(counts, "<u4").tobytes()
    return BoardResult(words, max(cycles), reasons[0], tuple(cycles), tuple(reasons))


def test_posteriors_are_normalised_over_boards_and_by_replica():
    # lines 0 and 1 on one board, line 2 on another; the last replica has no posterior
    counted = result(
        board([[10, 30], [4, 4], [0, 0]], [100, 8, 0], [OVERFLOW, OVERFLOW, IMPOSSIBLE]),
        board([[100], [8], [0]], [1000, 16, 0], [SLICE, SLICE, IMPOSSIBLE]),
    )
    inferred = infer(counted, CELLS)
    assert inferred.posterior == pytest.approx([0.2, 0.6, 0.2, 1 / 3, 1 / 3, 1 / 3, 0, 0, 0])
    assert (inferred.totals, inferred.best) == ([48, 108], 1)
    nothing = infer(result(board([[0], [0]], [0, 0], [IMPOSSIBLE] * 2)), CELLS)
    assert (nothing.posterior, nothing.best, nothing.totals) == (None, -1, [0])


@pytest.mark.parametrize("value", [None, [], [[], []]])
def test_a_needed_array_may_not_be_missing(value):
    needed = tuple(each.model_copy(update={"on_missing": "error"}) for each in CELLS.variables)
    with pytest.raises(VariableError):
        FrameAssembler(CELLS.model_copy(update={"variables": needed})).take(
            0, {"K": value, "P": [0, 1, 0]}, 5, 6
        )
