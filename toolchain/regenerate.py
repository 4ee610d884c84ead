"""Redoes one part of a deployment and leaves the rest as it is: memories, project, or deployment.toml (thesis 3.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from pydantic import ValidationError

from machines.parameters import SensorMode
from pcie_shim.programming_file import Image, Partition, read_image
from toolchain.board_interface import board_interface
from toolchain.build import assemble, refused_option
from toolchain.deployment import (
    FILE_NAME,
    Deployment,
    deployment_hash,
    deployment_text,
    load_deployment,
)
from toolchain.errors import BuildError, DeploymentError, ModelError
from toolchain.options import BuildOptions, Scale
from toolchain.outputs.output_files import (
    Change,
    image_files,
    memory_files,
    quartus_files,
    text_file,
    write_files,
)
from toolchain.partition import partition_lines
from toolchain.report import REPORT_NAME, build_report, remark_of, with_remark

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from toolchain.deployment import Queue, Stop, Variable
    from toolchain.models.model import Model

Changes = list[tuple[str, Change]]

_MACHINE_KEYS: Final = (
    "prob_bits",
    "prior_bits",
    "prior_mode",
    "counter_bits",
    "rng",
    "rng_banks",
    "rng_reset",
    "shared",
    "steps_per_clock",
    "sensor_mode",
    "replicas",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeploymentEdits:
    """What to change in `deployment.toml`; None leaves it as it is."""

    uri: str | None = None
    """The rosbridge server with the readings."""
    topic: str | None = None
    """The topic with the readings."""
    type: str | None = None
    """That topic's type."""
    output: str | None = None
    """The topic for the posteriors."""
    order: tuple[str, ...] | None = None
    """All sensors' names in the order in which the columns are to read them."""
    paths: tuple[tuple[str, str], ...] = ()
    """By name, where in the message a variable is."""
    target_count: int | None = None
    """The count that stops a machine."""
    max_cycles: int | None = None
    """The cycles after which it stops anyway."""
    stop: Stop | None = None
    """Whether boards stop together."""
    queue: Queue | None = None
    """What happens to frames that come too fast."""
    tolerance_s: float | None = None
    """Within what time readings from several topics belong together, seconds."""


def regenerate_memories(directory: Path, model: Model | None = None, *, build_date: str = "") -> Changes:
    """Write `bm1_parameters.vhd` and the memories again, from the images, or with new tables from a model.

    With a model, images, report and `deployment.toml`'s hashes follow, and the columns come in the model's order;
    sizes, widths and everything about topics stays as it is.

    Args:
        directory: The deployment's folder.
        model: The model, changed since; None for the tables that the images hold.
        build_date: What the images' manifests say, with a model.

    Raises:
        BuildError: The model has become another machine: it is to be built again.
        DeploymentError: No deployment, or one that is damaged.
    """
    deployment = load_deployment(directory)
    images = read_images(deployment)
    if model is None:
        return write_files(directory, memory_files(deployment, images))
    model = _with_widths(model, deployment)
    built = assemble(model, replace(_options(deployment, images[0]), build_date=build_date))
    new = _with_targets(built.deployment, deployment)
    report = build_report(model, new, built.quantised, _interface_reason(model, new))
    parts = [
        image_files(new, built.images),
        memory_files(new, built.images),
        # the machine's size is the same, and so is why it has so many boards
        text_file(REPORT_NAME, with_remark(report, _remark(directory))),
        text_file(FILE_NAME, deployment_text(new)),  # last: a folder that is half new has the old hashes
    ]
    return sorted(change for part in parts for change in write_files(directory, part))


def regenerate_project(directory: Path) -> Changes:
    """Write the Quartus project again.

    Raises:
        DeploymentError: No deployment, or one that is damaged.
    """
    deployment = load_deployment(directory)
    return write_files(directory, quartus_files(deployment, read_images(deployment)))


def regenerate_deployment(directory: Path, edits: DeploymentEdits) -> Changes:
    """Write `deployment.toml` again, with edits, those that were made by hand included; images stay as they are.

    Raises:
        BuildError: An edit that can't be.
        DeploymentError: No deployment, a damaged one, or one that doesn't agree with its images any more.
    """
    deployment = load_deployment(directory, edited=True)
    try:
        edited = _edited(deployment, edits)
    except ValidationError as reason:
        raise refused_option(reason) from None
    check_agreement(edited, read_images(edited))
    return write_files(directory, text_file(FILE_NAME, deployment_text(edited)))


def read_images(deployment: Deployment) -> list[Image]:
    """Return the boards' images."""
    return [read_image(deployment.image_path(board)) for board in range(len(deployment.boards))]


def check_agreement(deployment: Deployment, images: Sequence[Image]) -> None:
    """Refuse a `deployment.toml` that says something else of the machine than its images.

    Raises:
        DeploymentError: Names the key, and what the image says.
    """
    machine = deployment.machine
    for index, (board, image) in enumerate(zip(deployment.boards, images, strict=True)):
        parameters = image.machine.parameters
        found = {key: getattr(parameters, key) for key in _MACHINE_KEYS}
        said = {key: getattr(machine, key) for key in _MACHINE_KEYS}
        for variable, bits in zip(deployment.sensors, parameters.sensor_bits, strict=False):
            found[f"bits of {variable.name}"], said[f"bits of {variable.name}"] = bits, variable.bits
        found |= {
            "number of sensors": parameters.sensors,
            "interface": f"{image.interface_sensors}x{image.interface_results}",
            "lines of the board": parameters.lines,
            "part of the model": image.partition,
        }
        said |= {
            "number of sensors": len(deployment.sensors),
            "interface": machine.interface,
            "lines of the board": board.lines,
            "part of the model": Partition(index, len(images), board.line_offset, machine.lines),
        }
        for key, value in found.items():
            if value != said[key]:
                raise DeploymentError(
                    f"{deployment.path} says {key} = {said[key]}, but {board.image} was built with {value}: set it back, "
                    "or build again with 'toolchain build'"
                )


def _options(deployment: Deployment, image: Image) -> BuildOptions:
    """Return the options that a deployment was built with."""
    machine, source = deployment.machine, deployment.sources[0]
    return BuildOptions(
        uri=source.uri,
        topic=source.topic,
        type=source.type,
        partitions=len(deployment.boards),
        interface=(machine.interface_sensors, machine.interface_results),
        scale=Scale(machine.scale),
        prob_bits=machine.prob_bits,
        prior_mode=machine.prior_mode,
        counter_bits=machine.counter_bits,
        target_count=machine.target_count,
        max_cycles=machine.max_cycles,
        stop=machine.stop,
        rng=machine.rng,
        rng_table=image.machine.rng_table,
        rng_banks=machine.rng_banks,
        rng_reset=machine.rng_reset,
        shared=machine.shared,
        steps_per_clock=machine.steps_per_clock,
        sensor_mode=machine.sensor_mode,
        replicas=machine.replicas,
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


def _interface_reason(model: Model, deployment: Deployment) -> str:
    """Return what the report says of the interface: as a build without --interface would, where it has the same."""
    machine = deployment.machine
    blocks = partition_lines(model.lines, len(deployment.boards))
    interface, reason = board_interface(
        model, blocks, None, sensor_mode=machine.sensor_mode, replicas=machine.replicas
    )
    return reason if interface == (machine.interface_sensors, machine.interface_results) else ", as asked for"


def _remark(directory: Path) -> str:
    """Return what the report that is there says of how the options were chosen; nothing where there is no such report."""
    report = directory / REPORT_NAME
    try:
        return remark_of(report.read_text(encoding="utf-8")) if report.is_file() else ""
    except (OSError, UnicodeDecodeError):
        return ""


def _with_targets(new: Deployment, old: Deployment) -> Deployment:
    """Return the new deployment with everything about topics, messages and endpoints as in the old one."""
    before = {variable.name: variable for variable in old.variables}
    deployment = new.model_copy(
        update={
            "sources": old.sources,
            "outputs": old.outputs,
            "queue": old.queue,
            "tolerance_s": old.tolerance_s,
            "prior": old.prior,
            "variables": tuple(
                variable.model_copy(
                    update={"source": before[variable.name].source, "path": before[variable.name].path}
                )
                for variable in new.variables
            ),
            "boards": tuple(
                board.model_copy(update={"endpoint": other.endpoint})
                for board, other in zip(new.boards, old.boards, strict=True)
            ),
            "directory": old.directory,
        }
    )
    return deployment.model_copy(update={"hash": deployment_hash(deployment)})


def _edited(deployment: Deployment, edits: DeploymentEdits) -> Deployment:
    targets = {"uri": edits.uri, "topic": edits.topic, "type": edits.type}
    targets = {key: value for key, value in targets.items() if value is not None}
    if targets and len(deployment.sources) > 1:
        raise BuildError(
            f"--{next(iter(targets))}: this deployment has {len(deployment.sources)} sources; edit [[source]] in "
            f"{deployment.path}, then say 'toolchain regenerate deployment' without it"
        )
    outputs = deployment.outputs
    if edits.output is not None:
        outputs = (type(outputs[0])(**dict(outputs[0]) | {"topic": edits.output}), *outputs[1:])
    source = deployment.sources[0]
    machine = {
        key: value
        for key, value in (
            ("target_count", edits.target_count),
            ("max_cycles", edits.max_cycles),
            ("stop", edits.stop),
        )
        if value is not None
    }
    fields = dict(deployment) | {
        "sources": (type(source)(**dict(source) | targets), *deployment.sources[1:]),
        "outputs": outputs,
        "variables": _with_paths(_in_order(deployment.variables, edits.order), edits.paths),
        "machine": type(deployment.machine)(**dict(deployment.machine) | machine),
    }
    if edits.queue is not None:
        fields["queue"] = edits.queue
    if edits.tolerance_s is not None:
        fields["tolerance_s"] = edits.tolerance_s
    edited = Deployment(**fields)
    return edited.model_copy(update={"hash": deployment_hash(edited)})


def _in_order(variables: tuple[Variable, ...], order: tuple[str, ...] | None) -> tuple[Variable, ...]:
    """Return the columns, reading the variables in this order: a column keeps its table and its addresses' rule.

    What moves is where a reading comes from: its name, its source, and its path in the message.
    """
    if order is None:
        return variables
    columns = [place for place, variable in enumerate(variables) if variable.kind == "sensor"]
    by_name = {variables[place].name: variables[place] for place in columns}
    if sorted(order) != sorted(by_name):
        raise BuildError(
            f"--order {','.join(order)}: expected each of {', '.join(by_name) or 'no sensors'} once, in the order of "
            "the columns"
        )
    changed = list(variables)
    for place, name in zip(columns, order, strict=True):
        reading = by_name[name]
        changed[place] = variables[place].model_copy(
            update={"name": reading.name, "source": reading.source, "path": reading.path}
        )
    return tuple(changed)


def _with_paths(variables: tuple[Variable, ...], paths: tuple[tuple[str, str], ...]) -> tuple[Variable, ...]:
    said = dict(paths)
    for name, path in said.items():
        if name not in {variable.name for variable in variables}:
            names = ", ".join(variable.name for variable in variables)
            raise BuildError(f"--path {name}={path}: there is no such variable; there are {names or 'none'}")
    return tuple(
        type(variable)(**dict(variable) | {"path": said.get(variable.name, variable.path)})
        for variable in variables
    )
