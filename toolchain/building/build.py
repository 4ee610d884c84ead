"""The steps from a model to a deployment (thesis 3.4).

BM1: model, options ──▶ plan_machine ──▶ quantise ──▶ whole_machine ──▶ split ──▶ images ──▶ describe ──▶ files
                        └─▶ board_layout
BM2: network, options ──▶ plan_bm2 ──▶ chain_machines ──▶ images ──▶ describe ──▶ files

`board_layout` determines the lines and the interface of each board, before tables are computed.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray
from pydantic import ValidationError

from machines.bm1 import BM1Machine
from machines.bm2 import BM2Machine, BM2Parameters
from machines.parameters import BM1Parameters, SensorMode
from pcie_shim.programming_file import Image, Partition, read_image, tool_version
from toolchain.bounded_files import file_errors
from toolchain.building.bm2_machine import BM2_KEYS, BM2Plan, chain_layout, chain_machines
from toolchain.building.machine import (
    MACHINE_KEYS,
    BoardLayout,
    MachinePlan,
    board_layout,
    size_text,
    split,
    whole_machine,
)
from toolchain.building.options import refused_option
from toolchain.building.quantise import Quantised
from toolchain.building.report import bm2_report, build_report
from toolchain.building.sources import placed
from toolchain.deployment import (
    FILE_NAME,
    UNFINISHED,
    BM1Section,
    BM2Section,
    BoardSection,
    Deployment,
    Dimension,
    FilterSection,
    Output,
    Variable,
    deployment_text,
)
from toolchain.deployment.deployment import with_hash
from toolchain.deployment.filter import Transition
from toolchain.errors import BuildError, DeploymentError
from toolchain.outputs.output_files import (
    filter_file,
    image_files,
    memory_files,
    present,
    quartus_files,
    text_file,
    write_files,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Built:
    """The result of a build: a deployment, the images (programming files) of its boards, and the report."""

    deployment: Deployment
    """The content of `deployment.toml`."""
    images: tuple[Image, ...]
    """One per board."""
    quantised: Quantised | None
    """The codes of a BM1 before the division among boards, and the quantisation loss, or None for a BM2."""
    report: str
    """The content of `report.txt`."""
    transition: Transition | None = None
    """The transition of the filter, or None without a filter. `[filter]` in `deployment.toml` contains its hash."""


REPORT_NAME: Final = "report.txt"


def build_deployment(
    plan: MachinePlan | BM2Plan, directory: Path, *, remarks: Callable[[Built], Iterable[str]] = lambda _: ()
) -> Built:
    """Write a deployment: `deployment.toml`, an image per board, a report, and the hardware project.

    The bytes depend only on the plan. The build replaces a deployment that is in the folder already. `remarks`
    returns sentences to add to the report.

    Raises:
        BuildError: The options contradict the register map, or the folder cannot be written. A folder without a
            deployment is also refused if the build would overwrite or remove files in it.
    """
    built = assemble(plan)
    for remark in remarks(built):
        built = replace(built, report=f"{built.report}\n{remark}\n")
    parts = (
        image_files(built.deployment, built.images),
        filter_file(built.transition),
        memory_files(built.deployment, built.images),
        quartus_files(built.deployment, built.images),
        text_file(REPORT_NAME, built.report),
        text_file(FILE_NAME, deployment_text(built.deployment)),
    )
    # While it exists, the files in the folder are those of an unfinished build, which the next build may replace.
    unfinished = directory / UNFINISHED
    with file_errors(directory, "written", BuildError, "; choose another folder with -o"):
        directory.mkdir(parents=True, exist_ok=True)
        if (directory / FILE_NAME).is_file():
            # a process that reads the folder meanwhile finds no deployment, instead of parts of two
            (directory / FILE_NAME).replace(unfinished)
        elif not unfinished.exists():
            if foreign := [name for part in parts for name in present(directory, part)]:
                raise BuildError(
                    f"{directory} has {foreign[0]}, but no {FILE_NAME}: no build wrote that file, and this one would "
                    "replace or remove it; choose another folder with -o, or move the file"
                )
            unfinished.touch()
        write_files(directory, *parts)
        unfinished.unlink()
    return replace(built, deployment=built.deployment.replace(directory=directory))


def assemble(
    plan: MachinePlan | BM2Plan,
    place: Callable[[Deployment, Sequence[Image]], Deployment] = lambda deployment, _: deployment,
) -> Built:
    """Return a deployment without writing a file. The function `place` may change the deployment's topics.

    Raises a BuildError if the deployment cannot be made.
    """
    model, options, quantised = plan.model, plan.options, None
    known_variables(plan)  # refuses --order and --path before the tables are computed
    machines: Sequence[BM1Machine | BM2Machine]
    if isinstance(plan, BM2Plan):
        machines = chain_machines(plan)
        layout, lines = chain_layout(plan.parameters, options.interface), len(machines)
        identity = _model_hash(plan, [*machines[0].tables, *machines[0].supports])
        report = partial(bm2_report, plan.model, machine=machines[0], why=plan.why)
    else:
        layout, lines = board_layout(plan.parameters, options.partitions, options.interface), model.lines
        quantised = plan.quantised()
        machine = whole_machine(plan, quantised)
        machines = split(machine, len(layout.blocks))
        identity = _model_hash(plan, [machine.prior, *machine.tables])
        report = partial(build_report, plan.model, quantised=quantised)
    images = tuple(
        Image(
            machine=machine,
            partition=Partition(board, len(machines), block.offset, lines),
            interface_sensors=layout.interface[0],
            interface_results=layout.interface[1],
            model_hash=identity,
            build_date=options.build_date,
            tool_version=tool_version(),
        )
        for board, (machine, block) in enumerate(zip(machines, layout.blocks, strict=True))
    )
    deployment = place(describe(plan, layout, images), images)
    return Built(
        deployment=deployment,
        images=images,
        quantised=quantised,
        report=report(deployment=deployment, interface_reason=layout.reason),
        transition=None if isinstance(plan, BM2Plan) else plan.model.transition,
    )


def build_date(model_file: Path) -> str:
    """Return the build date for a model file, in ISO 8601 and UTC.

    The date is `SOURCE_DATE_EPOCH` if set, otherwise the modification time of the file. So equal input gives equal
    bytes. Raises a BuildError if `SOURCE_DATE_EPOCH` is not a time.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        seconds = int(model_file.stat().st_mtime) if epoch is None else int(epoch)
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds))
    except (ValueError, OverflowError, OSError):
        raise BuildError(f"SOURCE_DATE_EPOCH is {epoch!r}, expected a number of seconds since 1970") from None


def _model_hash(plan: MachinePlan | BM2Plan, codes: Sequence[NDArray[Any]]) -> str:
    """Return the SHA-256 (hexadecimal) of the machine over all boards.

    The hash covers the names of the model and the variables, and `codes`. It does not cover probabilities, because the
    last bits of a probability depend on the mathematics library.
    """
    model, parameters = plan.model, plan.parameters
    words: dict[str, Any] = {
        "name": model.name,
        "searched": [dimension.model_dump(mode="json") for dimension in model.searched],
        "known": [variable.model_dump(mode="json", exclude={"unit"}) for variable in model.variables],
        "prob_bits": parameters.prob_bits,
    }
    if isinstance(plan, BM2Plan):
        words["variables"] = list(zip(plan.model.names, plan.model.cardinalities, strict=True))
        words["factors"] = plan.parameters.factors
    elif plan.parameters.sensor_mode is not SensorMode.COLUMN or plan.parameters.replicas > 1:
        words |= {"sensor_mode": plan.parameters.sensor_mode.value, "replicas": plan.parameters.replicas}
    digest = hashlib.sha256(json.dumps(words, sort_keys=True, separators=(",", ":")).encode())
    for part in codes:
        digest.update(part.astype("<u2", copy=False).tobytes())
    return digest.hexdigest()


def describe(plan: MachinePlan | BM2Plan, layout: BoardLayout, images: Sequence[Image]) -> Deployment:
    """Return the deployment that lists these images. The deployment contains its own hash.

    Raises a BuildError if an option does not fit.
    """
    model, options = plan.model, plan.options
    own: dict[str, Any]
    hidden: tuple[Dimension, ...] = ()
    own_filter: FilterSection | None = None
    section: type[BM1Section | BM2Section]
    if isinstance(plan, BM2Plan):
        section, keys, own = BM2Section, BM2_KEYS, {"variables": plan.model.names}
        asked = {*plan.model.known, *(each.label for each in model.searched)}
        symbols = plan.model.symbols if plan.parameters.stream else ()  # only a stream shows hidden variables
        hidden = tuple(each.dimension() for each in symbols if each.name not in asked)
    else:
        section, keys, own = BM1Section, MACHINE_KEYS, {"scale": options.scaling, "stop": options.stop}
        if plan.model.transition is not None:
            content = plan.model.transition.content()
            own_filter = FilterSection(hash=hashlib.sha256(content).hexdigest())
    own |= {key: getattr(plan.parameters, key) for key in keys}
    try:
        deployment = Deployment(
            name=model.name,
            queue=options.queue,
            tolerance_s=options.tolerance_s,
            sources=options.all_sources,
            variables=known_variables(plan),
            searched=model.searched,
            hidden=hidden,
            machine=section(
                lines=model.lines,
                interface=size_text(layout.interface),
                target_count=plan.target_count,
                max_cycles=plan.max_cycles,
                **own,
            ),
            prior=options.written_prior,
            filter=own_filter,
            boards=tuple(
                BoardSection(
                    image=f"boards/board{index}.bm",
                    image_hash=image.image_hash,
                    line_offset=block.offset,
                    lines=block.lines,
                )
                for index, (image, block) in enumerate(zip(images, layout.blocks, strict=True))
            ),
            model=options.model_flags,
            outputs=(Output(topic=options.output),),
        )
    except ValidationError as reason:
        raise refused_option(reason) from None
    return with_hash(deployment)


def known_variables(plan: MachinePlan | BM2Plan) -> tuple[Variable, ...]:
    """Return the known variables of the deployment, with their sources and paths in messages.

    With `--sensor-mode threshold`, the boards get codes instead of addresses. For a sensor, `bits` and `values` of the
    returned variable then describe the codes.

    Raises a BuildError if `--order`, `--path` or a sources file names a variable that the model does not have.
    """
    options, variables = plan.options, plan.model.variables
    variables = variables if options.sources is None else options.sources.place(variables)
    variables = placed(variables, options.order, options.path)
    if options.sensor_mode is not SensorMode.THRESHOLD:
        return tuple(variables)
    bits = plan.parameters.prob_bits
    return tuple(
        Variable(
            name=variable.name,
            source=variable.source,
            path=variable.path,
            table_of=variable.table_of,
            bits=bits,
            values=2**bits - 1,
            on_missing=variable.on_missing,
        )
        if variable.kind == "sensor"
        else variable
        for variable in variables
    )


def read_images(deployment: Deployment) -> list[Image]:
    """Read the image of each board. Returns the images in the order of the boards."""
    return [read_image(deployment.image_path(board)) for board in range(len(deployment.boards))]


def check_agreement(
    deployment: Deployment, images: Sequence[Image], *, edited: Container[str] = frozenset()
) -> None:
    """Raise a DeploymentError if `deployment.toml` contradicts its images. Keys in `edited` are not compared."""
    machine = deployment.machine
    total = machine.lines if machine.is_divided else len(images)
    for index, (board, image) in enumerate(zip(deployment.boards, images, strict=True)):
        pairs: dict[str, tuple[object, object]] = {"type": (machine.type, image.kind.name)}
        if machine.type == image.kind.name:
            pairs |= _parameter_pairs(deployment, image.machine.parameters)
        part = Partition(index, len(images), board.line_offset, total)
        pairs |= {
            "interface": (machine.interface, f"{image.interface_sensors}x{image.interface_results}"),
            "lines of the board": (board.lines, image.registers.lines),
            "part of the model": (part, image.partition),
        }
        for key, (expected, found) in pairs.items():
            if found != expected and key not in edited:
                raise DeploymentError(
                    f"{deployment.path} has {key} = {expected}, but {board.image} was built with {found}: set it back, "
                    "or build again with 'toolchain build'"
                )


def _parameter_pairs(
    deployment: Deployment, parameters: BM1Parameters | BM2Parameters
) -> dict[str, tuple[object, object]]:
    """Return a pair for each parameter, by name: its value in the deployment, and its value in the image."""
    machine, sensors = deployment.machine, deployment.sensors
    pairs: dict[str, tuple[object, object]]
    if isinstance(parameters, BM1Parameters):
        keys, count = MACHINE_KEYS, parameters.sensors
        widths = zip(sensors, parameters.sensor_bits, strict=False)
        pairs = {f"bits of {each.name}": (each.bits, bits) for each, bits in widths}
    else:
        keys, count, sizes = BM2_KEYS, len(parameters.known), parameters.cardinalities
        places = zip(sensors, parameters.known, strict=False)
        pairs = {f"values of {each.name}": (each.values, sizes[at]) for each, at in places}
        found = tuple(sizes[at] for at in parameters.searched)
        pairs["sizes of the searched variables"] = tuple(each.size for each in deployment.searched), found
        names = getattr(machine, "variables", ())
        pairs["number of names in 'variables'"] = len(names), len(sizes)
        if len(names) == len(sizes):
            # known variables are compared in any order, since 'regenerate deployment --order' changes it
            labels, asked = (
                [each.label for each in deployment.searched],
                [names[at] for at in parameters.searched],
            )
            pairs["searched variables"] = labels, asked
            found_sizes = dict(zip(names, sizes, strict=True))
            pairs |= {f"values of {e.label}": (e.size, found_sizes.get(e.label)) for e in deployment.hidden}
            read = sorted(names[at] for at in parameters.known)
            pairs["known variables"] = sorted(each.name for each in sensors), read
    same = {key: (getattr(machine, key), getattr(parameters, key)) for key in keys}
    return {**same, **pairs, "number of sensors": (len(sensors), count)}
