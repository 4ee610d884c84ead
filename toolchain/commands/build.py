"""What `toolchain build` does: a model from a folder or a network's file, then a deployment of it."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import typer

from machines.errors import MachineError
from machines.parameters import ADDRESS_BITS_MAX, RngKind
from toolchain.analysis.resources import boards_needed, device_named
from toolchain.build import (
    DEFAULT_INTERFACE,
    REPORT_NAME,
    build_date,
    build_deployment,
    check_options,
    machine_parameters,
)
from toolchain.deployment import parse_interface
from toolchain.errors import BuildError
from toolchain.models.case_study import load_model, model_path
from toolchain.networks import is_network, read_network
from toolchain.outputs.rng_table import read_table
from toolchain.settings import key_values
from toolchain.sources import read_sources

if TYPE_CHECKING:
    from pathlib import Path

    from toolchain.models.model import Model
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Unread:
    """What of a model and its machine is still as the user wrote it.

    Attributes:
        settings: `KEY=VALUE` each, for the model's parameters.
        bits: `NAME=BITS` each.
        interface: `20x1200`.
        rng_table: A MIF of random numbers.
        sources: A file that says which variable comes from which topic.
        device: What a board has; then as many boards are taken as the lines need.
    """

    settings: tuple[str, ...] = ()
    bits: tuple[str, ...] = ()
    interface: str | None = None
    rng_table: Path | None = None
    sources: Path | None = None
    device: str | None = None


def run_build(
    path: Path, directory: Path, question: NetworkQuestion, options: BuildOptions, unread: Unread
) -> None:
    """Build a deployment, telling on stderr what is done and on stdout what was built.

    Raises:
        ToolchainError: Anything that is wrong with the model or the options.
    """
    options = with_sources(options, unread.sources)
    check_options(options)
    options = read_options(options, unread)
    typer.echo(f"Reading {model_file(path)}", err=True)
    model = read_model(path, question, unread)
    options, why = on_device(options, model, unread.device)
    typer.echo(f"Quantising {model.name} and writing its images", err=True)
    dated = replace(options, build_date=build_date(model_file(path)))
    built = build_deployment(model, directory, dated, remark=why)
    typer.echo(built.report, nl=False)
    typer.echo(f"Wrote {built.deployment.path} and {directory / REPORT_NAME}", err=True)


def on_device(options: BuildOptions, model: Model, name: str | None) -> tuple[BuildOptions, str]:
    """Return the options with as many boards as a device's size asks for, or more that were asked for, and why.

    Raises:
        BuildError: No such device, no such machine, or one of which not even a line fits.
    """
    if name is None:
        return options, ""
    device = device_named(name)
    try:
        parameters = machine_parameters(model, options)
    except MachineError as reason:
        raise BuildError(str(reason)) from None
    count, why = boards_needed(parameters, device, interface=options.interface or DEFAULT_INTERFACE)
    if options.partitions > count:
        why += f" --partitions {options.partitions} asks for more."
    return replace(options, partitions=max(count, options.partitions)), why


def with_sources(options: BuildOptions, path: Path | None) -> BuildOptions:
    """Return the options with the file that says which variable comes from which topic, where there is one.

    Raises:
        BuildError: A mistake in the file, flags that say the same, or neither the file nor all flags.
    """
    said = {"--uri": options.uri, "--topic": options.topic, "--type": options.type}
    if path is None:
        missing = [flag for flag, value in said.items() if not value]
        if missing:
            message = (
                f"{missing[0]} is missing: say where readings come from, with --uri, --topic and --type, or with "
                "--sources FILE where they come from several topics"
            )
            raise BuildError(message)
        return options
    for flag, value in (*said.items(), ("--prior-path", options.prior_path)):
        if value and flag != "--uri":
            message = (
                f"{flag} {value}: the file of --sources says that for each of its topics; leave it out here"
            )
            raise BuildError(message)
    return replace(options, sources=read_sources(path, options.uri or None))


def read_options(options: BuildOptions, unread: Unread) -> BuildOptions:
    """Return the options with the interface and the random numbers that a user named.

    Raises:
        BuildError: No interface, or random numbers for generators that play none.
        MifError: The file of random numbers can't be read.
    """
    if unread.interface is not None:
        try:
            options = replace(options, interface=parse_interface(unread.interface))
        except ValueError as reason:
            message = f"--interface: {reason}"
            raise BuildError(message) from None
    if unread.rng_table is not None:
        if options.rng is not RngKind.TABLE:
            message = f"--rng-table is what --rng table plays, but this is --rng {options.rng}"
            raise BuildError(message)
        options = replace(options, rng_table=read_table(unread.rng_table))
    return options


def model_file(path: Path) -> Path:
    """Return the file that a model is read from: a network's own, or a folder's `model.py`."""
    return path if is_network(path) else model_path(path)


def read_model(path: Path, question: NetworkQuestion, unread: Unread) -> Model:
    """Return a user's model, its columns as wide as asked for.

    Raises:
        ModelError: The model has a mistake, or a column can't be so wide.
        BuildError: Flags that don't fit the model.
    """
    values = key_values(unread.settings)
    model = network_model(path, question, values) if is_network(path) else _case_model(path, question, values)
    return _with_bits(model, key_values(unread.bits, "--bits", "range=8"))


def _with_bits(model: Model, bits: dict[str, str]) -> Model:
    names = [variable.name for variable in model.variables]
    widths: dict[str, int] = {}
    for name, text in bits.items():
        if name not in names:
            message = (
                f"--bits {name}={text}: the model has no such variable; it has {', '.join(names) or 'none'}"
            )
            raise BuildError(message)
        if not re.fullmatch(r"\d{1,3}", text, re.ASCII) or not 1 <= int(text) <= ADDRESS_BITS_MAX:
            message = f"--bits {name}={text}: expected 1 to {ADDRESS_BITS_MAX} bits"
            raise BuildError(message)
        widths[name] = int(text)
    select = model.prior_select
    return replace(
        model,
        known=tuple(replace(known, bits=widths.get(known.name, known.bits)) for known in model.known),
        prior_select=None if select is None else replace(select, bits=widths.get(select.name, select.bits)),
    )


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
        names_in("--searched", question.searched),
        names_in("--known", question.known),
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


def names_in(flag: str, text: str) -> list[str]:
    """Return the names in `A,B,C`.

    Raises:
        BuildError: An empty one.
    """
    names = [name.strip() for name in text.split(",")] if text else []
    if not all(names):
        message = f"{flag} {text}: expected names with a comma between them, such as {flag} A,B"
        raise BuildError(message)
    return names
