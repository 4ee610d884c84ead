"""Regeneration of one part of a deployment: the memory files, the project or `deployment.toml` (thesis 3.4)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from machines.parameters import SensorMode
from pcie_shim.programming_file import Image
from toolchain.building.bm2_machine import BM2_KEYS, BM2Plan, chain_layout, plan_bm2
from toolchain.building.build import REPORT_NAME, assemble, check_agreement, read_images
from toolchain.building.choice import model_for
from toolchain.building.machine import MACHINE_KEYS, MachinePlan, board_layout, machine_options, plan_machine
from toolchain.building.options import BuildOptions, DeploymentEdits, MachineChoice, refused_option
from toolchain.building.sources import placed
from toolchain.deployment import (
    FILE_NAME,
    BM2Section,
    Deployment,
    ModelSection,
    deployment_text,
    load_deployment,
)
from toolchain.deployment.deployment import with_hash
from toolchain.errors import BuildError, ModelError
from toolchain.models.joint import Question
from toolchain.models.model import Model
from toolchain.outputs.output_files import (
    Change,
    filter_file,
    image_files,
    memory_files,
    quartus_files,
    text_file,
    write_files,
)


def edited(deployment: Deployment, edits: DeploymentEdits) -> Deployment:
    """Return the edited deployment with a new hash, or raise a BuildError if an edit is invalid."""
    target = _defined(uri=edits.uri, topic=edits.topic, type=edits.type)
    if target and len(deployment.sources) > 1:
        raise BuildError(
            f"--{next(iter(target))}: this deployment has {len(deployment.sources)} sources; edit [[source]] in "
            f"{deployment.path}, then run 'toolchain regenerate deployment' without it"
        )
    first_source, *sources = deployment.sources
    first_output, *outputs = deployment.outputs
    if edits.stop is not None and not deployment.machine.is_divided:
        raise BuildError(f"--stop is for a BM1, but this deployment is a {deployment.machine.type}")
    machine = _defined(target_count=edits.target_count, max_cycles=edits.max_cycles, stop=edits.stop)
    try:
        changed = deployment.replace(
            sources=(first_source.replace(**target), *sources),
            outputs=(first_output.replace(**_defined(topic=edits.output)), *outputs),
            variables=placed(deployment.variables, edits.order, edits.path),
            machine=deployment.machine.replace(**machine),
            **_defined(queue=edits.queue, tolerance_s=edits.tolerance_s),
        )
    except ValidationError as reason:
        raise refused_option(reason) from None
    return with_hash(changed)


def _defined(**values: object) -> dict[str, object]:
    return {key: value for key, value in values.items() if value is not None}


Changes = list[tuple[str, Change]]


def regenerate_memories(
    directory: Path,
    model: Model | Question | None = None,
    *,
    flags: ModelSection | None = None,
    build_date: str = "",
) -> Changes:
    """Write the memory files again, and for a BM1 also `bm1_parameters.vhd`.

    Without a model, the tables come from the images. If a model is given, `flags` are the flags with which it was read.
    The function then computes the tables from the model. It also writes the report, the images (dated `build_date`),
    and the hashes in `deployment.toml`. The columns get the order of the model. Sizes, widths, topics and paths in
    messages do not change.

    Raises:
        BuildError: The model now needs another machine, so a new build is necessary.
        DeploymentError: The deployment is missing or damaged.
    """
    deployment = load_deployment(directory, interrupted=model is not None)
    images = read_images(deployment)
    check_agreement(deployment, images)
    if model is None:
        return write_files(directory, memory_files(deployment, images))
    options = replace(
        _options(deployment, images[0]), model_flags=flags or ModelSection(), build_date=build_date
    )
    plan = _plan(model, options, deployment, images[0])

    def place(new: Deployment, of: Sequence[Image]) -> Deployment:
        # an image of the same model that differs from the built one has edited parameters, which may be undone later
        same_model = of[0].model_hash == images[0].model_hash
        return _with_places(new, deployment, keeps_built=same_model)

    built = assemble(plan, place)
    return write_files(
        directory,
        image_files(built.deployment, built.images),
        filter_file(built.transition),
        memory_files(built.deployment, built.images),
        text_file(REPORT_NAME, built.report),
        # last, so that a partially written folder has the old hashes
        text_file(FILE_NAME, deployment_text(built.deployment)),
    )


def regenerate_project(directory: Path) -> Changes:
    """Write the Quartus project again."""
    deployment = load_deployment(directory)
    return write_files(directory, quartus_files(deployment, read_images(deployment)))


def regenerate_deployment(directory: Path, edits: DeploymentEdits) -> Changes:
    """Write `deployment.toml` again with `edits`. Changes made by hand in the file are kept, and images do not change.

    Raises:
        BuildError: An edit has a wrong value, or does not fit the deployment.
        DeploymentError: The deployment is missing or damaged, or it contradicts its images.
    """
    deployment = edited(load_deployment(directory, edited=True), edits)
    check_agreement(deployment, read_images(deployment))
    return write_files(directory, text_file(FILE_NAME, deployment_text(deployment)))


def _options(deployment: Deployment, image: Image) -> BuildOptions:
    machine, source, parameters = deployment.machine, deployment.sources[0], image.machine.parameters
    partitions = len(deployment.boards)
    own: dict[str, Any] = {}
    if isinstance(machine, BM2Section):
        without_flag, keys = chain_layout(parameters, None), BM2_KEYS
    else:
        without_flag = board_layout(replace(parameters, lines=machine.lines), partitions, None)
        own, keys = {"scale": machine.scale, "stop": machine.stop}, MACHINE_KEYS
    interface = (machine.interface_sensors, machine.interface_results)
    return BuildOptions(
        machine=MachineChoice(machine.type.lower()),
        uri=source.uri,
        topic=source.topic,
        type=source.type,
        partitions=partitions,
        interface=None if interface == without_flag.interface else interface,
        target_count=machine.target_count,
        max_cycles=machine.max_cycles,
        rng_table=image.machine.rng_table,
        **own,
        **machine_options(machine, keys),
    )


def _plan(
    source: Model | Question, options: BuildOptions, deployment: Deployment, image: Image
) -> MachinePlan | BM2Plan:
    """Return the plan for the machine of a deployment, or raise a BuildError if the model now needs another machine."""
    model, why = model_for(source, options)
    sizes = [(each.label, each.size) for each in model.searched]
    built_sizes = [(each.label, each.size) for each in deployment.searched]
    names = sorted(each.name for each in model.variables)
    built_names = sorted(each.name for each in deployment.variables)
    for what, new, old in (("searches", sizes, built_sizes), ("knows", names, built_names)):
        if new != old:
            raise BuildError(
                f"the model {what} {_listed(new)}, but the deployment {_listed(old)}: this is another machine, so "
                "build it again with 'toolchain build'"
            )
    if isinstance(model, Model) and (model.transition is None) is not (deployment.filter is None):
        found = (
            "no filter, but the deployment one"
            if model.transition is None
            else "a filter, but the deployment none"
        )
        raise BuildError(
            f"the model has {found}: give the same --previous as for the build, or build it again"
        )
    if isinstance(model, Model):
        return plan_machine(_with_widths(model, deployment), options)
    plan = plan_bm2(model, options, why)
    if plan.parameters != image.machine.parameters:
        raise BuildError(
            "the model now has other variables or factors: this is another machine, so build it again with "
            "'toolchain build'"
        )
    return plan


def _with_widths(model: Model, deployment: Deployment) -> Model:
    """Return the model with the deployment's address widths; a BuildError if the model needs another machine."""
    kinds = {variable.name: variable.kind for variable in model.variables}
    built = {variable.table_of or variable.name: variable for variable in deployment.variables}
    built_kinds = {name: variable.kind for name, variable in built.items()}
    if kinds != built_kinds:
        raise BuildError("another variable now selects the prior: build it again with 'toolchain build'")
    bits = {name: variable.bits for name, variable in built.items()}
    if deployment.machine.sensor_mode is SensorMode.THRESHOLD:
        # there are no tables, so no memory whose width must stay
        bits |= {known.name: known.bits for known in model.known}
    try:
        return model.with_bits(bits)
    except ModelError as reason:
        raise BuildError(
            f"{reason}: its memory is that wide; build it again with 'toolchain build'"
        ) from None


def _listed(values: Sequence[object]) -> str:
    return ", ".join(
        f"{value[0]} ({value[1]})" if isinstance(value, tuple) else str(value) for value in values
    )


def _with_places(new: Deployment, old: Deployment, *, keeps_built: bool) -> Deployment:
    """Return the new deployment with the old one's servers, topics, paths, variables' names and boards' endpoints.

    With `keeps_built`, the entry of an edited image keeps the hash of the image that was built.
    """
    before = {variable.table_of or variable.name: variable for variable in old.variables}
    kept = ("sources", "outputs", "topics", "queue", "tolerance_s", "prior", "directory")
    deployment = new.replace(
        **{key: getattr(old, key) for key in kept},
        variables=tuple(
            variable.replace(
                name=own.name,
                source=own.source,
                path=own.path,
                table_of=own.table_of,
                unit=variable.unit or own.unit,
            )
            for variable in new.variables
            for own in (before[variable.name],)
        ),
        boards=tuple(
            board.replace(
                endpoint=other.endpoint,
                built_hash=other.built_hash if keeps_built and other.built_hash != board.image_hash else None,
            )
            for board, other in zip(new.boards, old.boards, strict=True)
        ),
    )
    return with_hash(deployment)
