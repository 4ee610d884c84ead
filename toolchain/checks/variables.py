"""Findings about variables: readings used twice, and ranges that don't fit the addresses."""

from collections import Counter
from collections.abc import Iterator

from toolchain.checks.finding import Check, Finding, note, warning
from toolchain.deployment import Deployment


def variable_findings(deployment: Deployment) -> Iterator[Finding]:
    """Find variables with mistakes, and variables with the same path."""
    yield from _same_readings(deployment)
    yield from _ranges(deployment)


def _same_readings(deployment: Deployment) -> Iterator[Finding]:
    # A bare name as a path is searched for like the name itself.
    paths = Counter((variable.source, variable.path or variable.name) for variable in deployment.variables)
    for (source, path), count in paths.items():
        if count > 1:
            names = [
                variable.name
                for variable in deployment.variables
                if (variable.source, variable.path or variable.name) == (source, path)
            ]
            yield warning(
                Check.SAME_READING,
                " and ".join(names),
                f"they all have the path {path}",
                "give each its own path, in the model or with 'toolchain regenerate deployment --path'",
            )


def _ranges(deployment: Deployment) -> Iterator[Finding]:
    """Find ranges of readings that don't fit the addresses."""
    for variable in deployment.variables:
        needed = variable.values.bit_length()
        if needed < variable.bits:
            yield note(
                Check.ADDRESS_BITS,
                variable.name,
                (
                    f"its {variable.values} values and the missing reading fit {needed} address bits, but it has "
                    f"{variable.bits}: its memory is {2 ** (variable.bits - needed)} times as deep as needed"
                ),
                f"use --bits {variable.name}={needed}",
            )
        if variable.period is not None and variable.period > variable.values:
            yield warning(
                Check.RANGE,
                variable.name,
                (
                    f"its readings wrap around after {variable.period} steps, but only {variable.values} are served: those from "
                    f"{variable.offset + variable.values * variable.step:g} on are out of range"
                ),
                f"give it {variable.period} values, or a period of {variable.values}",
            )
        if variable.period is not None and variable.period < variable.values:
            yield warning(
                Check.RANGE,
                variable.name,
                (
                    f"its readings wrap around after {variable.period} steps, so that the last "
                    f"{variable.values - variable.period} of its {variable.values} values never occur"
                ),
                f"give it {variable.period} values, or a period of {variable.values}",
            )
        if variable.on_range == "missing" and variable.on_missing == "error":
            yield warning(
                Check.RANGE,
                variable.name,
                "a reading out of range is a missing one (on_range), and a missing one is an error (on_missing)",
                'use on_missing="missing", or on_range="clamp" or "error"',
            )
