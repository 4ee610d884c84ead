"""The size of the boards' interface: how many inputs and results its registers have, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from machines.parameters import BM1Parameters, SensorMode
from pcie_shim import register_map
from pcie_shim.programming_file import interface_room, interface_words
from toolchain.errors import BuildError

if TYPE_CHECKING:
    from toolchain.models.model import Model
    from toolchain.partition import Block

DEFAULT_INTERFACE: Final = (20, 1200)
"""Inputs and results of the thesis's PCIe interface (3.2)."""


def board_interface(
    model: Model,
    blocks: tuple[Block, ...],
    given: tuple[int, int] | None,
    *,
    sensor_mode: SensorMode = SensorMode.COLUMN,
    replicas: int = 1,
) -> tuple[tuple[int, int], str]:
    """Return the boards' inputs and results, and a clause that says why where they are not the default.

    Args:
        model: The model.
        blocks: Its lines on each board.
        given: Inputs and results that are asked for; None for as many as are needed, the default at least.
        sensor_mode: Whether cells have inputs of their own.
        replicas: Machines on each board.

    Raises:
        BuildError: The model is larger than the interface, or the interface than the register map.
    """
    if sensor_mode is not SensorMode.COLUMN or replicas > 1:
        return _interface_of_many(model, blocks, given, sensor_mode, replicas)
    sensors, lines = len(model.known), max(block.lines for block in blocks)
    room = (register_map.SENSORS_WORDS, register_map.RESULTS_WORDS)
    if sensors > room[0] or lines > room[1]:
        partitions = -(-model.lines // room[1])
        message = (
            f"the model has {sensors} known variables and {lines} lines on a board, but the register map has room "
            f"for {room[0]} and {room[1]}"
        )
        if lines > room[1]:
            message += f": use --partitions {partitions} or more"
        raise BuildError(message)
    if given is None:
        larger = (max(sensors, DEFAULT_INTERFACE[0]), max(lines, DEFAULT_INTERFACE[1]))
        if larger == DEFAULT_INTERFACE:
            return larger, ""
        return larger, (
            f", larger than the default {DEFAULT_INTERFACE[0]}x{DEFAULT_INTERFACE[1]}: a board needs {sensors} inputs "
            f"and {lines} results"
        )
    if sensors > given[0] or lines > given[1]:
        message = (
            f"the model is larger than the interface {given[0]}x{given[1]}: a board needs {sensors} inputs and "
            f"{lines} results; use --interface {max(sensors, given[0])}x{max(lines, given[1])} or leave it out"
        )
        if lines > given[1]:
            message += f", or --partitions {-(-model.lines // given[1])}"
        raise BuildError(message)
    if given[0] > room[0] or given[1] > room[1]:
        raise BuildError(
            f"the interface {given[0]}x{given[1]} is larger than the register map's {room[0]}x{room[1]}"
        )
    return given, ", as asked for"


def _interface_of_many(
    model: Model,
    blocks: tuple[Block, ...],
    given: tuple[int, int] | None,
    sensor_mode: SensorMode,
    replicas: int,
) -> tuple[tuple[int, int], str]:
    """The interface of boards with replicas, or with inputs for each cell: those all count."""
    lines = max(block.lines for block in blocks)
    # the widths are of no account here, and are what any mode takes
    board = BM1Parameters(
        lines=lines, sensor_bits=(8,) * len(model.known), sensor_mode=sensor_mode, replicas=replicas
    )
    inputs, results = interface_words(board)
    room = interface_room(board)
    made_of = f"{len(model.known)} known variables and {lines} lines on a board" + (
        f", {replicas} times" if replicas > 1 else ""
    )
    needed = f"a board needs {inputs} inputs and {results} results ({made_of})"
    ways = [
        *(["more --partitions"] if lines > 1 else []),
        *(["fewer --replicas"] if replicas > 1 else []),
    ]
    instead = f": use {' or '.join(ways)}" if ways else ""
    if inputs > room[0] or results > room[1]:
        raise BuildError(f"{needed}, but the register map has room for {room[0]} and {room[1]}{instead}")
    if given is None:
        larger = (max(inputs, DEFAULT_INTERFACE[0]), max(results, DEFAULT_INTERFACE[1]))
        default = f"{DEFAULT_INTERFACE[0]}x{DEFAULT_INTERFACE[1]}"
        return larger, "" if larger == DEFAULT_INTERFACE else f", larger than the default {default}: {needed}"
    if given[0] > room[0] or given[1] > room[1]:
        raise BuildError(
            f"the interface {given[0]}x{given[1]} is larger than the register map's {room[0]}x{room[1]}"
        )
    if inputs > given[0] or results > given[1]:
        raise BuildError(
            f"the model is larger than the interface {given[0]}x{given[1]}: {needed}; use --interface "
            f"{max(inputs, given[0])}x{max(results, given[1])} or leave it out"
        )
    return given, ", as asked for"
