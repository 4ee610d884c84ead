"""The path from a model to a deployment (thesis 3.4).

model, options ──▶ plan_machine ──▶ quantise ──▶ whole_machine ──▶ board_images ──▶ describe ──▶ files
                   └─▶ board_layout (lines and interface of each board, before tables are computed)
"""

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

from pcie_shim.programming_file import Image
from toolchain.building.board_layout import board_layout
from toolchain.building.images import board_images, describe
from toolchain.building.machine import MachinePlan, whole_machine
from toolchain.building.quantise import Quantised, quantise
from toolchain.building.report import REPORT_NAME, build_report
from toolchain.deployment import FILE_NAME, Deployment, write_deployment
from toolchain.errors import BuildError, DeploymentError
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

    The same plan gives the same bytes. A deployment in the folder is replaced; `remark` ends the report.

    Raises:
        BuildError: The options contradict the register map, or the folder cannot be written.
    """
    built = assemble(plan)
    if remark:
        built = replace(built, report=f"{built.report}\n{remark}\n")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        # a process that reads the folder meanwhile finds no deployment, instead of parts of two
        (directory / FILE_NAME).unlink(missing_ok=True)
    except OSError as reason:
        raise BuildError(
            f"{directory} cannot be written: {reason.strerror or reason}; choose another folder with -o"
        ) from None
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
    same bytes.

    Raises:
        BuildError: `SOURCE_DATE_EPOCH` is not a time.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        seconds = int(model_file.stat().st_mtime) if epoch is None else int(epoch)
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds))
    except (ValueError, OverflowError, OSError):
        raise BuildError(f"SOURCE_DATE_EPOCH is {epoch!r}, expected a number of seconds since 1970") from None
