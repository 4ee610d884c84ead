"""Resources: exact counts where possible, and the figures of the thesis."""

import math
from collections import Counter
from dataclasses import replace

import pytest

from hdl.test.project import image_of_parameters
from machines.parameters import REPLICAS_MAX, BM1Parameters, PriorMode, RngKind, SensorMode
from toolchain.analysis.logic import (
    DEVICES,
    WORD_BITS,
    device_named,
    logic_of,
    random_memories_of,
    tables_of,
    word_memories_of,
)
from toolchain.analysis.resources import boards_needed, estimate, most_replicas
from toolchain.errors import BuildError
from toolchain.hardware import board_memories
from toolchain.outputs.memories import generators
from toolchain.outputs.mif import LENGTH

D8 = DEVICES["proce-v-d8"]
BOAT = BM1Parameters(lines=1024, sensor_bits=(7, 7, 7, 9, 9, 9))


def on_d8(parameters, **others):
    return estimate(parameters, D8, **others)


def test_tables_in_bits_and_blocks():
    quarter = replace(BOAT, lines=256)
    assert on_d8(quarter).memories.table_bits == 256 * 3 * 8 * (128 + 512)
    seeds_and_inputs = 2
    # 256 codes of 8 bits side by side, 5 in each block of 512 words of 40 bits
    assert on_d8(quarter).memories.blocks == 6 * 52 + seeds_and_inputs
    deep = BM1Parameters(lines=1, sensor_bits=(12,))
    assert on_d8(deep).memories.blocks == 2 + seeds_and_inputs  # 4096 words of 8 bits: two blocks of 4096 x 5
    assert on_d8(replace(deep, prior_bits=9)).memories.blocks == 3 + seeds_and_inputs
    cells = on_d8(replace(BOAT, sensor_mode=SensorMode.CELL)).memories
    # a block a cell: 512 words of 8 bits, or fewer; 14 blocks hold 8192 input words, of which 6144 are used
    assert cells.blocks == int(0.8 * 2567)
    assert cells.logic_tables == 6 * 1024 - (cells.blocks - 14 - 1)
    assert cells.table_bits == on_d8(BOAT).memories.table_bits


MACHINES = {
    "columns": {},
    "prior select": {"prior_bits": 3},
    "cells": {"sensor_mode": SensorMode.CELL, "prior_bits": 2},
    "thresholds": {"sensor_mode": SensorMode.THRESHOLD, "sensor_bits": (8, 8)},
    "replicas": {"replicas": 3, "prior_bits": 1},
    "replicas of cells": {"replicas": 3, "sensor_mode": SensorMode.CELL},
    "written prior": {"prior_mode": PriorMode.WRITTEN, "lines": 600},
    "table": {"rng": RngKind.TABLE, "steps_per_clock": 1},
    "generator per cell": {"shared": False, "rng": RngKind.LFSR16},
}


@pytest.mark.parametrize("name", MACHINES)
def test_the_memories_are_those_of_the_mifs(name):
    parameters = BM1Parameters(**{"lines": 6, "sensor_bits": (4, 9)} | MACHINES[name])
    found = Counter()
    for memory in board_memories(image_of_parameters(parameters)):
        kind, count, width = memory.name.removeprefix("board0_"), 1, memory.width
        if kind.startswith("column") and parameters.sensor_mode is SensorMode.CELL:
            # the file has the column's words; each cell has its own bits of them
            count, width = parameters.replicas * parameters.lines, width // parameters.lines
        elif kind.startswith("column") or (kind == "prior.mif" and parameters.prior_mode is PriorMode.TABLE):
            count = parameters.replicas if memory.depth > 1 else 0
        elif kind == "rng_table.mif":
            count = generators(parameters)
        found[memory.depth, width] += count
    # the words that the host writes have no file
    files = [each for each in word_memories_of(parameters) if each.width != WORD_BITS]
    files += tables_of(parameters) + random_memories_of(parameters, LENGTH)
    assert +found == sum((Counter({(each.words, each.width): each.count}) for each in files), Counter())


def test_the_inputs_of_a_larger_interface_take_memory():
    blocks = [on_d8(replace(BOAT, lines=8), inputs=inputs).memories.blocks for inputs in (0, 6, 20, 600)]
    assert [each - blocks[0] for each in blocks] == [0, 0, 0, 1]
    assert logic_of(BOAT, inputs=20).registers - logic_of(BOAT).registers == 2 * (5 - 3) - WORD_BITS


def test_a_table_of_random_numbers_is_as_long_as_the_users():
    played = replace(replace(BOAT, lines=8), rng=RngKind.TABLE, steps_per_clock=1)
    made, own = on_d8(played), on_d8(played, table_length=500)
    # 7 generators, each with a copy: of 65,536 words of 8 bits, or of 500
    assert made.memories.blocks - own.memories.blocks == 7 * (32 - 1)
    assert made.logic.registers - own.logic.registers == 7 * (16 - 9)


def test_registers_are_counted_exactly():
    # Yosys's results for these (scripts/verify resources has more).
    cell, threshold = SensorMode.CELL, SensorMode.THRESHOLD
    for lines, sensors, registers, others in (
        (8, 3, 1309, {}),
        (32, 3, 1501, {}),
        (8, 3, 1388, {"sensor_mode": cell}),
        (8, 3, 1676, {"sensor_mode": threshold, "sensor_bits": (8, 8, 8)}),
        (4, 2, 1484, {"replicas": 2}),
        (1, 1, 3833, {"replicas": 32}),
        (16, 2, 1619, {"prior_mode": PriorMode.WRITTEN}),
        (8, 3, 1699, {"shared": False, "rng": RngKind.LFSR16}),
        (6, 2, 1451, {"shared": False, "rng": RngKind.TABLE}),
    ):
        parameters = BM1Parameters(**{"lines": lines, "sensor_bits": (4,) * sensors} | others)
        assert logic_of(parameters).registers == registers


@pytest.mark.parametrize(
    "more",
    [
        {"lines": 2048},
        {"shared": False},
        {"rng": RngKind.TABLE, "steps_per_clock": 1},
        {"prior_mode": PriorMode.WRITTEN},
        {"replicas": 2},
        {"sensor_mode": SensorMode.CELL},
    ],
)
def test_more_of_anything_takes_more(more):
    base, larger = on_d8(BOAT), on_d8(replace(BOAT, **more))
    sizes = [(each.alms, each.memories.blocks, each.logic.registers) for each in (base, larger)]
    assert sizes[0] != sizes[1]
    if "rng" not in more:
        assert larger.logic.aluts >= base.logic.aluts
        assert larger.logic.registers >= base.logic.registers


def test_boards_for_the_boat():
    count, why = boards_needed(BOAT, D8)
    assert count == 1
    assert why.startswith("All 1024 lines fit one Gidel Proce V D8")
    # with an address for each cell, the tables of a column do not share a memory
    cells = replace(BOAT, sensor_mode=SensorMode.CELL)
    count, why = boards_needed(cells, D8)
    assert 2 <= count <= 4
    assert why.startswith("1024 lines need two boards. One Gidel Proce V D8")
    assert "209,920 of 262,400 can be used" in why
    assert boards_needed(replace(cells, lines=256), D8)[0] == 1
    for boards in range(1, count):
        assert not on_d8(replace(cells, lines=-(-1024 // boards))).fits
    assert on_d8(replace(cells, lines=-(-1024 // count))).fits


def test_boards_for_more_lines_than_the_register_map_holds():
    many = BM1Parameters(lines=10_000, sensor_bits=(2,))
    count, why = boards_needed(many, D8)
    assert count == 3
    assert "10,000 result registers, but the map has only 4,096" in why


def test_boards_for_more_lines_than_the_interface_holds():
    count, why = boards_needed(BOAT, D8, interface=(20, 300))
    assert count == 4
    assert "1,024 result registers, but the interface has only 300" in why
    with pytest.raises(BuildError, match="use --replicas 2 or fewer"):
        boards_needed(replace(BOAT, lines=8, replicas=3), D8, interface=(20, 2))


@pytest.mark.parametrize(
    ("board", "limit"),
    [
        (replace(BOAT, lines=256), "ALMs"),
        (BM1Parameters(lines=300, sensor_bits=(2,)), "4,200 result registers, but the map has only 4,096"),
        (
            BM1Parameters(
                lines=10, sensor_bits=(3, 3, 3, 3), sensor_mode=SensorMode.CELL, rng=RngKind.LFSR16
            ),
            "",
        ),
        (BM1Parameters(lines=40, sensor_bits=(3,) * 10, sensor_mode=SensorMode.CELL), "input registers"),
    ],
    ids=["logic", "results", "most", "inputs"],
)
def test_as_many_machines_as_fit_a_board(board, limit):
    most, why = most_replicas(board, D8)
    assert limit in why
    room = [
        replicas
        for replicas in range(1, REPLICAS_MAX + 1)
        if replicas * board.lines <= 4096
        and replicas * math.prod(board.input_shape) <= 8192
        and on_d8(replace(board, replicas=replicas)).fits
    ]
    assert room == list(range(1, most + 1))


def test_replicas_that_divide_the_lines_are_told_how_many_would_not():
    whole, _ = most_replicas(BOAT, D8)
    assert boards_needed(replace(BOAT, replicas=whole), D8)[0] == 1
    count, why = boards_needed(replace(BOAT, replicas=whole + 1), D8)
    assert count > 1
    assert f"--replicas {whole} or fewer" in why


def test_what_has_no_estimate():
    with pytest.raises(BuildError):
        boards_needed(replace(BOAT, rng=RngKind.IDEAL), D8)
    with pytest.raises(BuildError):
        boards_needed(BM1Parameters(lines=4, sensor_bits=(16,) * 60, prob_bits=16), D8)
    with pytest.raises(BuildError, match="--device d9.*proce-v-d8"):
        device_named("d9")
