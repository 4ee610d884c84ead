"""The path from a model to a deployment (thesis 3.4).

model, options ──▶ plan_machine ──▶ quantise ──▶ whole_machine ──▶ board_images ──▶ describe ──▶ files
                   └─▶ board_layout (lines and interface of each board, before tables are computed)
"""

import hashlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from machines.bm1 import BM1Machine
from machines.parameters import PriorMode, SensorMode
from pcie_shim.programming_file import Image, Partition, read_image, tool_version
from toolchain.bounded_files import file_errors
from toolchain.building.machine import (
    MACHINE_KEYS,
    BoardLayout,
    MachinePlan,
    board_layout,
    split,
    whole_machine,
)
from toolchain.building.options import BuildOptions, refused_option
from toolchain.building.quantise import Quantised, quantise
from toolchain.deployment import (
    FILE_NAME,
    BM1Section,
    BoardSection,
    Deployment,
    MachineSection,
    Output,
    Variable,
    write_deployment,
)
from toolchain.deployment.deployment import with_hash
from toolchain.errors import BuildError, DeploymentError
from toolchain.models.model import Model
from toolchain.outputs.output_files import image_files, memory_files, quartus_files, text_file, write_files


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Built:
    """A deployment, the images of its boards, and a report about both."""

    deployment: Deployment
    """The content of `deployment.toml`."""
    images: tuple[Image, ...]
    """One per board."""
    quantised: Quantised
    """The codes before they were divided among boards, and the quantisation loss."""
    interface_reason: str
    """The reason for an interface that is not the default, as a clause; otherwise empty."""
    report: str
    """The content of `report.txt`."""


def build_deployment(plan: MachinePlan, directory: Path, *, remark: str = "") -> Built:
    """Write a deployment: `deployment.toml`, an image per board, a report, and the hardware project.

    The same plan gives the same bytes. A deployment in the folder is replaced; `remark` ends the report. A
    BuildError if the options contradict the register map, or the folder cannot be written.
    """
    built = assemble(plan)
    if remark:
        built = replace(built, report=f"{built.report}\n{remark}\n")
    with file_errors(directory, "written", BuildError, "; choose another folder with -o"):
        directory.mkdir(parents=True, exist_ok=True)
        # a process that reads the folder meanwhile finds no deployment, instead of parts of two
        (directory / FILE_NAME).unlink(missing_ok=True)
    for part in (
        image_files(built.deployment, built.images),
        memory_files(built.deployment, built.images),
        quartus_files(built.deployment, built.images),
        text_file(REPORT_NAME, built.report),
    ):
        write_files(directory, part)
    try:
        return replace(built, deployment=write_deployment(directory, built.deployment))
    except DeploymentError as reason:
        raise BuildError(str(reason)) from None


def assemble(plan: MachinePlan) -> Built:
    """Return a deployment without writing anything, or raise a BuildError."""
    model, parameters, options = plan.model, plan.parameters, plan.options
    layout = board_layout(parameters, options.partitions, options.interface)
    quantised = quantise(
        model, prob_bits=parameters.prob_bits, scale=options.scaling, sensor_mode=parameters.sensor_mode
    )
    machine = whole_machine(plan, quantised)
    images = board_images(plan, machine, layout)
    deployment = describe(plan, layout, images)
    report = build_report(model, deployment, quantised, layout.reason)
    return Built(
        deployment=deployment,
        images=images,
        quantised=quantised,
        interface_reason=layout.reason,
        report=report,
    )


def build_date(model_file: Path) -> str:
    """Return the build date for this model file, ISO 8601 in UTC.

    It is `SOURCE_DATE_EPOCH` if set, otherwise the modification time of the file, so the same input gives the
    same bytes. A BuildError if `SOURCE_DATE_EPOCH` is not a time.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        seconds = int(model_file.stat().st_mtime) if epoch is None else int(epoch)
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds))
    except (ValueError, OverflowError, OSError):
        raise BuildError(f"SOURCE_DATE_EPOCH is {epoch!r}, expected a number of seconds since 1970") from None


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
            machine=BM1Section(
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
                BoardSection(
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


def read_images(deployment: Deployment) -> list[Image]:
    """Return the images of the boards."""
    return [read_image(deployment.image_path(board)) for board in range(len(deployment.boards))]


def check_agreement(deployment: Deployment, images: Sequence[Image]) -> None:
    """Raise a DeploymentError if `deployment.toml` describes another machine than its images."""
    machine = deployment.machine
    for index, (board, image) in enumerate(zip(deployment.boards, images, strict=True)):
        parameters = image.machine.parameters
        pairs: dict[str, tuple[object, object]] = {
            key: (getattr(machine, key), getattr(parameters, key)) for key in MACHINE_KEYS
        }
        for variable, bits in zip(deployment.sensors, parameters.sensor_bits, strict=False):
            pairs[f"bits of {variable.name}"] = variable.bits, bits
        part = Partition(index, len(images), board.line_offset, machine.lines)
        pairs |= {
            "number of sensors": (len(deployment.sensors), parameters.sensors),
            "interface": (machine.interface, f"{image.interface_sensors}x{image.interface_results}"),
            "lines of the board": (board.lines, parameters.lines),
            "part of the model": (part, image.partition),
        }
        for key, (expected, found) in pairs.items():
            if found != expected:
                raise DeploymentError(
                    f"{deployment.path} has {key} = {expected}, but {board.image} was built with {found}: set it back, "
                    "or build again with 'toolchain build'"
                )


REPORT_NAME: Final = "report.txt"


def build_report(
    model: Model, deployment: Deployment, quantised: Quantised, interface_reason: str = ""
) -> str:
    """Return what was built and what was lost, in plain sentences, without dates or paths: same input, same bytes."""
    machine = deployment.machine
    grid = " x ".join(f"{d.label} {d.size}" for d in model.searched)
    names = ", ".join(known.name for known in model.known)
    count = f"{len(model.known)} known variable{'s' if len(model.known) != 1 else ''}"
    machine_sentence = (
        f"Machine: BM1, codes of {machine.prob_bits} bits (scale = {machine.scale}), counters of "
        f"{machine.counter_bits} bits, stops at a count of {machine.target_count} or after {machine.max_cycles} "
        f"cycles, stop = {machine.stop}; {machine.rng} with {machine.rng_banks} banks, rng_reset = "
        f"{machine.rng_reset}, {machine.steps_per_clock} steps per clock."
    )
    machine_sentence += many_sentence(machine)
    paragraphs = [
        f"Model {model.name}: {model.lines} lines ({grid}), {count}"
        + (
            f", in the order of the columns: {names}."
            if len(model.known) > 1
            else f", {names}."
            if names
            else "."
        ),
        *_state_paragraph(model),
        *_prior_paragraph(model, deployment),
        machine_sentence,
        f"Interface: {machine.interface}{interface_reason}.",
        f"Boards: {len(deployment.boards)}.\n"
        + "\n".join(
            f"  {board.image}: lines {board.line_offset} to {board.line_offset + board.lines - 1}, "
            f"image {board.image_hash[:16]}"
            for board in deployment.boards
        ),
        loss_heading(machine.sensor_mode) + "\n" + _loss_table(quantised),
    ]
    paragraphs += [f"Warning: {warning}" for warning in quantised.warnings]
    paragraphs.append(f"{_topics_sentence(deployment)} Deployment {deployment.hash[:16]}.")
    return "\n\n".join(paragraphs) + "\n"


def loss_heading(sensor_mode: SensorMode) -> str:
    """Return the heading of the table of losses."""
    posterior = "the column's own posterior"
    if sensor_mode is SensorMode.CELL:
        posterior += " where all lines read the same"
    return f"Lost by quantising (mass: how often the true line has code 0; KL: of {posterior}, bits):"


def many_sentence(machine: MachineSection) -> str:
    """Describe a frame's readings and results, unless they are one number per variable and one posterior."""
    sentence = {
        SensorMode.COLUMN: "",
        SensorMode.CELL: f" Each of the {machine.lines} lines has a reading of its own (sensor_mode = cell).",
        SensorMode.THRESHOLD: (
            f" Readings are probabilities, one for each of the {machine.lines} lines (sensor_mode = threshold); there are no "
            "tables."
        ),
    }[machine.sensor_mode]
    if machine.replicas > 1:
        sentence += (
            f" Each board holds {machine.replicas} of these machines around the same generators: a frame brings {machine.replicas} "
            f"sets of readings and gives {machine.replicas} posteriors."
        )
    return sentence


def _topics_sentence(deployment: Deployment) -> str:
    """Name the sources of readings (with their variables, if there are several) and the topic of the posteriors."""
    output = deployment.outputs[0]
    places = [f"{source.uri}, topic {source.topic} ({source.type})" for source in deployment.sources]
    if len(places) == 1:
        return f"Readings come from {places[0]}; posteriors go to {output.topic}."
    for at, place in enumerate(places):
        names = [variable.name for variable in deployment.variables if variable.source == at]
        if deployment.prior is not None and deployment.prior.source == at:
            names.append("the prior")
        places[at] = f"\n  {place}: {', '.join(names)}"
    return (
        f"Readings come from {len(places)} topics, together where their stamps are within "
        f"{deployment.tolerance_s:g} s:{''.join(places)}\n"
        f"Posteriors go to {output.topic} on {deployment.output_uri(output)}."
    )


def _state_paragraph(model: Model) -> list[str]:
    named = [
        f"  {name}: " + ", ".join(f"{offset + at * step:g} {state}" for at, state in enumerate(states))
        for name, offset, step, states in (
            *((each.label, each.offset, each.step, each.states) for each in model.searched),
            *((each.name, each.offset, each.step, each.states) for each in model.variables),
        )
        if states
    ]
    return ["States, as numbers; a reading may be either:\n" + "\n".join(named)] if named else []


def _prior_paragraph(model: Model, deployment: Deployment) -> list[str]:
    if (select := model.prior_select) is not None:
        return [
            f"Prior: selected by {select.name}, one of {select.values} rows; a missing reading takes the prior without it."
        ]
    if deployment.machine.prior_mode is not PriorMode.WRITTEN:
        return []
    if deployment.prior is None:
        return ["Prior: written by the host; the model's own until it is."]
    return [f"Prior: written every frame, from {deployment.prior.path} of the message."]


def _loss_table(quantised: Quantised) -> str:
    width = max(len(loss.name) for loss in quantised.losses)
    rows = [f"  {'column':{max(width, 6)}}  bits  values       mass         KL"]
    rows += [
        f"  {loss.name:{max(width, 6)}}  {loss.bits:4d}  {loss.values:6d}  {loss.mass:9.2e}  {loss.kl_bits:9.2e}"
        for loss in quantised.losses
    ]
    return "\n".join(rows)
