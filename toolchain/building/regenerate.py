"""Regeneration of one part of a deployment: memories, project, or `deployment.toml` (thesis 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from machines.parameters import SensorMode
from pcie_shim.programming_file import Image
from toolchain.building.agreement import check_agreement, read_images
from toolchain.building.board_layout import board_layout
from toolchain.building.build import assemble
from toolchain.building.edits import DeploymentEdits, edited
from toolchain.building.machine import machine_options
from toolchain.building.options import BuildOptions
from toolchain.building.report import REPORT_NAME, build_report, remark_of, with_remark
from toolchain.deployment import FILE_NAME, Deployment, deployment_text, load_deployment
from toolchain.deployment.deployment_hash import with_hash
from toolchain.errors import BuildError, ModelError
from toolchain.models.model import Model
from toolchain.outputs.output_files import (
    Change,
    image_files,
    memory_files,
    quartus_files,
    text_file,
    write_files,
)

Changes = list[tuple[str, Change]]


def regenerate_memories(directory: Path, model: Model | None = None, *, build_date: str = "") -> Changes:
    """Write `bm1_parameters.vhd` and the memories again, from the images, or with new tables from a model.

    With a model, the images (with this date), the report and the hashes of `deployment.toml` follow, and the columns take
    the model's order; sizes, widths and everything about topics stay as they are.

    Raises:
        BuildError: The model has become another machine, which needs a new build.
        DeploymentError: No deployment, or a damaged one.
    """
    deployment = load_deployment(directory)
    images = read_images(deployment)
    if model is None:
        return write_files(directory, memory_files(deployment, images))
    model = _with_widths(model, deployment)
    built = assemble(model, replace(_options(deployment, images[0]), build_date=build_date))
    new = _with_places(built.deployment, deployment)
    report = build_report(model, new, built.quantised, built.interface_reason)
    parts = [
        image_files(new, built.images),
        memory_files(new, built.images),
        # the machine has the same size, so its number of boards has the same reason
        text_file(REPORT_NAME, with_remark(report, _remark(directory))),
        text_file(FILE_NAME, deployment_text(new)),  # last: a folder that is half new has the old hashes
    ]
    return sorted(change for part in parts for change in write_files(directory, part))


def regenerate_project(directory: Path) -> Changes:
    """Write the Quartus project again."""
    deployment = load_deployment(directory)
    return write_files(directory, quartus_files(deployment, read_images(deployment)))


def regenerate_deployment(directory: Path, edits: DeploymentEdits) -> Changes:
    """Write `deployment.toml` again, with these edits and those that were made by hand; images stay as they are.

    Raises:
        BuildError: An edit has a wrong value, or does not fit the deployment.
        DeploymentError: No deployment, a damaged one, or one that doesn't agree with its images any more.
    """
    deployment = edited(load_deployment(directory, edited=True), edits)
    check_agreement(deployment, read_images(deployment))
    return write_files(directory, text_file(FILE_NAME, deployment_text(deployment)))


def _options(deployment: Deployment, image: Image) -> BuildOptions:
    machine, source = deployment.machine, deployment.sources[0]
    partitions = len(deployment.boards)
    whole = replace(image.machine.parameters, lines=machine.lines)
    without_flag = board_layout(whole, partitions, None)
    interface = (machine.interface_sensors, machine.interface_results)
    return BuildOptions(
        uri=source.uri,
        topic=source.topic,
        type=source.type,
        partitions=partitions,
        interface=None if interface == without_flag.interface else interface,
        scale=machine.scale,
        target_count=machine.target_count,
        max_cycles=machine.max_cycles,
        stop=machine.stop,
        rng_table=image.machine.rng_table,
        **machine_options(machine),
    )


def _with_widths(model: Model, deployment: Deployment) -> Model:
    """Return the model with the deployment's address widths; it must be the same machine otherwise."""
    sizes = [(each.label, each.size) for each in model.searched]
    built_sizes = [(each.label, each.size) for each in deployment.searched]
    kinds = {variable.name: variable.kind for variable in model.variables}
    built_kinds = {variable.name: variable.kind for variable in deployment.variables}
    for what, new, old in (("searches", sizes, built_sizes), ("knows", sorted(kinds), sorted(built_kinds))):
        if new != old:
            raise BuildError(
                f"the model {what} {_listed(new)}, but the deployment {_listed(old)}: this is another machine, so "
                "build it again with 'toolchain build'"
            )
    if kinds != built_kinds:
        raise BuildError("another variable selects the prior now: build it again with 'toolchain build'")
    bits = {variable.name: variable.bits for variable in deployment.variables}
    select = model.prior_select
    if deployment.machine.sensor_mode is SensorMode.THRESHOLD:  # no memory is that wide: there is none
        bits |= {known.name: known.bits for known in model.known}
    try:
        return replace(
            model,
            known=tuple(replace(known, bits=bits[known.name]) for known in model.known),
            prior_select=None if select is None else replace(select, bits=bits[select.name]),
        )
    except ModelError as reason:
        raise BuildError(
            f"{reason}: its memory is that wide; build it again with 'toolchain build'"
        ) from None


def _listed(values: Sequence[object]) -> str:
    return ", ".join(
        f"{value[0]} ({value[1]})" if isinstance(value, tuple) else str(value) for value in values
    )


def _remark(directory: Path) -> str:
    """Return the remark of the existing report about how the options were chosen, or nothing."""
    report = directory / REPORT_NAME
    try:
        return remark_of(report.read_text(encoding="utf-8")) if report.is_file() else ""
    except (OSError, UnicodeDecodeError):
        return ""


def _with_places(new: Deployment, old: Deployment) -> Deployment:
    """Return the new deployment with the servers, topics, paths and endpoints of the old one."""
    before = {variable.name: variable for variable in old.variables}
    deployment = new.replace(
        sources=old.sources,
        outputs=old.outputs,
        queue=old.queue,
        tolerance_s=old.tolerance_s,
        prior=old.prior,
        variables=tuple(
            variable.replace(source=before[variable.name].source, path=before[variable.name].path)
            for variable in new.variables
        ),
        boards=tuple(
            board.replace(endpoint=other.endpoint)
            for board, other in zip(new.boards, old.boards, strict=True)
        ),
        directory=old.directory,
    )
    return with_hash(deployment)
