"""Imports of the hardware's verification from the rest of the project.

Machines, their emulation, the emulated board and the files of a build are imported only here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from machines.bm1 import BM1Machine, Start, StopReason
from machines.kernel import BM1Kernel
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from machines.reference import ReferenceBM1
from pcie_shim import register_map
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.programming_file import Image, Partition, image_bytes, interface_words
from pcie_shim.register_layout import next_doorbell
from pcie_shim.register_map import BoardState, ErrorCode

if TYPE_CHECKING:
    from pathlib import Path

    from toolchain.deployment import Deployment

__all__ = [
    "BM1Kernel",
    "BM1Machine",
    "BM1Parameters",
    "BoardState",
    "EmulatedBoard",
    "ErrorCode",
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
    "image_bytes",
    "image_of",
    "image_of_parameters",
    "interface_words",
    "next_doorbell",
    "reference_kernel",
    "register_map",
    "write_hardware_files",
]

PARAMETERS_FILE: Final = "bm1_parameters.vhd"
MEMORY_FOLDER: Final = "Memory_MIFs"

_NO_MODEL: Final = "0" * 64


def reference_kernel(machine: BM1Machine) -> BM1Kernel:
    """Return the reference kernel, against which all others are checked."""
    return ReferenceBM1(machine)


def image_of(machine: BM1Machine, more_inputs: int = 0, more_results: int = 0) -> Image:
    """Return a board's image of a machine, whose interface has some words more than the machine needs."""
    inputs, results = interface_words(machine.parameters)
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
    """Return a board's image of a machine whose tables are all ones, because synthesis leaves them out."""
    from toolchain.outputs.rng_table import LENGTH

    prior, *tables = (
        np.full((1 << bits, parameters.lines), parameters.ones_code, np.uint16)
        for bits in (parameters.prior_bits, *(parameters.sensor_bits if parameters.has_tables else ()))
    )
    numbers = np.zeros(LENGTH, np.uint32) if parameters.rng is RngKind.TABLE else None
    return image_of(BM1Machine(parameters, prior, tuple(tables), numbers))


def write_hardware_files(image: Image, folder: Path) -> None:
    """Write the files of an image's hardware, as a build does: the package of parameters and all memories."""
    # imported here, because benches do not need the toolchain and dozens of simulations are started
    from toolchain.outputs.memories import memories
    from toolchain.outputs.vhdl_parameters import parameters_vhd

    deployment = _deployment(image)
    (folder / PARAMETERS_FILE).write_text(parameters_vhd(deployment, [image]), "ascii")
    (folder / MEMORY_FOLDER).mkdir(exist_ok=True)
    for memory in memories(deployment, [image]):
        (folder / MEMORY_FOLDER / memory.name).write_text("".join(memory.lines()), "ascii")


def _deployment(image: Image) -> Deployment:
    """Return a deployment with one board, which has this image."""
    from toolchain.deployment import Board, Deployment, Dimension, MachineSection, Source, Variable

    parameters = image.machine.parameters
    widths = [*parameters.sensor_bits, *([parameters.prior_bits] if parameters.prior_bits else [])]
    return Deployment(
        name="random machine",
        sources=(Source(uri="ws://localhost:9090", topic="/readings", type="std_msgs/Float64MultiArray"),),
        variables=tuple(
            Variable(
                name=f"variable {at}",
                path=f"data[{at}]",
                kind="sensor" if at < parameters.sensors else "prior_select",
                bits=bits,
                values=2**bits - 1,
            )
            for at, bits in enumerate(widths)
        ),
        searched=(Dimension(label="line", size=parameters.lines),),
        machine=MachineSection(
            lines=parameters.lines,
            interface=f"{image.interface_sensors}x{image.interface_results}",
            prob_bits=parameters.prob_bits,
            prior_bits=parameters.prior_bits,
            prior_mode=parameters.prior_mode,
            counter_bits=parameters.counter_bits,
            rng=parameters.rng,
            rng_banks=parameters.rng_banks,
            rng_reset=parameters.rng_reset,
            shared=parameters.shared,
            steps_per_clock=parameters.steps_per_clock,
            target_count=min(255, parameters.target_count_max),
            sensor_mode=parameters.sensor_mode,
            replicas=parameters.replicas,
        ),
        boards=(
            Board(
                image="boards/board0.bm", image_hash=image.image_hash, line_offset=0, lines=parameters.lines
            ),
        ),
    )
