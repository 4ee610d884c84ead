"""The generated files of one board's hardware, from its image: the package of parameters, and the memories."""

from pathlib import Path
from typing import Final

from pcie_shim.programming_file import Image
from toolchain.building.machine import MACHINE_KEYS
from toolchain.deployment import BoardSection, Deployment, Dimension, MachineSection, Source, Variable
from toolchain.hardware.sources import PARAMETERS
from toolchain.outputs.memories import Memory, memories
from toolchain.outputs.vhdl_parameters import parameters_vhd

MEMORY_FOLDER: Final = "Memory_MIFs"


def write_board_files(image: Image, folder: Path) -> None:
    """Write the files of an image's hardware, as a build does; its generic BOARD is the partition's index."""
    images = [image] * image.partition.count  # a board uses its own entry only
    (folder / PARAMETERS).write_text(parameters_vhd(_deployment(image), images), "ascii")
    (folder / MEMORY_FOLDER).mkdir(exist_ok=True)
    for memory in board_memories(image):
        (folder / MEMORY_FOLDER / memory.name).write_text("".join(memory.lines()), "ascii")


def board_memories(image: Image) -> list[Memory]:
    """Return the memories of one board."""
    part = image.partition
    return [
        memory
        for memory in memories(_deployment(image), [image] * part.count)
        if not memory.name.startswith("board") or memory.name.startswith(f"board{part.index}_")
    ]


def _deployment(image: Image) -> Deployment:
    """Return a deployment of this image's model; an image has no names, only their numbers."""
    parameters = image.machine.parameters
    widths = [*parameters.sensor_bits, *([parameters.prior_bits] if parameters.prior_bits else [])]
    total = image.partition.total_lines
    return Deployment(
        name=f"of image {image.image_hash[:12]}",
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
        searched=(Dimension(label="line", size=total),),
        machine=MachineSection(
            lines=total,
            interface=f"{image.interface_sensors}x{image.interface_results}",
            target_count=min(255, parameters.target_count_max),
            **{key: getattr(parameters, key) for key in MACHINE_KEYS},
        ),
        boards=(
            BoardSection(image="boards/board0.bm", image_hash=image.image_hash, line_offset=0, lines=total),
        ),
    )
