"""Builds a deployment from a model: codes, partitions, programming files and `deployment.toml` (thesis 3.4)."""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from pydantic import ValidationError

from machines.bm1 import BM1Machine
from machines.errors import MachineError
from machines.parameters import REPLICAS_MAX, BM1Parameters, PriorMode, RngKind, SensorMode
from pcie_shim import register_map
from pcie_shim.errors import PcieShimError
from pcie_shim.programming_file import (
    Image,
    Partition,
    interface_room,
    interface_words,
    tool_version,
    write_image,
)
from toolchain.deployment import (
    FILE_NAME,
    Board,
    Deployment,
    MachineSection,
    Output,
    Source,
    Variable,
    WrittenPrior,
    deployment_hash,
    write_deployment,
)
from toolchain.errors import BuildError
from toolchain.options import Scale
from toolchain.outputs.memories import generators
from toolchain.outputs.output_files import memory_files, quartus_files, write_files
from toolchain.outputs.rng_table import random_table
from toolchain.partition import Block, partition_lines
from toolchain.quantise import Quantised, quantise

if TYPE_CHECKING:
    from toolchain.models.model import Model
    from toolchain.options import BuildOptions

DEFAULT_INTERFACE: Final = (20, 1200)
"""Inputs and results of the thesis's PCIe interface (3.2)."""

REPORT_NAME: Final = "report.txt"

_MOST_SEEDS: Final = 1 << 23
_FLAGS: Final = {"tolerance_s": "--tolerance", "path": "--prior-path"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Built:
    """A deployment, what its boards are programmed with, and what there is to say about it.

    Attributes:
        deployment: What `deployment.toml` says.
        images: One per board.
        quantised: The codes before they were split over boards, and what was lost.
        report: What `report.txt` says.
    """

    deployment: Deployment
    images: tuple[Image, ...]
    quantised: Quantised
    report: str


def build_deployment(model: Model, directory: Path, options: BuildOptions, *, remark: str = "") -> Built:
    """Write a model's deployment: `deployment.toml`, an image per board, a report, and the hardware project.

    The same model and options give the same bytes.

    Args:
        model: The model.
        directory: Where to; made if it is not there. A deployment that is there is replaced.
        options: Everything else.
        remark: What the report says of how the options were chosen.

    Raises:
        BuildError: Options that don't fit each other, the model or the register map, or a folder that can't be
            written.
    """
    built = assemble(model, options)
    built = replace(built, report=with_remark(built.report, remark))
    written = _write(Path(directory), built.deployment, built.images)
    try:
        (written.directory / REPORT_NAME).write_text(built.report, encoding="utf-8")
    except OSError as reason:
        raise _not_writable(written.directory / REPORT_NAME, reason) from None
    return replace(built, deployment=written)


def assemble(model: Model, options: BuildOptions) -> Built:
    """Return a model's deployment without writing anything.

    Raises:
        BuildError: Options that don't fit each other, the model or the register map.
    """
    check_options(options)
    blocks = partition_lines(model.lines, options.partitions)
    _check_prior(model, options)
    interface, interface_reason = board_interface(
        model, blocks, options.interface, sensor_mode=options.sensor_mode, replicas=options.replicas
    )
    try:
        parameters = machine_parameters(model, options)
        _check_seeds(replace(parameters, lines=blocks[0].lines))
        quantised = quantise(
            model, prob_bits=options.prob_bits, scale=options.scaling, sensor_mode=options.sensor_mode
        )
        images = _images(model, quantised, parameters, blocks, interface, options)
    except (MachineError, PcieShimError) as reason:
        raise BuildError(str(reason)) from reason
    deployment = _deployment(model, parameters, images, blocks, interface, options)
    deployment = deployment.model_copy(update={"hash": deployment_hash(deployment)})
    return Built(
        deployment=deployment,
        images=images,
        quantised=quantised,
        report=build_report(model, deployment, quantised, interface_reason),
    )


def machine_parameters(model: Model, options: BuildOptions) -> BM1Parameters:
    """Return the parameters of the whole model's machine, before it is split over boards.

    Raises:
        machines.errors.ParameterError: No such machine can be built.
    """
    return BM1Parameters(
        lines=model.lines,
        sensor_bits=tuple(
            options.prob_bits if options.sensor_mode is SensorMode.THRESHOLD else known.bits
            for known in model.known
        ),
        prob_bits=options.prob_bits,
        prior_bits=0 if model.prior_select is None else model.prior_select.bits,
        prior_mode=options.prior_mode,
        counter_bits=options.counter_bits,
        rng=options.rng,
        shared=options.shared,
        steps_per_clock=options.steps_per_clock,
        rng_banks=options.rng_banks,
        rng_reset=options.rng_reset,
        sensor_mode=options.sensor_mode,
        replicas=options.replicas,
    )


def build_date(model_file: Path) -> str:
    """Return the date that a build of this model file carries, ISO 8601 in UTC.

    It is `SOURCE_DATE_EPOCH` where that is set, else the file's last change: the same input gives the same bytes.

    Raises:
        BuildError: `SOURCE_DATE_EPOCH` is no time.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        seconds = int(model_file.stat().st_mtime) if epoch is None else int(epoch)
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds))
    except (ValueError, OverflowError, OSError):
        message = f"SOURCE_DATE_EPOCH is {epoch!r}, expected a number of seconds since 1970"
        raise BuildError(message) from None


def board_interface(
    model: Model,
    blocks: tuple[Block, ...],
    given: tuple[int, int] | None,
    *,
    sensor_mode: SensorMode = SensorMode.COLUMN,
    replicas: int = 1,
) -> tuple[tuple[int, int], str]:
    """Return the boards' inputs and results, and a clause that says why where they are not the default.

    Args:
        model: The model.
        blocks: Its lines on each board.
        given: Inputs and results that are asked for; None for as many as are needed, the default at least.
        sensor_mode: Whether cells have inputs of their own.
        replicas: Machines on each board.

    Raises:
        BuildError: The model is larger than the interface, or the interface than the register map.
    """
    if sensor_mode is not SensorMode.COLUMN or replicas > 1:
        return _interface_of_many(model, blocks, given, sensor_mode, replicas)
    sensors, lines = len(model.known), max(block.lines for block in blocks)
    room = (register_map.SENSORS_WORDS, register_map.RESULTS_WORDS)
    if sensors > room[0] or lines > room[1]:
        partitions = -(-model.lines // room[1])
        message = (
            f"the model has {sensors} known variables and {lines} lines on a board, but the register map has room "
            f"for {room[0]} and {room[1]}"
        )
        if lines > room[1]:
            message += f": use --partitions {partitions} or more"
        raise BuildError(message)
    if given is None:
        larger = (max(sensors, DEFAULT_INTERFACE[0]), max(lines, DEFAULT_INTERFACE[1]))
        if larger == DEFAULT_INTERFACE:
            return larger, ""
        return larger, (
            f", larger than the default {DEFAULT_INTERFACE[0]}x{DEFAULT_INTERFACE[1]}: a board needs {sensors} inputs "
            f"and {lines} results"
        )
    if sensors > given[0] or lines > given[1]:
        message = (
            f"the model is larger than the interface {given[0]}x{given[1]}: a board needs {sensors} inputs and "
            f"{lines} results; use --interface {max(sensors, given[0])}x{max(lines, given[1])} or leave it out"
        )
        if lines > given[1]:
            message += f", or --partitions {-(-model.lines // given[1])}"
        raise BuildError(message)
    if given[0] > room[0] or given[1] > room[1]:
        message = f"the interface {given[0]}x{given[1]} is larger than the register map's {room[0]}x{room[1]}"
        raise BuildError(message)
    return given, ", as asked for"


def _interface_of_many(
    model: Model,
    blocks: tuple[Block, ...],
    given: tuple[int, int] | None,
    sensor_mode: SensorMode,
    replicas: int,
) -> tuple[tuple[int, int], str]:
    """The interface of boards with replicas, or with inputs for each cell: those all count."""
    lines = max(block.lines for block in blocks)
    # the widths are of no account here, and are what any mode takes
    board = BM1Parameters(
        lines=lines, sensor_bits=(8,) * len(model.known), sensor_mode=sensor_mode, replicas=replicas
    )
    inputs, results = interface_words(board)
    room = interface_room(board)
    made_of = f"{len(model.known)} known variables and {lines} lines on a board" + (
        f", {replicas} times" if replicas > 1 else ""
    )
    needed = f"a board needs {inputs} inputs and {results} results ({made_of})"
    ways = [
        *(["more --partitions"] if lines > 1 else []),
        *(["fewer --replicas"] if replicas > 1 else []),
    ]
    instead = f": use {' or '.join(ways)}" if ways else ""
    if inputs > room[0] or results > room[1]:
        message = f"{needed}, but the register map has room for {room[0]} and {room[1]}{instead}"
        raise BuildError(message)
    if given is None:
        larger = (max(inputs, DEFAULT_INTERFACE[0]), max(results, DEFAULT_INTERFACE[1]))
        default = f"{DEFAULT_INTERFACE[0]}x{DEFAULT_INTERFACE[1]}"
        return larger, "" if larger == DEFAULT_INTERFACE else f", larger than the default {default}: {needed}"
    if given[0] > room[0] or given[1] > room[1]:
        message = f"the interface {given[0]}x{given[1]} is larger than the register map's {room[0]}x{room[1]}"
        raise BuildError(message)
    if inputs > given[0] or results > given[1]:
        message = (
            f"the model is larger than the interface {given[0]}x{given[1]}: {needed}; use --interface "
            f"{max(inputs, given[0])}x{max(results, given[1])} or leave it out"
        )
        raise BuildError(message)
    return given, ", as asked for"


def model_hash(model: Model, quantised: Quantised, parameters: BM1Parameters) -> str:
    """Return the SHA-256 (hexadecimal) of the machine that all boards are parts of, and of its names.

    It covers codes, not probabilities: these differ in their last bit from one mathematics library to another.
    """
    words = {
        "name": model.name,
        "searched": [dimension.model_dump(mode="json") for dimension in model.searched],
        "known": [variable.model_dump(mode="json") for variable in model.variables],
        "prob_bits": parameters.prob_bits,
    }
    if parameters.sensor_mode is not SensorMode.COLUMN or parameters.replicas > 1:
        words |= {"sensor_mode": parameters.sensor_mode.value, "replicas": parameters.replicas}
    digest = hashlib.sha256(json.dumps(words, sort_keys=True, separators=(",", ":")).encode())
    for codes in (quantised.prior, *quantised.tables):
        digest.update(codes.astype("<u2", copy=False).tobytes())
    return digest.hexdigest()


def _images(
    model: Model,
    quantised: Quantised,
    parameters: BM1Parameters,
    blocks: tuple[Block, ...],
    interface: tuple[int, int],
    options: BuildOptions,
) -> tuple[Image, ...]:
    identity = model_hash(model, quantised, parameters)
    table = options.rng_table
    if table is None and parameters.rng is RngKind.TABLE:
        table = random_table(parameters.prob_bits)
    images = []
    for index, block in enumerate(blocks):
        lines = slice(block.offset, block.end)
        machine = BM1Machine(
            replace(parameters, lines=block.lines),
            np.ascontiguousarray(quantised.prior[:, lines]),
            tuple(np.ascontiguousarray(codes[:, lines]) for codes in quantised.tables),
            table,
        )
        images.append(
            Image(
                machine=machine,
                partition=Partition(index, len(blocks), block.offset, model.lines),
                interface_sensors=interface[0],
                interface_results=interface[1],
                model_hash=identity,
                build_date=options.build_date,
                tool_version=tool_version(),
            )
        )
    return tuple(images)


def _deployment(
    model: Model,
    parameters: BM1Parameters,
    images: tuple[Image, ...],
    blocks: tuple[Block, ...],
    interface: tuple[int, int],
    options: BuildOptions,
) -> Deployment:
    target = parameters.target_count_max if options.target_count is None else options.target_count
    try:
        return Deployment(
            name=model.name,
            queue=options.queue,
            tolerance_s=options.tolerance_s,
            sources=_sources(options),
            variables=_variables(model, options),
            searched=model.searched,
            machine=MachineSection(
                lines=model.lines,
                interface=f"{interface[0]}x{interface[1]}",
                prob_bits=parameters.prob_bits,
                scale=options.scaling.value,
                prior_bits=parameters.prior_bits,
                prior_mode=parameters.prior_mode,
                counter_bits=parameters.counter_bits,
                rng=parameters.rng,
                rng_banks=parameters.rng_banks,
                rng_reset=parameters.rng_reset,
                shared=parameters.shared,
                steps_per_clock=parameters.steps_per_clock,
                target_count=target,
                max_cycles=options.max_cycles,
                stop=options.stop,
                sensor_mode=parameters.sensor_mode,
                replicas=parameters.replicas,
            ),
            prior=_written_prior(options),
            boards=tuple(
                Board(
                    image=f"boards/board{index}.bm",
                    image_hash=image.image_hash,
                    line_offset=block.offset,
                    lines=block.lines,
                )
                for index, (image, block) in enumerate(zip(images, blocks, strict=True))
            ),
            outputs=(Output(topic=options.output),),
        )
    except ValidationError as reason:
        raise refused_option(reason) from None


def _variables(model: Model, options: BuildOptions) -> tuple[Variable, ...]:
    """The known variables; where cells are given codes, a sensor's values are those, whatever the model's are."""
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


def _sources(options: BuildOptions) -> tuple[Source, ...]:
    if options.sources is not None:
        return options.sources.sources
    return (Source(uri=options.uri, topic=options.topic, type=options.type),)


def _written_prior(options: BuildOptions) -> WrittenPrior | None:
    if options.sources is not None:
        return options.sources.prior
    return None if options.prior_path is None else WrittenPrior(path=options.prior_path)


def check_options(options: BuildOptions) -> None:
    """Refuse a URI, topic or type that is none, and options that exclude each other, before anything is computed.

    Raises:
        BuildError: Names the option and what it is to be.
    """
    try:
        _sources(options)
        Output(topic=options.output)
    except ValidationError as reason:
        raise refused_option(reason) from None
    if options.sensor_mode is not SensorMode.COLUMN and options.scaling is Scale.ADDRESS:
        message = (
            f"--scale address does not go with --sensor-mode {options.sensor_mode}: lines look at different addresses in a "
            "frame, so the factors of addresses would not cancel; use --scale column or none"
        )
        raise BuildError(message)
    if not 1 <= options.replicas <= REPLICAS_MAX:
        message = f"--replicas is {options.replicas}, expected 1 to {REPLICAS_MAX}"
        raise BuildError(message)


def _check_seeds(board: BM1Parameters) -> None:
    """Refuse a board whose seeds would be a memory of gigabytes."""
    seeds = board.rng_banks * generators(board)
    if seeds > _MOST_SEEDS and board.rng is not RngKind.IDEAL:
        most = _MOST_SEEDS // generators(board)
        message = f"--rng-banks {board.rng_banks} takes {seeds} seeds a board, and {_MOST_SEEDS} can be: use at most {most}"
        raise BuildError(message + ("" if board.shared else ", or --shared"))


def _check_prior(model: Model, options: BuildOptions) -> None:
    if options.prior_mode is PriorMode.TABLE:
        if _written_prior(options) is not None:
            flag = "--prior-path" if options.sources is None else f"{options.sources.path}"
            message = f"{flag} says where a written prior comes from: add --prior-mode written"
            raise BuildError(message)
    elif model.prior_select is not None:
        message = (
            f"the prior is selected by {model.prior_select.name}, so it can't be written too: leave "
            "--prior-mode written out, or the selection"
        )
        raise BuildError(message)


def refused_option(reason: ValidationError) -> BuildError:
    """Return a refusal by pydantic as a sentence about the option it came from."""
    detail = reason.errors()[0]
    key = str(detail["loc"][0]) if detail["loc"] else ""
    flag = "--output" if reason.title == "Output" else _FLAGS.get(key, "--" + key.replace("_", "-"))
    if detail["type"] == "value_error":
        sentence = str(detail["ctx"]["error"])
        return BuildError(f"{flag}: {sentence}" if key else sentence)
    what = detail["msg"].removeprefix("Input should be ")
    return BuildError(f"{flag} is {detail['input']!r}, expected {what}")


def _write(directory: Path, deployment: Deployment, images: tuple[Image, ...]) -> Deployment:
    boards = directory / "boards"
    try:
        boards.mkdir(parents=True, exist_ok=True)
        # Whoever reads the folder half-way finds no deployment, not one of two builds.
        (directory / FILE_NAME).unlink(missing_ok=True)
        for old in boards.iterdir():
            if re.fullmatch(r"board\d+\.bm", old.name):
                old.unlink()
    except OSError as reason:
        raise _not_writable(directory, reason) from None
    try:
        for image, board in zip(images, deployment.boards, strict=True):
            write_image(directory / board.image, image)
    except PcieShimError as reason:
        raise BuildError(str(reason)) from reason
    write_files(directory, memory_files(deployment, images))
    write_files(directory, quartus_files(deployment, images))
    return write_deployment(directory, deployment)


def _not_writable(path: Path, reason: OSError) -> BuildError:
    return BuildError(f"{path} can't be written: {reason.strerror or reason}; choose another folder with -o")


def build_report(
    model: Model, deployment: Deployment, quantised: Quantised, interface_reason: str = ""
) -> str:
    """Return what was built and what was lost, in plain sentences; no dates or paths: same input, same bytes."""
    machine = deployment.machine
    grid = " x ".join(f"{d.label} {d.size}" for d in model.searched)
    names = ", ".join(known.name for known in model.known)
    machine_sentence = (
        f"Machine: BM1, codes of {machine.prob_bits} bits (scale = {machine.scale}), counters of "
        f"{machine.counter_bits} bits, stops at a count of {machine.target_count} or after {machine.max_cycles} "
        f"cycles, stop = {machine.stop}; {machine.rng} with {machine.rng_banks} banks, rng_reset = "
        f"{machine.rng_reset}, {machine.steps_per_clock} steps a clock."
    )
    machine_sentence += many_sentence(machine)
    paragraphs = [
        f"Model {model.name}: {model.lines} lines ({grid}), {len(model.known)} known variables"
        + (f" in the columns' order {names}." if names else "."),
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
        "Lost by quantising (mass: how often the true line has code 0; KL: of the column's own posterior, bits):\n"
        + _loss_table(quantised),
    ]
    paragraphs += [f"Warning: {warning}" for warning in quantised.warnings]
    paragraphs.append(f"{_topics_sentence(deployment)} Deployment {deployment.hash[:16]}.")
    return "\n\n".join(paragraphs) + "\n"


def with_remark(report: str, remark: str) -> str:
    """Return a report that ends with how its options were chosen, where there is something to say about that."""
    return f"{report}\n{remark}\n" if remark else report


def remark_of(report: str) -> str:
    """Return how the options of a build were chosen, as its report says after the deployment's hash; empty where it does not."""
    end = re.search(r"Deployment [0-9a-f]{16}\.\n\n(.*)\Z", report, re.DOTALL)
    return end[1].strip() if end else ""


def many_sentence(machine: MachineSection) -> str:
    """Say what a frame's readings and results are where they are not one number a variable and one posterior."""
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
    """Say where readings come from (of several topics, which variables) and where posteriors go."""
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
    """Say which number, or word, is which state, where values have names."""
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
