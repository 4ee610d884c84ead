"""Edits of `deployment.toml` that leave the boards' images as they are."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ValidationError

from toolchain.building.options import refused_option
from toolchain.deployment import Deployment, Queue, Stop, Variable
from toolchain.deployment.deployment_hash import with_hash
from toolchain.errors import BuildError


@dataclass(frozen=True, slots=True, kw_only=True)
class DeploymentEdits:
    """Changes of `deployment.toml`; None leaves a key as it is."""

    uri: str | None = None
    """The rosbridge server with the readings."""
    topic: str | None = None
    """The topic with the readings."""
    type: str | None = None
    """That topic's type."""
    output: str | None = None
    """The topic for the posteriors."""
    order: tuple[str, ...] | None = None
    """All sensors' names in the order in which the columns are to read them."""
    paths: tuple[tuple[str, str], ...] = ()
    """The place of a variable in the message, by its name."""
    target_count: int | None = None
    """The count that stops a machine."""
    max_cycles: int | None = None
    """The cycles after which a machine stops anyway."""
    stop: Stop | None = None
    """Whether boards stop together."""
    queue: Queue | None = None
    """The treatment of frames that arrive too fast."""
    tolerance_s: float | None = None
    """The most seconds between readings of several topics that belong together."""


def edited(deployment: Deployment, edits: DeploymentEdits) -> Deployment:
    """Return the deployment with the edits, and its new hash; a BuildError if an edit is wrong."""
    target = _given(uri=edits.uri, topic=edits.topic, type=edits.type)
    if target and len(deployment.sources) > 1:
        raise BuildError(
            f"--{next(iter(target))}: this deployment has {len(deployment.sources)} sources; edit [[source]] in "
            f"{deployment.path}, then run 'toolchain regenerate deployment' without it"
        )
    first_source, *sources = deployment.sources
    first_output, *outputs = deployment.outputs
    machine = _given(target_count=edits.target_count, max_cycles=edits.max_cycles, stop=edits.stop)
    try:
        changed = deployment.replace(
            sources=(first_source.replace(**target), *sources),
            outputs=(first_output.replace(**_given(topic=edits.output)), *outputs),
            variables=_with_paths(_in_order(deployment.variables, edits.order), dict(edits.paths)),
            machine=deployment.machine.replace(**machine),
            **_given(queue=edits.queue, tolerance_s=edits.tolerance_s),
        )
    except ValidationError as reason:
        raise refused_option(reason) from None
    return with_hash(changed)


def _given(**values: object) -> dict[str, object]:
    return {key: value for key, value in values.items() if value is not None}


def _in_order(variables: tuple[Variable, ...], order: tuple[str, ...] | None) -> tuple[Variable, ...]:
    """Return the variables with the columns reading them in this order.

    A column keeps its table and its address rule; its name, source and path change.
    """
    if order is None:
        return variables
    columns = {variable.name: variable for variable in variables if variable.kind == "sensor"}
    if sorted(order) != sorted(columns):
        raise BuildError(
            f"--order {','.join(order)}: expected each of {', '.join(columns) or 'no sensors'} once, in the order of "
            "the columns"
        )
    readings = dict(zip(columns, (columns[name] for name in order), strict=True))
    return tuple(
        variable.replace(name=reading.name, source=reading.source, path=reading.path)
        if (reading := readings.get(variable.name))
        else variable
        for variable in variables
    )


def _with_paths(variables: tuple[Variable, ...], paths: dict[str, str]) -> tuple[Variable, ...]:
    names = [variable.name for variable in variables]
    for name, path in paths.items():
        if name not in names:
            raise BuildError(
                f"--path {name}={path}: there is no such variable; there are {', '.join(names) or 'none'}"
            )
    return tuple(variable.replace(path=paths.get(variable.name, variable.path)) for variable in variables)
