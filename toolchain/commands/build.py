"""The commands `toolchain build`, which builds a deployment, and `toolchain check`, which reports mistakes."""

import json as json_text
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from toolchain.building.options import TargetOptions
from toolchain.commands.request import (
    BuildFlags,
    ModelPath,
    build_options,
    fit_to_device,
    model_file,
    read_source,
)
from toolchain.errors import BuildError, ToolchainError, counted
from toolchain.networks import is_network

if TYPE_CHECKING:
    from toolchain.building.bm2_machine import BM2Plan
    from toolchain.building.machine import MachinePlan
    from toolchain.checks.findings import Finding

SourcesFlag: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--sources",
        help="Instead of topic and type: a TOML file with several topics on one or more servers.",
        metavar="FILE",
    ),
]


def build(
    model: ModelPath,
    directory: Annotated[
        Path, typer.Option("--output-dir", "-o", help="Folder of the deployment.", metavar="DIR")
    ],
    flags: BuildFlags,
    target: TargetOptions,
    sources: SourcesFlag = None,
) -> None:
    """Build a deployment: programming files, deployment.toml and a report. For a BM1, also write a hardware project.

    `toolchain build casestudies/boat -o build/boat --partitions 4 --uri ws://localhost:9090
    --topic /boat/sensors --type boat_msgs/Sensors`

    For a network file:

    `toolchain build asia.bif --searched bronc --known smoke,dysp -o build/asia --uri ws://localhost:9090
    --topic /patient --type clinic_msgs/Patient`
    """
    from toolchain.analysis.lost_frames import lost_frames
    from toolchain.building.bm2_machine import plan_bm2
    from toolchain.building.build import REPORT_NAME, Built, build_date, build_deployment, known_variables
    from toolchain.building.choice import model_for
    from toolchain.building.machine import MachinePlan, plan_machine
    from toolchain.models.network import NetworkModel

    file = model_file(model)
    options = build_options(flags, target, sources)
    typer.echo(f"Reading {file}", err=True)
    source = read_source(model, flags)
    dated = replace(options, build_date=build_date(file))
    chosen, reason = model_for(source, dated, flags.bits or (), flags.device)
    plan: MachinePlan | BM2Plan
    if isinstance(chosen, NetworkModel):
        plan, why = plan_bm2(chosen, dated, reason), ""
    else:
        plan, why = fit_to_device(plan_machine(chosen, dated), flags.device)
    known_variables(plan)  # refuses --order and --path before it says that it builds
    typer.echo(f"Building a {plan.kind}, since {plan.why}", err=True)
    typer.echo(f"Quantising {plan.model.name} and writing its images", err=True)

    def remarks(built: Built) -> list[str]:
        found = [why] if why else []
        if isinstance(plan, MachinePlan) and built.quantised is not None:
            lost = lost_frames(plan, built.quantised)
            found += [f"Warning: {lost.what}; {lost.advice}."] if lost.advice else []
        return found

    built = build_deployment(plan, directory, remarks=remarks)
    typer.echo(built.report, nl=False)
    typer.echo(f"Wrote {built.deployment.path} and {directory / REPORT_NAME}", err=True)


def check(
    context: typer.Context,
    checked: Annotated[
        Path,
        typer.Argument(
            help="Folder with model.py, a network file, or the folder of a deployment.", metavar="MODEL|DIR"
        ),
    ],
    flags: BuildFlags,
    target: TargetOptions,
    sources: SourcesFlag = None,
    directory: Annotated[
        Path | None,
        typer.Option("--output-dir", "-o", help="As for a build; nothing is written.", metavar="DIR"),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")] = False,
) -> None:
    """Report mistakes in a model, a network file or a deployment, before anything runs.

    For example `toolchain check casestudies/boat --partitions 4`, or `toolchain check build/boat`. The command accepts
    all options of `toolchain build`, but requires none. The exit code is 2 if it reports an error, otherwise 0.
    """
    del directory  # accepted, so that a `build` command becomes a check by changing only its first word
    from toolchain.checks.check import check_deployment
    from toolchain.checks.findings import Severity
    from toolchain.deployment import FILE_NAME, UNFINISHED
    from toolchain.models import case_study

    is_deployment = (checked / FILE_NAME).is_file() or (checked / UNFINISHED).is_file()
    if is_deployment and not (checked / case_study.FILE_NAME).is_file():
        for flag in _model_flags(context):
            raise BuildError(
                f"{flag} is for a model; {checked} is a deployment, which was built with its own"
            )
        findings = check_deployment(checked)
    elif is_network(checked) or case_study.model_path(checked).is_file():
        findings = _of_model(checked, flags, target, sources)
    else:
        found = "contains no model or deployment" if checked.exists() else "does not exist"
        raise BuildError(
            f"{checked} {found}; expected the folder of a model ({case_study.FILE_NAME}) or of a deployment "
            f"({FILE_NAME}), or a network's file"
        )
    for finding in findings:
        typer.echo(json_text.dumps(asdict(finding)) if json else finding.sentence)
    counts = Counter(finding.severity for finding in findings)
    if not json:
        summary = ", ".join(counted(counts[severity], severity) for severity in Severity)
        typer.echo(f"{checked}: {summary}", err=True)
    raise typer.Exit(ToolchainError.exit_code if counts[Severity.ERROR] else 0)


def _model_flags(context: typer.Context) -> list[str]:
    given = []
    for each in context.command.params:
        source = context.get_parameter_source(each.name or "")
        if source is not None and source.name == "COMMANDLINE" and each.name not in {"checked", "json"}:
            given.append(max(each.opts, key=len))
    return given


def _of_model(path: Path, flags: BuildFlags, target: TargetOptions, sources: Path | None) -> "list[Finding]":
    from toolchain.building.choice import model_for
    from toolchain.checks.check import check_model, refusal

    try:
        options = build_options(flags, target, sources, is_checked=True)
        model, _ = model_for(read_source(path, flags), options, flags.bits or (), flags.device)
    except ToolchainError as reason:
        return [refusal(reason, "the model")]

    def fitted(plan: "MachinePlan") -> "MachinePlan":
        plan, why = fit_to_device(plan, flags.device)
        if why:
            typer.echo(why, err=True)
        return plan

    return check_model(model, options, fitted)
