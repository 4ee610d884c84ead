"""The layout of the boards: the lines of each one, and the numbers of inputs and results in its registers."""

from dataclasses import dataclass, replace
from typing import Final

from machines.parameters import BM1Parameters, RngKind, SensorMode
from pcie_shim.programming_file import interface_room, interface_words
from toolchain.building.partition import Block, partition_lines
from toolchain.errors import BuildError
from toolchain.outputs.memories import generators

DEFAULT_INTERFACE: Final = (20, 1200)
"""Inputs and results of the thesis's PCIe interface (3.2)."""

_MOST_SEEDS: Final = 1 << 23
"""Maximum number of seeds on a board, because more would need gigabytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardLayout:
    """The lines of each board, and the common interface."""

    blocks: tuple[Block, ...]
    """Blocks of lines by board; the first one is one of the largest."""
    interface: tuple[int, int]
    """Inputs and results of the boards' registers."""
    reason: str
    """The reason for an interface that is not the default, as a clause; otherwise empty."""

    @property
    def interface_text(self) -> str:
        """The interface as in `deployment.toml`."""
        return _text(self.interface)


def board_layout(
    parameters: BM1Parameters, partitions: int, interface: tuple[int, int] | None
) -> BoardLayout:
    """Return the layout of a machine's boards, before any table is computed.

    Without an `interface`, it has as many inputs and results as needed, but at least the default numbers.

    Raises:
        BuildError: There are more boards than lines, the machine is larger than the interface, the interface is
            larger than the register map, or there are too many seeds.
    """
    blocks = partition_lines(parameters.lines, partitions)
    board = replace(parameters, lines=blocks[0].lines)
    _check_seeds(board)
    needed, room = interface_words(board), interface_room(board)
    sentence = (
        f"a board needs {needed[0]} inputs and {needed[1]} results ({board.sensors} known variables and {board.lines} lines on it"
        + (f", {board.replicas} times)" if board.replicas > 1 else ")")
    )
    if not _fits(needed, room):
        raise BuildError(
            f"{sentence}, but the register map has room for {room[0]} and {room[1]}{_advice(parameters, room)}"
        )
    if interface is None:
        default = DEFAULT_INTERFACE
        interface = (max(needed[0], default[0]), max(needed[1], default[1]))
        reason = "" if interface == default else f", larger than the default {_text(default)}: {sentence}"
        return BoardLayout(blocks=blocks, interface=interface, reason=reason)
    if not _fits(interface, room):
        raise BuildError(f"the interface {_text(interface)} is larger than the register map's {_text(room)}")
    if not _fits(needed, interface):
        enough = (max(needed[0], interface[0]), max(needed[1], interface[1]))
        raise BuildError(
            f"the model is larger than the interface {_text(interface)}: {sentence}; use --interface {_text(enough)} or leave it out"
        )
    return BoardLayout(blocks=blocks, interface=interface, reason=", as asked for")


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _fits(needed: tuple[int, int], room: tuple[int, int]) -> bool:
    return needed[0] <= room[0] and needed[1] <= room[1]


def _advice(parameters: BM1Parameters, room: tuple[int, int]) -> str:
    """Return advice on fitting the register map, after a colon; empty if there is none."""
    lines = room[1] // parameters.replicas
    if parameters.sensor_mode is not SensorMode.COLUMN and parameters.sensors:
        lines = min(lines, room[0] // (parameters.replicas * parameters.sensors))
    elif parameters.sensors * parameters.replicas > room[0]:
        lines = 0
    ways = [f"--partitions {-(-parameters.lines // lines)} or more"] if lines else []
    ways += ["fewer --replicas"] if parameters.replicas > 1 else []
    return f": use {', or '.join(ways)}" if ways else ""


def _check_seeds(board: BM1Parameters) -> None:
    seeds = board.rng_banks * generators(board)
    if seeds > _MOST_SEEDS and board.rng is not RngKind.IDEAL:
        raise BuildError(
            f"--rng-banks {board.rng_banks} needs {seeds} seeds per board; use at most {_MOST_SEEDS // generators(board)}"
            + ("" if board.shared else ", or --shared")
        )
