"""Checks of a model or a deployment before anything runs, with the names in the model (thesis 3.4).

A model is checked with its build options, a deployment with the codes of its images. Findings about codes are
exact: a frame with an impossible reading ends as `impossible` on the machine, and a dead line never counts.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from pcie_shim.errors import PcieShimError
from pcie_shim.programming_file import Image
from toolchain.building.build import assemble, check_agreement, read_images
from toolchain.building.machine import MachinePlan, partition_lines, plan_machine
from toolchain.building.options import BuildOptions
from toolchain.checks.checked_machine import CheckedMachine
from toolchain.checks.codes import code_findings, loss_findings
from toolchain.checks.finding import Check, Finding, Severity, error, warning
from toolchain.checks.generators import generator_findings
from toolchain.checks.sources import source_findings
from toolchain.checks.variables import variable_findings
from toolchain.deployment import Deployment, load_deployment
from toolchain.errors import ToolchainError
from toolchain.models.model import Model
from toolchain.outputs.output_files import Change, compare_files, memory_files, quartus_files


def check_model(
    model: Model, options: BuildOptions, fit: Callable[[MachinePlan], MachinePlan] = lambda plan: plan
) -> list[Finding]:
    """Return the findings about a model and the machine for it, the worst first; `fit` may add boards to the plan."""
    refused: list[Finding] = []
    try:  # besides, so that both mistakes are found at once
        partition_lines(model.lines, options.partitions)
    except ToolchainError as reason:
        refused.append(refusal(reason, "the partitions"))
    try:
        plan = plan_machine(model, options)
        if refused:
            return refused
        built = assemble(fit(plan))
    except ToolchainError as reason:
        return [*refused, refusal(reason, "the machine")]
    machine = _machine(built.deployment, built.images, model)
    return _sorted([*_check(machine), *loss_findings(built.quantised, options)])


def check_deployment(directory: Path) -> list[Finding]:
    """Return the findings about a deployment's files and the machine in its images, the worst first."""
    try:
        deployment = load_deployment(directory)
        images = read_images(deployment)
        check_agreement(deployment, images)
    except (ToolchainError, PcieShimError) as reason:
        return [refusal(reason, "the deployment")]
    return _sorted([*_files(directory, deployment, images), *_check(_machine(deployment, images, None))])


def refusal(reason: Exception, about: str) -> Finding:
    """Return the finding that a model cannot be built, or a deployment cannot be read."""
    return error(Check.CANNOT_BE_BUILT, about, str(reason).rstrip("."))


def _machine(deployment: Deployment, images: Sequence[Image], model: Model | None) -> CheckedMachine:
    machines = [image.machine for image in images]
    return CheckedMachine(
        deployment=deployment,
        board=machines[0],
        prior=np.hstack([machine.prior for machine in machines]),
        tables=tuple(
            np.hstack(tables) for tables in zip(*(machine.tables for machine in machines), strict=True)
        ),
        model=model,
    )


def _check(machine: CheckedMachine) -> Iterator[Finding]:
    yield from code_findings(machine)
    yield from variable_findings(machine.deployment)
    yield from source_findings(machine.deployment)
    yield from generator_findings(machine)


def _files(directory: Path, deployment: Deployment, images: Sequence[Image]) -> Iterator[Finding]:
    """Find files of the hardware project that differ from the images."""
    words = {
        Change.NEW: "is not there",
        Change.CHANGED: "differs from the images and deployment.toml",
        Change.REMOVED: "is stale",
    }
    for part, files in (
        ("memories", memory_files(deployment, images)),
        ("project", quartus_files(deployment, images)),
    ):
        wrong = [
            (name, change)
            for name, change in compare_files(directory, files)
            if change is not Change.UNCHANGED
        ]
        if wrong:
            name, change = wrong[0]
            more = f", and {len(wrong) - 1} more files" if len(wrong) > 1 else ""
            yield warning(
                Check.FILES, name, f"{words[change]}{more}", f"use 'toolchain regenerate {part} {directory}'"
            )


def _sorted(findings: Iterable[Finding]) -> list[Finding]:
    order = list(Severity)
    return sorted(findings, key=lambda finding: order.index(finding.severity))
