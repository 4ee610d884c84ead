"""What `toolchain build` does: a model from a folder or a network's file, then a deployment of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import typer

from machines.errors import MachineError
from machines.parameters import RngKind
from toolchain.analysis.boards_needed import boards_needed
from toolchain.analysis.device import device_named
from toolchain.board_interface import DEFAULT_INTERFACE
from toolchain.build import build_date, build_deployment, check_options, machine_parameters
from toolchain.commands.named_model import model_file, read_model
from toolchain.deployment import parse_interface
from toolchain.deployment.sources import read_sources
from toolchain.errors import BuildError
from toolchain.outputs.rng_table import LENGTH, read_table
from toolchain.report import REPORT_NAME

if TYPE_CHECKING:
    from pathlib import Path

    from toolchain.commands.named_model import NetworkQuestion, Unread
    from toolchain.models.model import Model
    from toolchain.options import BuildOptions


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
    count, why = boards_needed(
        parameters,
        device,
        interface=options.interface or DEFAULT_INTERFACE,
        table_length=LENGTH if options.rng_table is None else options.rng_table.size,
    )
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
