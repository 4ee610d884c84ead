"""The images of a model's boards: what each board is programmed with."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING

from machines.bm1 import BM1Machine
from machines.parameters import SensorMode
from pcie_shim.programming_file import Image, Partition, tool_version
from toolchain.building.partition import split

if TYPE_CHECKING:
    from toolchain.building.board_layout import BoardLayout
    from toolchain.models.model import Model


def model_hash(model: Model, machine: BM1Machine) -> str:
    """Return the SHA-256 (hexadecimal) of the machine that all boards are parts of, and of its names.

    It covers codes, not probabilities: these differ in their last bit from one mathematics library to another.
    """
    parameters = machine.parameters
    words = {
        "name": model.name,
        "searched": [dimension.model_dump(mode="json") for dimension in model.searched],
        "known": [variable.model_dump(mode="json") for variable in model.variables],
        "prob_bits": parameters.prob_bits,
    }
    if parameters.sensor_mode is not SensorMode.COLUMN or parameters.replicas > 1:
        words |= {"sensor_mode": parameters.sensor_mode.value, "replicas": parameters.replicas}
    digest = hashlib.sha256(json.dumps(words, sort_keys=True, separators=(",", ":")).encode())
    for codes in (machine.prior, *machine.tables):
        digest.update(codes.astype("<u2", copy=False).tobytes())
    return digest.hexdigest()


def board_images(
    model: Model, machine: BM1Machine, layout: BoardLayout, build_date: str
) -> tuple[Image, ...]:
    """Return one image per board of the whole model's machine."""
    identity, count = model_hash(model, machine), len(layout.blocks)
    return tuple(
        Image(
            machine=part,
            partition=Partition(board, count, block.offset, model.lines),
            interface_sensors=layout.interface[0],
            interface_results=layout.interface[1],
            model_hash=identity,
            build_date=build_date,
            tool_version=tool_version(),
        )
        for board, (part, block) in enumerate(zip(split(machine, count), layout.blocks, strict=True))
    )
