"""Checks of a model or a deployment before anything runs. Findings use the model's names (thesis 3.4).

A model is checked with its build options, and a deployment with the codes of its images. Findings about codes are
exact. If a reading is found impossible, a frame with this reading ends as `impossible` on the machine. If a line is
found dead, the line never counts.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from machines.bm2 import BM2Machine
from pcie_shim.errors import PcieShimError
from pcie_shim.programming_file import Image
from toolchain.analysis.emulation import joined
from toolchain.analysis.lost_frames import lost_frames
from toolchain.building.bm2_machine import plan_bm2
from toolchain.building.build import assemble, check_agreement, read_images
from toolchain.building.machine import MachinePlan, partition_lines, plan_machine
from toolchain.building.options import BuildOptions
from toolchain.checks.chain_findings import CheckedChain, chain_findings
from toolchain.checks.findings import (
    Check,
    CheckedMachine,
    Finding,
    Severity,
    code_findings,
    error,
    loss_findings,
    note,
    warning,
)
from toolchain.checks.generators import generator_findings
from toolchain.deployment import Deployment, Variable, load_deployment
from toolchain.errors import ToolchainError, counted
from toolchain.models.distribution import NO, NUMBER, YES
from toolchain.models.model import Model
from toolchain.models.network import NetworkModel
from toolchain.outputs.output_files import Change, compare_files, memory_files, quartus_files


def check_model(
    model: Model | NetworkModel,
    options: BuildOptions,
    fit: Callable[[MachinePlan], MachinePlan] = lambda plan: plan,
) -> list[Finding]:
    """Return the findings about a model and its machine, the worst first.

    `fit` takes the plan of a BM1 and returns a plan with as many boards as the machine needs.
    """
    refused: list[Finding] = []
    try:  # apart from the plan, so that mistakes in both are found at once
        if isinstance(model, Model):
            partition_lines(model.lines, options.partitions)
    except ToolchainError as reason:
        refused.append(refusal(reason, "the partitions"))
    try:
        plan = plan_machine(model, options) if isinstance(model, Model) else plan_bm2(model, options)
        if refused:
            return refused
        plan = fit(plan) if isinstance(plan, MachinePlan) else plan
        built = assemble(plan)
    except ToolchainError as reason:
        return [*refused, refusal(reason, "the machine")]
    losses: list[Finding] = []
    if built.quantised is not None and isinstance(plan, MachinePlan):
        lost = lost_frames(plan, built.quantised)
        if lost.advice:
            losses.append(warning(Check.LOST_FRAMES, "the machine", lost.what, lost.advice))
        losses += loss_findings(built.quantised, options)
    return _sorted([*_check(built.deployment, built.images, model), *losses])


def check_deployment(directory: Path) -> list[Finding]:
    """Return the findings about a deployment's files and about the machine in its images, the worst finding first."""
    try:
        deployment = load_deployment(directory)
        images = read_images(deployment)
        check_agreement(deployment, images)
    except (ToolchainError, PcieShimError) as reason:
        return [refusal(reason, "the deployment")]
    findings = [*_files(directory, deployment, images), *_check(deployment, images, None)]
    if deployment.edited_boards:
        boards = ", ".join(f"board {board}" for board in deployment.edited_boards)
        what = "the image was made from memories or parameters that were edited since the build, so it may not be the model's"
        advice = "'toolchain regenerate memories --model' returns to the model's codes; undo edits of parameters by hand, then "
        findings.append(note(Check.EDITED, boards, what, advice + "use 'toolchain regenerate images'"))
    return _sorted(findings)


def refusal(reason: Exception, about: str) -> Finding:
    """Return the finding that `about` cannot be built or read. `about` names a part of a model or a deployment."""
    return error(Check.CANNOT_BE_BUILT, about, str(reason).rstrip("."))


def _check(
    deployment: Deployment, images: Sequence[Image], model: Model | NetworkModel | None
) -> Iterator[Finding]:
    machines, machine = [image.machine for image in images], None
    if isinstance(machines[0], BM2Machine):
        network = model if isinstance(model, NetworkModel) else None
        yield from chain_findings(CheckedChain(deployment, machines[0], network))
    else:
        whole, fusion = joined(machines), model if isinstance(model, Model) else None
        machine = CheckedMachine(deployment, machines[0], whole.prior, whole.tables, fusion)
        yield from code_findings(machine)
    yield from _same_readings(deployment)
    yield from _ranges(deployment)
    for variable in deployment.variables:
        yield from state_findings(variable)
    yield from source_findings(deployment)
    if machine is not None:
        yield from generator_findings(machine)


def _files(directory: Path, deployment: Deployment, images: Sequence[Image]) -> Iterator[Finding]:
    """Find files of the hardware project that differ from what the images and `deployment.toml` give."""
    words = {
        Change.NEW: "is not there",
        Change.CHANGED: "differs from the images and deployment.toml",
        Change.REMOVED: "is stale",
    }
    for part, files in (
        ("memories", memory_files(deployment, images)),
        ("project", quartus_files(deployment, images)),
    ):
        wrong = [each for each in compare_files(directory, files) if each[1] is not Change.UNCHANGED]
        if wrong:
            name, change = wrong[0]
            more = f", and {counted(len(wrong) - 1, 'more file')}" if len(wrong) > 1 else ""
            keep = f"to keep an edit, use 'toolchain regenerate images {directory}'; to undo it, "
            advice = f"use 'toolchain regenerate {part} {directory}'"
            advice = keep + advice if part == "memories" else advice
            yield warning(Check.FILES, name, f"{words[change]}{more}", advice)


def _sorted(findings: Iterable[Finding]) -> list[Finding]:
    order = list(Severity)
    return sorted(findings, key=lambda finding: order.index(finding.severity))


def _same_readings(deployment: Deployment) -> Iterator[Finding]:
    """Find variables that read the same path in messages of the same topic."""
    readers: dict[tuple[int, str], list[str]] = {}
    for variable in deployment.variables:
        # A path that is a bare name finds the same field as a variable of that name without a path.
        readers.setdefault((variable.source, variable.path or variable.name), []).append(variable.name)
    for (_, path), names in readers.items():
        if len(names) > 1:
            advice = "give each its own path, in the model or with --path"
            yield warning(Check.SAME_READING, " and ".join(names), f"they all have the path {path}", advice)


def _ranges(deployment: Deployment) -> Iterator[Finding]:
    """Find variables whose addresses, wrapping or `on_range` do not suit their values."""
    for variable in deployment.variables:
        needed = variable.values.bit_length()
        if needed < variable.bits:
            what = (
                f"its {variable.values} values and the missing reading fit {needed} address bits, but it has "
            )
            what += f"{variable.bits}: its memory is {2 ** (variable.bits - needed)} times as deep as needed"
            yield note(Check.ADDRESS_BITS, variable.name, what, f"use --bits {variable.name}={needed}")
        if variable.period is not None and variable.period != variable.values:
            end = variable.offset + variable.values * variable.step
            what = f"but only {variable.values} are served: those from {end:g} on are out of range"
            if variable.period < variable.values:
                what = f"so that the last {variable.values - variable.period} of its {variable.values} values never occur"
            what = f"its readings wrap around after {variable.period} steps, {what}"
            advice = f"give it {variable.period} values, or a period of {variable.values}"
            yield warning(Check.RANGE, variable.name, what, advice)
        if variable.on_range == "missing" and variable.on_missing == "error":
            what = "a reading out of range is a missing one (on_range), and a missing one is an error (on_missing)"
            advice = 'use on_missing="missing", or on_range="clamp" or "error"'
            yield warning(Check.RANGE, variable.name, what, advice)


def state_findings(variable: Variable) -> Iterator[Finding]:
    """Warn if a number or a bool, sent as a reading, probably selects another state than the sender means."""
    states, shown = variable.states, ", ".join(variable.states[:_MOST_NAMES])
    for at, name in enumerate(states):
        number = variable.offset + at * variable.step
        if NUMBER.fullmatch(name) and abs(float(name) - number) > 1e-6 * abs(variable.step):
            what = f"a reading of {number:g} as a number selects the state '{name}' ({shown}), since numbers are in equal steps"
            advice = "publish names as strings, or give the states other names"
            yield warning(Check.STATES, variable.name, what, advice)
            break
    one = math.floor((1 - variable.offset) / variable.step + 0.5)  # the address of 1, and of true
    chosen = states[one].lower() if 0 <= one < len(states) else ""
    unclear = len(states) == 2 and one == 1 and chosen not in YES and not NUMBER.fullmatch(chosen)
    if chosen in NO or unclear:
        what = f"a reading of true selects the state '{chosen}' ({shown}), whose number is 1"
        finding, advice = (
            warning if chosen in NO else note,
            "publish names as strings if a bool means the other one",
        )
        yield finding(Check.STATES, variable.name, what, advice)


_MOST_NAMES: Final = 6

_WITHOUT_HEADER: Final = frozenset(
    f"geometry_msgs/{name}"
    for name in (
        "Accel", "Point", "Point32", "Polygon", "Pose", "Pose2D", "PoseWithCovariance", "Quaternion", "Transform",
        "Twist", "TwistWithCovariance", "Vector3", "Wrench",
    )
)  # fmt: skip
"""Types of geometry_msgs without a header. Types of std_msgs are not listed, because none of them has a header."""
_LEAST_TOLERANCE_S: Final = 0.005
"""Minimum tolerance, in seconds, with which messages sent together can be paired by their times of receipt."""


def source_findings(deployment: Deployment) -> Iterator[Finding]:
    """Find problems with the pairing of messages that have no header, if the deployment has several topics.

    Messages without a header are paired by the time of receipt, and all other messages by their stamps. A tolerance
    that is too small for times of receipt causes a warning. With a sufficient tolerance, there is a note if only some
    topics lack a header, because the clocks of robot (stamps) and host (receipt) may differ.
    """
    if len(deployment.sources) < 2:
        return
    bare = [source.topic for source in deployment.sources if not _may_have_header(source.type)]
    if not bare:
        return
    topics = " and ".join(bare)
    about = f"messages on {topics} have no header, so they are paired by time of receipt"
    if deployment.tolerance_s < _LEAST_TOLERANCE_S:
        what = f"{about}; with a tolerance of {deployment.tolerance_s:g} s they rarely form a frame"
        advice = "build with a --tolerance of at least the network's delay, or publish types with a header"
        yield warning(Check.PAIRING, topics, what, advice)
    elif len(bare) < len(deployment.sources):
        what = f"{about}, and the other topics by the robot's clock"
        advice = "synchronise both clocks to well within the tolerance (NTP, chrony), or publish types with a header"
        yield note(Check.PAIRING, topics, what, advice)


def _may_have_header(type_name: str) -> bool:
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    return package != "std_msgs" and f"{package}/{name}" not in _WITHOUT_HEADER
