"""Comparison of `deployment.toml` with its images."""

from collections.abc import Sequence

from pcie_shim.programming_file import Image, Partition, read_image
from toolchain.building.machine import MACHINE_KEYS
from toolchain.deployment import Deployment
from toolchain.errors import DeploymentError


def read_images(deployment: Deployment) -> list[Image]:
    """Return the images of the boards."""
    return [read_image(deployment.image_path(board)) for board in range(len(deployment.boards))]


def check_agreement(deployment: Deployment, images: Sequence[Image]) -> None:
    """Raise a DeploymentError if `deployment.toml` describes another machine than its images."""
    machine = deployment.machine
    for index, (board, image) in enumerate(zip(deployment.boards, images, strict=True)):
        parameters = image.machine.parameters
        found = {key: getattr(parameters, key) for key in MACHINE_KEYS}
        expected = {key: getattr(machine, key) for key in MACHINE_KEYS}
        for variable, bits in zip(deployment.sensors, parameters.sensor_bits, strict=False):
            found[f"bits of {variable.name}"], expected[f"bits of {variable.name}"] = bits, variable.bits
        found |= {
            "number of sensors": parameters.sensors,
            "interface": f"{image.interface_sensors}x{image.interface_results}",
            "lines of the board": parameters.lines,
            "part of the model": image.partition,
        }
        expected |= {
            "number of sensors": len(deployment.sensors),
            "interface": machine.interface,
            "lines of the board": board.lines,
            "part of the model": Partition(index, len(images), board.line_offset, machine.lines),
        }
        for key, value in found.items():
            if value != expected[key]:
                raise DeploymentError(
                    f"{deployment.path} has {key} = {expected[key]}, but {board.image} was built with {value}: set it back, "
                    "or build again with 'toolchain build'"
                )
