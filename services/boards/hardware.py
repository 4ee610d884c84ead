"""Boards whose hardware is simulated, for `board --engine`."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

from pcie_shim.errors import SimulationError
from services.errors import SettingsError
from terminal.output import say, warn

# emulated boards would wait for these imports
if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pcie_shim.board.rtl_board import RtlBoard
    from pcie_shim.board.simulation import Simulation
    from pcie_shim.programming_file import Image
    from toolchain.hardware import Compiled


class Engine(StrEnum):
    """The implementation of a board's machine: an emulation, or a simulator of the hardware."""

    EMULATED = "emulated"
    RTL = "rtl"
    GHDL = "ghdl"
    VERILATOR = "verilator"


class SimulatedHardware:
    """The simulator that `board --engine` selects, and the boards simulated with it."""

    def __init__(self, engine: Engine, folder: Path, images: Mapping[int, Image]) -> None:
        """Choose the simulator, and compile the images into `folder`. The keys of `images` are the numbers of boards.

        Raises:
            SettingsError: The simulator is not installed, or the VHDL is missing.
            SimulationError: An image cannot be compiled.
        """
        from toolchain.hardware import HardwareToolError, Simulator, check_tools, missing

        self._images = images
        self._folder = folder

        # `rtl` is Verilator if it is installed, and GHDL also if Verilator cannot compile an image.
        self._is_any = engine is Engine.RTL
        if self._is_any:
            self._simulator = Simulator.GHDL if missing(Simulator.VERILATOR.tools) else Simulator.VERILATOR
        else:
            self._simulator = Simulator(engine.value)
        try:
            check_tools(self._simulator)
        except HardwareToolError as error:
            raise SettingsError(f"--engine {engine}: {error}") from None
        # now, because a loader would not wait for it
        for image in images.values():
            self._compiled(image)

    def board(self, index: int) -> RtlBoard:
        """Return a blank board, or raise a SimulationError.

        If the image that the board will get is known, a simulation of the image's hardware is started now. The board
        stays blank until the image is loaded, and then uses this simulation.
        """
        from pcie_shim.board.rtl_board import RtlBoard

        board = RtlBoard(self._simulate)
        if (image := self._images.get(index)) is not None:
            board.prepare(image)
        return board

    def _simulate(self, image: Image) -> Simulation:
        from pcie_shim.board.simulation import Simulation

        found = self._compiled(image)
        return Simulation(found.command, found.folder)

    def _compiled(self, image: Image) -> Compiled:
        from toolchain.hardware import HardwareToolError, Simulator, compiled

        if not image.kind.has_hardware:
            raise SimulationError(
                f"A {image.kind.name} exists only in emulation, not as hardware: use emulated boards (--engine emulated)"
            )
        try:
            return compiled(image, self._simulator, self._folder, say)
        except HardwareToolError as error:
            if not self._is_any or self._simulator is Simulator.GHDL:
                raise SimulationError(str(error)) from error
            warn(f"Verilator cannot compile this hardware, GHDL runs it: {error}")
            self._simulator = Simulator.GHDL
            return self._compiled(image)
