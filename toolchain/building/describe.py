"""The deployment that a model, its machine's images and the options make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pydantic import ValidationError

from machines.parameters import BM1Parameters, SensorMode
from toolchain.building.machine import MACHINE_KEYS
from toolchain.building.options import BuildOptions, refused_option
from toolchain.deployment import Board, Deployment, MachineSection, Output, Variable
from toolchain.deployment.deployment_hash import with_hash

if TYPE_CHECKING:
    from pcie_shim.programming_file import Image
    from toolchain.building.board_layout import BoardLayout
    from toolchain.models.model import Model


def describe(
    model: Model,
    parameters: BM1Parameters,
    layout: BoardLayout,
    images: Sequence[Image],
    options: BuildOptions,
) -> Deployment:
    """Return the deployment of these images, with its hash; a BuildError if an option does not fit the machine."""
    target = parameters.target_count_max if options.target_count is None else options.target_count
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
                target_count=target,
                max_cycles=options.max_cycles,
                stop=options.stop,
                **{key: getattr(parameters, key) for key in MACHINE_KEYS},
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
    """Return the known variables; where cells are given codes, a sensor's values are the codes."""
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
