"""The deployment: everything that follows from the model, checked as a whole (thesis 3.3, 3.4)."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Literal, Self

from pydantic import Field, model_validator

from machines.parameters import PriorMode, SensorMode
from toolchain.deployment.fields import Choice, Name, Sequence, names_differ
from toolchain.deployment.sections import (
    Board,
    Dimension,
    MachineSection,
    Output,
    Queue,
    Section,
    Source,
    Variable,
    WrittenPrior,
)

FORMAT: Final = 1
FILE_NAME: Final = "deployment.toml"
REPLICA: Final = "replica"
"""Label of the dimension of replicas, the first dimension of a published result."""


class DeploymentFile(Section):
    """The content of `deployment.toml`, checked as a whole."""

    format: Literal[1] = FORMAT
    name: Name
    hash: str = ""
    queue: Choice[Queue] = Queue.LATEST
    tolerance_s: float = Field(default=0.05, ge=0, le=86_400)
    sources: Sequence[Source] = Field(validation_alias="source", min_length=1)
    variables: Sequence[Variable] = Field(default=(), validation_alias="variable")
    searched: Sequence[Dimension] = Field(min_length=1)
    machine: MachineSection
    prior: WrittenPrior | None = Field(default=None, exclude_if=lambda prior: prior is None)
    boards: Sequence[Board] = Field(validation_alias="board", min_length=1)
    outputs: Sequence[Output] = Field(default=(Output(),), validation_alias="output")

    @model_validator(mode="after")
    def _parts_agree(self) -> Self:
        names_differ("variable", [variable.name for variable in self.variables])
        names_differ("searched", [dimension.label for dimension in self.searched])
        names_differ("output", [output.topic for output in self.outputs])
        for variable in self.variables:
            if variable.source >= len(self.sources):
                raise ValueError(
                    f"variable {variable.name} reads source {variable.source}, but the last one is "
                    f"{len(self.sources) - 1}"
                )
        self._prior_agrees()
        cells = math.prod(dimension.size for dimension in self.searched)
        if cells != self.machine.lines:
            raise ValueError(
                f"the searched variables have {cells} cells, but the machine has {self.machine.lines} lines"
            )
        if self.machine.replicas > 1 and REPLICA in [dimension.label for dimension in self.searched]:
            raise ValueError(
                f"a searched variable is called {REPLICA!r}, which is the name of the dimension of replicas"
            )
        offset = 0
        for index, board in enumerate(self.boards):
            if board.line_offset != offset:
                raise ValueError(f"board {index} starts at line {board.line_offset}, expected {offset}")
            offset += board.lines
        if offset != self.machine.lines:
            raise ValueError(
                f"the boards have {offset} lines together, but the machine has {self.machine.lines}"
            )
        return self

    def _prior_agrees(self) -> None:
        selects = [variable for variable in self.variables if variable.kind == "prior_select"]
        if len(selects) > 1:
            raise ValueError(f"{selects[0].name} and {selects[1].name} both select the prior; one can")
        bits = selects[0].bits if selects else 0
        if bits != self.machine.prior_bits:
            who = f"{selects[0].name} selects it with {bits}" if selects else "no variable selects it"
            raise ValueError(f"the prior has {self.machine.prior_bits} address bits (prior_bits), but {who}")
        if self.prior is None:
            return
        if self.machine.prior_mode is not PriorMode.WRITTEN:
            raise ValueError(
                "[prior] is for a written prior, but the prior of the machine is a table (prior_mode)"
            )
        if self.prior.source >= len(self.sources):
            raise ValueError(
                f"the prior comes from source {self.prior.source}, but the last one is {len(self.sources) - 1}"
            )


class Deployment(DeploymentFile):
    """A deployment in its folder, ready for the services."""

    directory: Path = Field(default=Path(), exclude=True)

    @property
    def sensors(self) -> tuple[Variable, ...]:
        """The variables of the machine's columns, in order."""
        return tuple(variable for variable in self.variables if variable.kind == "sensor")

    @property
    def prior_select(self) -> Variable | None:
        """The variable that selects the prior, or None if the prior has one row."""
        return next((variable for variable in self.variables if variable.kind == "prior_select"), None)

    def machine_addresses(self, addresses: Iterable[int | None]) -> tuple[tuple[int | None, ...], int]:
        """Return the addresses of the sensors by column, and the row of the prior; None if missing."""
        sensors: list[int | None] = []
        row = 0
        for variable, address in zip(self.variables, addresses, strict=True):
            if variable.kind == "sensor":
                sensors.append(address)
            else:
                row = 2**variable.bits - 1 if address is None else address
        return tuple(sensors), row

    @property
    def result_dimensions(self) -> tuple[Dimension, ...]:
        """The dimensions of a published result: replicas if there are several, then the searched dimensions."""
        replicas = self.machine.replicas
        if replicas == 1:
            return tuple(self.searched)
        return (Dimension(label=REPLICA, size=replicas), *self.searched)

    def reading_shape(self, variable: Variable) -> tuple[int, ...]:
        """Shape of a variable's reading: () a number, (lines,), (replicas,), or (replicas, lines)."""
        machine = self.machine
        per_line = machine.sensor_mode is not SensorMode.COLUMN and variable.kind == "sensor"
        replicas = () if machine.replicas == 1 else (machine.replicas,)
        return (*replicas, machine.lines) if per_line else replicas

    @property
    def path(self) -> Path:
        """The path of `deployment.toml`."""
        return self.directory / FILE_NAME

    def image_path(self, board: int) -> Path:
        """Return the path of a board's image."""
        return self.directory / self.boards[board].image

    def output_uri(self, output: Output) -> str:
        """Return the rosbridge server on which an output is published."""
        return output.uri or self.sources[0].uri
