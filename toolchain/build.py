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
from pcie_shim.errors import PcieShimError
from pcie_shim.programming_file import (
    Image,
    Partition,
    tool_version,
    write_image,
)
from toolchain.board_interface import board_interface
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
from toolchain.report import REPORT_NAME, build_report, with_remark

if TYPE_CHECKING:
    from toolchain.models.model import Model
    from toolchain.options import BuildOptions

_MOST_SEEDS: Final = 1 << 23
_FLAGS: Final = {"tolerance_s": "--tolerance", "path": "--prior-path"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Built:
    """A deployment, what its boards are programmed with, and what there is to say about it."""

    deployment: Deployment
    """What `deployment.toml` says."""
    images: tuple[Image, ...]
    """One per board."""
    quantised: Quantised
    """The codes before they were split over boards, and what was lost."""
    report: str
    """What `report.txt` says."""


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
        raise BuildError(f"SOURCE_DATE_EPOCH is {epoch!r}, expected a number of seconds since 1970") from None


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
        raise BuildError(
            f"--scale address does not go with --sensor-mode {options.sensor_mode}: lines look at different addresses in a "
            "frame, so the factors of addresses would not cancel; use --scale column or none"
        )
    if not 1 <= options.replicas <= REPLICAS_MAX:
        raise BuildError(f"--replicas is {options.replicas}, expected 1 to {REPLICAS_MAX}")


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
            raise BuildError(f"{flag} says where a written prior comes from: add --prior-mode written")
    elif model.prior_select is not None:
        raise BuildError(
            f"the prior is selected by {model.prior_select.name}, so it can't be written too: leave "
            "--prior-mode written out, or the selection"
        )


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
