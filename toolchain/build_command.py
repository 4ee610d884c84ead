"""What `toolchain build` does: a model from a folder or a network's file, then a deployment of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import typer

from toolchain.build import REPORT_NAME, build_date, build_deployment, check_options
from toolchain.case_study import FILE_NAME, load_model
from toolchain.deployment import parse_interface
from toolchain.errors import BuildError
from toolchain.networks import is_network, read_network
from toolchain.settings import key_values

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from toolchain.model import Model
    from toolchain.options import BuildOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkQuestion:
    """A question to a network as a user writes it.

    Attributes:
        searched: Names with commas between them.
        known: Names with commas between them.
        given: `NAME=STATE` each.
        prior_select: A name, or nothing.
        on_missing: What an absent reading is.
    """

    searched: str = ""
    known: str = ""
    given: tuple[str, ...] = ()
    prior_select: str = ""
    on_missing: Literal["error", "missing"] = "error"

    @property
    def flags(self) -> list[str]:
        """The flags that were given."""
        said = {
            "--searched": self.searched,
            "--known": self.known,
            "--given": self.given,
            "--prior-select": self.prior_select,
            "--on-missing": self.on_missing != "error",
        }
        return [flag for flag, value in said.items() if value]


def run_build(
    path: Path,
    directory: Path,
    settings: Sequence[str],
    question: NetworkQuestion,
    options: BuildOptions,
    interface: str | None,
) -> None:
    """Build a deployment, telling on stderr what is done and on stdout what was built.

    Raises:
        ToolchainError: Anything that is wrong with the model or the options.
    """
    check_options(options)
    if interface is not None:
        try:
            options = replace(options, interface=parse_interface(interface))
        except ValueError as reason:
            message = f"--interface: {reason}"
            raise BuildError(message) from None
    values = key_values(settings)
    file = path if is_network(path) else path / FILE_NAME
    typer.echo(f"Reading {file}", err=True)
    model = network_model(path, question, values) if is_network(path) else _case_model(path, question, values)
    typer.echo(f"Quantising {model.name} and writing its images", err=True)
    built = build_deployment(model, directory, replace(options, build_date=build_date(file)))
    typer.echo(built.report, nl=False)
    typer.echo(f"Wrote {built.deployment.path} and {directory / REPORT_NAME}", err=True)


def network_model(path: Path, question: NetworkQuestion, settings: dict[str, str]) -> Model:
    """Return the model that answers a question to a network's file.

    Raises:
        ModelError: The file is no network, or the question has no form that a BM1 computes.
        BuildError: No question, or one that can't be read.
    """
    if settings:
        message = f"--set {next(iter(settings))}: a network's file has no parameters; --given NAME=STATE fixes a variable"
        raise BuildError(message)
    if not question.searched:
        message = f"{path} is a network: say what is searched and known, such as --searched A --known B,C"
        raise BuildError(message)
    joint = read_network(path, on_missing=question.on_missing)
    return joint.ask(
        _names("--searched", question.searched),
        _names("--known", question.known),
        given=key_values(question.given, "--given", "smoke=yes"),
        prior_select=question.prior_select or None,
    ).model()


def _case_model(path: Path, question: NetworkQuestion, settings: dict[str, str]) -> Model:
    if question.flags:
        message = (
            f"{question.flags[0]} asks a network's file, but {path} is none; model.py asks its own question"
        )
        raise BuildError(message)
    return load_model(path, settings)


def _names(flag: str, text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")] if text else []
    if not all(names):
        message = f"{flag} {text}: expected names with a comma between them, such as {flag} A,B"
        raise BuildError(message)
    return names
