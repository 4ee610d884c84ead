"""The images of the boards of a model, and the deployment that describes them."""

import hashlib
import json
from collections.abc import Sequence

from pydantic import ValidationError

from machines.bm1 import BM1Machine
from machines.parameters import SensorMode
from pcie_shim.programming_file import Image, Partition, tool_version
from toolchain.building.board_layout import BoardLayout
from toolchain.building.machine import MACHINE_KEYS, MachinePlan
from toolchain.building.options import BuildOptions, refused_option
from toolchain.building.partition import split
from toolchain.deployment import Board, Deployment, MachineSection, Output, Variable
from toolchain.deployment.deployment_hash import with_hash
from toolchain.models.model import Model


def model_hash(model: Model, machine: BM1Machine) -> str:
    """Return the SHA-256 (hexadecimal) of the whole machine and its names.

    It covers codes, not probabilities, whose last bits depend on the mathematics library.
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


def board_images(plan: MachinePlan, machine: BM1Machine, layout: BoardLayout) -> tuple[Image, ...]:
    """Return one image per board of the whole machine."""
    identity, count = model_hash(plan.model, machine), len(layout.blocks)
    return tuple(
        Image(
            machine=part,
            partition=Partition(board, count, block.offset, plan.model.lines),
            interface_sensors=layout.interface[0],
            interface_results=layout.interface[1],
            model_hash=identity,
            build_date=plan.options.build_date,
            tool_version=tool_version(),
        )
        for board, (part, block) in enumerate(zip(split(machine, count), layout.blocks, strict=True))
    )


def describe(plan: MachinePlan, layout: BoardLayout, images: Sequence[Image]) -> Deployment:
    """Return the deployment of these images, with its hash; a BuildError if an option does not fit the machine."""
    model, options = plan.model, plan.options
    try:
        deployment = Deployment(
            name=model.name,
            queue=options.queue,
            tolerance_s=options.tolerance_s,
            sources=options.all_sources,
            variables=_variables(model, options),
            searched=model.searched,
            machine=MachineSection(
                lines=model.lines,
                interface=layout.interface_text,
                scale=options.scaling,
                target_count=plan.target_count,
                max_cycles=options.max_cycles,
                stop=options.stop,
                **{key: getattr(plan.parameters, key) for key in MACHINE_KEYS},
            ),
            prior=options.written_prior,
            boards=tuple(
                Board(
                    image=f"boards/board{index}.bm",
                    image_hash=image.image_hash,
                    line_offset=block.offset,
                    lines=block.lines,
                )
                for index, (image, block) in enumerate(zip(images, layout.blocks, strict=True))
            ),
            outputs=(Output(topic=options.output),),
        )
    except ValidationError as reason:
        raise refused_option(reason) from None
    return with_hash(deployment)


def _variables(model: Model, options: BuildOptions) -> tuple[Variable, ...]:
    """Return the known variables; with `threshold`, the values of a sensor are the codes."""
    variables = model.variables if options.sources is None else options.sources.place(model.variables)
    if options.sensor_mode is not SensorMode.THRESHOLD:
        return tuple(variables)
    return tuple(
        Variable(
            name=variable.name,
            source=variable.source,
            path=variable.path,
            bits=options.prob_bits,
            values=2**options.prob_bits - 1,
            on_missing=variable.on_missing,
        )
        if variable.kind == "sensor"
        else variable
        for variable in variables
    )
