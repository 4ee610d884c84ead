"""The `toolchain check` command, which prints findings about a model or a deployment, one per line."""

import json as json_text
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from toolchain.commands.flags import BuildFlags
from toolchain.errors import BuildError, ToolchainError

if TYPE_CHECKING:
    from toolchain.building.machine import MachinePlan
    from toolchain.checks.finding import Finding


def check(
    context: typer.Context,
    path: Annotated[
        Path,
        typer.Argument(
            help="Folder with model.py, a network file, or the folder of a deployment.", metavar="MODEL|DIR"
        ),
    ],
    flags: BuildFlags,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")] = False,
) -> None:
    """Report mistakes before anything runs: in a model as it would be built, or in a deployment.

    For example `toolchain check casestudies/boat --partitions 4`, or `toolchain check build/boat`. The exit
    code is 2 if there is an error among the findings, otherwise 0.
    """
    from toolchain.checks.check import check_deployment
    from toolchain.checks.finding import Severity
    from toolchain.deployment import FILE_NAME
    from toolchain.models import case_study
    from toolchain.networks import is_network

    if is_network(path) or case_study.model_path(path).is_file():
        findings = _of_model(path, flags)
    elif not (path / FILE_NAME).is_file():
        raise BuildError(
            f"{path} contains neither a model ({case_study.FILE_NAME}) nor a deployment ({FILE_NAME}), and is not a "
            "network's file"
        )
    else:
        for flag in _model_flags(context):
            raise BuildError(f"{flag} is for a model; {path} is a deployment, which was built with its own")
        findings = check_deployment(path)
    for finding in findings:
        typer.echo(json_text.dumps(finding.as_dict()) if json else finding.sentence)
    counts = Counter(finding.severity for finding in findings)
    if not json:
        summary = ", ".join(
            f"{counts[severity]} {severity}{'' if counts[severity] == 1 else 's'}" for severity in Severity
        )
        typer.echo(f"{path}: {summary}", err=True)
    raise typer.Exit(ToolchainError.exit_code if counts[Severity.ERROR] else 0)


def _model_flags(context: typer.Context) -> list[str]:
    given = []
    for each in context.command.params:
        source = context.get_parameter_source(each.name or "")
        if source is not None and source.name == "COMMANDLINE" and each.name not in {"path", "json"}:
            given.append(max(each.opts, key=len))
    return given


def _of_model(path: Path, flags: BuildFlags) -> "list[Finding]":
    from toolchain.checks.check import check_model, refusal
    from toolchain.commands.request import build_options, fit_to_device, read_model, read_named

    # a check does not need a target, but the build options require one
    options = build_options(
        flags, uri="ws://127.0.0.1:9090", topic="/readings", message_type="std_msgs/Float64MultiArray"
    )
    try:
        options = read_named(options, flags)
        model = read_model(path, flags, flags.bits)
    except ToolchainError as reason:
        return [refusal(reason, "the model")]

    def fitted(plan: "MachinePlan") -> "MachinePlan":
        plan, why = fit_to_device(plan, flags.device)
        if why:
            typer.echo(why, err=True)
        return plan

    return check_model(model, options, fitted)
