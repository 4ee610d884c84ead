"""Imports from the rest of the project, for the verification of the hardware.

Only this module imports machines, their emulation, the emulated board and the toolchain.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from machines.bm1 import BM1Machine, Start, StopReason
from machines.bm1_kind import BM1
from machines.kernel import BM1Kernel
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from machines.reference import ReferenceBM1
from pcie_shim import register_map
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.programming_file import Image, Partition, image_bytes
from pcie_shim.register_layout import field_of, next_doorbell
from pcie_shim.register_map import BoardState, ErrorCode
from toolchain.hardware import HDL, PARAMETERS, SOURCES, HardwareToolError, in_order, run_tool, verilog

if TYPE_CHECKING:
    from pathlib import Path

__all__ = [
    "BM1",
    "HDL",
    "PARAMETERS",
    "SOURCES",
    "BM1Kernel",
    "BM1Machine",
    "BM1Parameters",
    "BoardState",
    "EmulatedBoard",
    "ErrorCode",
    "HardwareToolError",
    "Image",
    "Partition",
    "PriorMode",
    "ReferenceBM1",
    "RefusedError",
    "RngKind",
    "RngReset",
    "SensorMode",
    "Start",
    "StopReason",
    "field_of",
    "image_bytes",
    "image_of",
    "image_of_parameters",
    "in_order",
    "next_doorbell",
    "reference_kernel",
    "register_map",
    "run_tool",
    "verilog",
    "write_hardware_files",
]

_NO_MODEL: Final = "0" * 64


def reference_kernel(machine: BM1Machine) -> BM1Kernel:
    """Return the reference kernel, against which all others are checked."""
    return ReferenceBM1(machine)


def image_of(machine: BM1Machine, more_inputs: int = 0, more_results: int = 0) -> Image:
    """Return a board's image of a machine. The interface has `more_inputs` and `more_results` unused words."""
    used = BM1.registers(machine.parameters)
    inputs, results = used.input_words, used.result_words
    return Image(
        machine=machine,
        partition=Partition(0, 1, 0, machine.parameters.lines),
        interface_sensors=max(inputs, 1) + more_inputs,
        interface_results=results + more_results,
        model_hash=_NO_MODEL,
        build_date="2020-01-01T00:00:00Z",
        tool_version="test",
    )


def image_of_parameters(parameters: BM1Parameters) -> Image:
    """Return a board's image of a machine with tables of all ones, because synthesis leaves tables out."""
    from toolchain.outputs.mif import LENGTH

    prior, *tables = (
        np.full((1 << bits, parameters.lines), parameters.ones_code, np.uint16)
        for bits in (parameters.prior_bits, *(parameters.sensor_bits if parameters.has_tables else ()))
    )
    numbers = np.zeros(LENGTH, np.uint32) if parameters.rng is RngKind.TABLE else None
    return image_of(BM1Machine(parameters, prior, tuple(tables), numbers))


def write_hardware_files(image: Image, folder: Path) -> None:
    """Write the files of an image's hardware, as a build does: the package of parameters and all memories."""
    # imported here, because benches do not need it and dozens of simulations are started
    from toolchain.hardware import write_board_files

    write_board_files(image, folder)
