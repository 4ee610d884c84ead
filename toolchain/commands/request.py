"""The model and the build options of a command line."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from machines.parameters import ADDRESS_BITS_MAX, RngKind
from toolchain.analysis.logic import device_named
from toolchain.analysis.resources import boards_needed
from toolchain.building.machine import MachinePlan
from toolchain.building.options import BuildOptions
from toolchain.deployment import parse_interface
from toolchain.errors import BuildError
from toolchain.flag_values import key_values, names_in
from toolchain.models.case_study import load_model, model_path
from toolchain.models.model import Model
from toolchain.networks import is_network, read_network
from toolchain.outputs.mif import LENGTH, read_table

if TYPE_CHECKING:
    from toolchain.building.options import SourcesFile
    from toolchain.commands.flags import BuildFlags, ModelFlags


def model_file(path: Path) -> Path:
    """Return the file of a model: the network file, or the `model.py` of a folder."""
    return path if is_network(path) else model_path(path)


def read_model(path: Path, flags: ModelFlags, bits: Iterable[str] | None = None) -> Model:
    """Return the model of a folder or network file; `bits` are `NAME=BITS`, the address bits of columns."""
    settings = key_values(flags.settings or ())
    model = (_network_model if is_network(path) else _case_model)(path, flags, settings)
    return _with_bits(model, key_values(bits or (), "--bits", "range=8"))


def build_options(
    flags: BuildFlags, *, uri: str, topic: str, message_type: str, sources: SourcesFile | None = None
) -> BuildOptions:
    """Return the options of a build, without the files named by flags."""
    common = {field.name for field in fields(BuildOptions)} & {field.name for field in fields(flags)}
    values = {name: getattr(flags, name) for name in common - {"interface", "rng_table"}}
    return BuildOptions(uri=uri, topic=topic, type=message_type, sources=sources, **values)


def read_named(options: BuildOptions, flags: BuildFlags) -> BuildOptions:
    """Return the options with the interface and the table of random numbers given by flags."""
    if flags.interface is not None:
        try:
            options = replace(options, interface=parse_interface(flags.interface))
        except ValueError as reason:
            raise BuildError(f"--interface: {reason}") from None
    if flags.rng_table is not None:
        if options.rng is not RngKind.TABLE:
            raise BuildError(f"--rng-table requires --rng table, but this is --rng {options.rng}")
        options = replace(options, rng_table=read_table(flags.rng_table))
    return options


def fit_to_device(plan: MachinePlan, name: str | None) -> tuple[MachinePlan, str]:
    """Return the plan with as many boards as the lines need on a device, and the reason as a sentence."""
    if name is None:
        return plan, ""
    options = plan.options
    count, why = boards_needed(
        plan.parameters,
        device_named(name),
        table_length=LENGTH if options.rng_table is None else options.rng_table.size,
    )
    if options.partitions > count:
        why += f" --partitions {options.partitions} asks for more."
    return replace(plan, options=replace(options, partitions=max(count, options.partitions))), why


def _with_bits(model: Model, bits: dict[str, str]) -> Model:
    names = [variable.name for variable in model.variables]
    widths: dict[str, int] = {}
    for name, text in bits.items():
        if name not in names:
            raise BuildError(
                f"--bits {name}={text}: the model has no such variable; it has {', '.join(names) or 'none'}"
            )
        if not re.fullmatch(r"\d{1,3}", text, re.ASCII) or not 1 <= int(text) <= ADDRESS_BITS_MAX:
            raise BuildError(f"--bits {name}={text}: expected 1 to {ADDRESS_BITS_MAX} bits")
        widths[name] = int(text)
    select = model.prior_select
    return replace(
        model,
        known=tuple(replace(known, bits=widths.get(known.name, known.bits)) for known in model.known),
        prior_select=None if select is None else replace(select, bits=widths.get(select.name, select.bits)),
    )


def _network_model(path: Path, flags: ModelFlags, settings: dict[str, str]) -> Model:
    """Return the model for the question to a network file."""
    if settings:
        raise BuildError(
            f"--set {next(iter(settings))}: a network file has no parameters; --given NAME=STATE fixes a variable"
        )
    if not flags.searched:
        raise BuildError(
            f"{path} is a network: give the searched and known variables, such as --searched A --known B,C"
        )
    return (
        read_network(path, on_missing=flags.on_missing.value)
        .ask(
            names_in("--searched", flags.searched),
            names_in("--known", flags.known),
            given=key_values(flags.given or (), "--given", "smoke=yes"),
            prior_select=flags.prior_select or None,
        )
        .model()
    )


def _case_model(path: Path, flags: ModelFlags, settings: dict[str, str]) -> Model:
    if flags.question:
        raise BuildError(
            f"{flags.question[0]} is for a network file, but {path} is not one; model.py contains its own question"
        )
    return load_model(path, settings)
