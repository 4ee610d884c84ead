"""What `toolchain check` does: tells the findings about a model or a deployment, a line each."""

from __future__ import annotations

import json as json_text
from collections import Counter
from typing import TYPE_CHECKING, Final, TypedDict

import typer

from toolchain.checks.check import check_deployment, check_model, refusal
from toolchain.checks.finding import Finding, Severity
from toolchain.commands.build import on_device, read_options
from toolchain.commands.named_model import read_model
from toolchain.deployment import FILE_NAME
from toolchain.errors import BuildError, ToolchainError
from toolchain.models import case_study
from toolchain.networks import is_network

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from toolchain.commands.named_model import NetworkQuestion, Unread
    from toolchain.options import BuildOptions


class Target(TypedDict):
    """Where readings come from: a check says nothing of it, but a build must know."""

    uri: str
    topic: str
    type: str


UNTOLD_TARGET: Final[Target] = {
    "uri": "ws://127.0.0.1:9090",
    "topic": "/readings",
    "type": "std_msgs/Float64MultiArray",
}


def run_check(
    path: Path,
    question: NetworkQuestion,
    options: BuildOptions,
    unread: Unread,
    said: Sequence[str],
    *,
    json: bool,
) -> int:
    """Tell the findings on stdout, and return the command's exit code: 2 if there is an error, else 0.

    Args:
        path: A model or a deployment.
        question: To a network.
        options: What a model would be built with.
        unread: What of them is as the user wrote it.
        said: Names of the flags that were given; a deployment takes none.
        json: Whether findings are JSON objects.

    Raises:
        BuildError: There is neither a model nor a deployment, or flags that mean nothing to it.
    """
    findings = _findings(path, question, options, unread, said)
    for finding in findings:
        typer.echo(json_text.dumps(finding.as_dict()) if json else finding.sentence)
    counts = Counter(finding.severity for finding in findings)
    if not json:
        summary = ", ".join(
            f"{counts[severity]} {severity}{'' if counts[severity] == 1 else 's'}" for severity in Severity
        )
        typer.echo(f"{path}: {summary}", err=True)
    return ToolchainError.exit_code if counts[Severity.ERROR] else 0


def _findings(
    path: Path, question: NetworkQuestion, options: BuildOptions, unread: Unread, said: Sequence[str]
) -> list[Finding]:
    if not is_network(path) and not case_study.model_path(path).is_file():
        if not (path / FILE_NAME).is_file():
            message = (
                f"{path} holds neither a model ({case_study.FILE_NAME}) nor a deployment ({FILE_NAME}), and is no "
                "network's file"
            )
            raise BuildError(message)
        if said:
            message = f"--{said[0].replace('_', '-')} is for a model; {path} is a deployment, which was built with its own"
            raise BuildError(message)
        return check_deployment(path)
    try:
        options = read_options(options, unread)
        model = read_model(path, question, unread)
        options, why = on_device(options, model, unread.device)
    except ToolchainError as reason:
        return [refusal(reason, "the model")]
    if why:
        typer.echo(why, err=True)
    return check_model(model, options)
