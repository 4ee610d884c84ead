"""The deployment: all that follows from the model, in one file that the services read (thesis 3.3, 3.4).

`deployment.toml` lies in a folder of its own with the boards' images. Its hash covers everything that follows
from the model and nothing that says where things run (URIs and endpoints), so pointing it at another robot
leaves it valid, and editing what the tables were made from does not.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from contextlib import suppress
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from machines.parameters import (
    COUNTER_BITS_MAX,
    CYCLES_MAX,
    REPLICAS_MAX,
    PriorMode,
    RngKind,
    RngReset,
    SensorMode,
)
from toolchain.deployment.fields import (
    Choice,
    MessagePath,
    MessageType,
    Name,
    PathOrName,
    Sequence,
    Sha256,
    States,
    Step,
    Topic,
    WebSocketUri,
    names_differ,
    states_fit,
    websocket_uri,
)
from toolchain.deployment.toml_file import parse_toml, read_text, validate
from toolchain.errors import DamagedDeploymentError, DeploymentError, DeploymentVersionError

if TYPE_CHECKING:
    from collections.abc import Iterable

FORMAT: Final = 1
FILE_NAME: Final = "deployment.toml"
REPLICA: Final = "replica"
"""Label of the dimension of replicas, the first of what is published."""

_HEADER = """\
# Written by `toolchain build`. URIs and endpoints may be changed here; the rest belongs to the boards' images
# and is guarded by the hash: change the model and build again.
"""

_INTERFACE = re.compile(r"([1-9]\d{0,4})x([1-9]\d{0,5})")


class Stop(StrEnum):
    """When the boards of a partitioned machine stop."""

    SLICES = "slices"
    """All at the end of the slice in which the first one overflows."""
    OWN = "own"
    """Each at its own overflow, as in the thesis."""


class Queue(StrEnum):
    """What happens to frames that come faster than they are computed."""

    LATEST = "latest"
    """The newest wins; what was passed over is counted."""
    ALL = "all"
    """All are computed, in order."""


class _Section(BaseModel):
    """Strict and frozen: 8 is an integer and "8" isn't, and a key nobody knows is a mistake."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_by_name=True
    )


class Source(_Section):
    """`[[source]]`: a topic on a rosbridge server from which readings come."""

    uri: WebSocketUri
    topic: Topic
    type: MessageType
    compression: Literal["none", "cbor"] = Field(default="none", exclude_if=lambda way: way == "none")


class Variable(_Section):
    """`[[variable]]`: a known variable, and how its readings become addresses.

    Of kind `sensor` it is a column of the machine; of kind `prior_select` it chooses the row of the prior's table
    (thesis 2.1.2), whose top row is the prior without it: what a missing reading chooses.
    """

    name: Name
    source: int = Field(default=0, ge=0)
    path: PathOrName = ""
    kind: Literal["sensor", "prior_select"] = "sensor"
    bits: int = Field(ge=1, le=16)
    offset: float = 0.0
    step: Step = 1.0
    period: int | None = Field(default=None, ge=1)
    values: int = Field(ge=1)
    on_range: Literal["error", "clamp", "missing"] = "error"
    on_missing: Literal["error", "missing"] = "error"
    states: States = ()

    @model_validator(mode="after")
    def _addresses_fit(self) -> Self:
        if self.values > 2**self.bits - 1:
            bits = "1 bit holds" if self.bits == 1 else f"{self.bits} bits hold"
            raise ValueError(
                f"{self.name} serves {self.values} values, but {bits} {2**self.bits - 1} "
                "beside the address of a missing reading"
            )
        states_fit(self.name, self.states, self.values)
        return self


class Dimension(_Section):
    """`[[searched]]`: one searched variable, a dimension of the grid of lines; the first is the slowest."""

    label: Name
    size: int = Field(ge=1)
    offset: float = 0.0
    step: Step = 1.0
    states: States = ()

    @model_validator(mode="after")
    def _every_cell_has_a_name(self) -> Self:
        states_fit(self.label, self.states, self.size)
        return self

    def value(self, index: float) -> float:
        """Return the variable's value at an index: a cell's centre where the index is whole."""
        return self.offset + index * self.step


class MachineSection(_Section):
    """`[machine]`: the BM1's parameters, the registers it is reached through, and when it stops."""

    type: Literal["BM1"] = "BM1"
    lines: int = Field(ge=1)
    interface: str = "20x1200"
    prob_bits: int = Field(default=8, ge=1, le=16)
    scale: Literal["address", "column", "none"] = Field(
        default="address", exclude_if=lambda scale: scale == "address"
    )
    prior_bits: int = Field(default=0, ge=0, le=16)
    prior_mode: Choice[PriorMode] = PriorMode.TABLE
    counter_bits: int = Field(default=8, ge=1, le=32)
    rng: Choice[RngKind] = RngKind.LFSR32
    rng_banks: int = Field(default=16, ge=1)
    rng_reset: Choice[RngReset] = RngReset.BANK
    shared: bool = True
    steps_per_clock: int = Field(default=8, ge=1)
    target_count: int = Field(default=255, ge=1)
    max_cycles: int = Field(default=2**17, ge=1, le=CYCLES_MAX)
    stop: Choice[Stop] = Stop.SLICES
    sensor_mode: Choice[SensorMode] = Field(
        default=SensorMode.COLUMN, exclude_if=lambda mode: mode == SensorMode.COLUMN
    )
    replicas: int = Field(default=1, ge=1, le=REPLICAS_MAX, exclude_if=lambda replicas: replicas == 1)

    @field_validator("interface")
    @classmethod
    def _inputs_by_results(cls, text: str) -> str:
        parse_interface(text)
        return text

    @model_validator(mode="after")
    def _target_fits(self) -> Self:
        if self.target_count > 2**self.counter_bits - 1:
            message = (
                f"target_count = {self.target_count} does not fit counters of {self.counter_bits} bits; "
                f"expected 1 to {2**self.counter_bits - 1}"
            )
            if (enough := self.target_count.bit_length()) <= COUNTER_BITS_MAX:
                message += f", or counters of {enough} bits (--counter-bits {enough})"
            raise ValueError(message)
        return self

    @property
    def is_plain(self) -> bool:
        """Whether it is one machine with one reading a column: readings are numbers, and a result is one posterior."""
        return self.replicas == 1 and self.sensor_mode is SensorMode.COLUMN

    @property
    def results(self) -> int:
        """Probabilities of a frame: one a line, for every replica."""
        return self.replicas * self.lines

    @property
    def interface_sensors(self) -> int:
        """Inputs that the boards' registers have room for."""
        return parse_interface(self.interface)[0]

    @property
    def interface_results(self) -> int:
        """Results that the boards' registers have room for."""
        return parse_interface(self.interface)[1]


class WrittenPrior(_Section):
    """`[prior]`: where a written prior comes from: one number for each line, of which ratios count.

    Without this section a machine with `prior_mode = written` keeps the prior of its images until a host writes
    another.
    """

    source: int = Field(default=0, ge=0)
    path: MessagePath
    on_missing: Literal["error", "model"] = "error"


class Board(_Section):
    """`[[board]]`: one board of the mini-cluster, its image and its lines of the machine."""

    image: str
    image_hash: Sha256
    line_offset: int = Field(ge=0)
    lines: int = Field(ge=1)
    endpoint: str = ""

    @field_validator("image")
    @classmethod
    def _inside(cls, image: str) -> str:
        path = PurePosixPath(image)
        if path.is_absolute() or ".." in path.parts or not path.name:
            raise ValueError(f"{image!r} must be a path inside the deployment's folder")
        return image


class Output(_Section):
    """`[[output]]`: a topic on which posteriors go out; an empty URI is that of the first source."""

    topic: Topic = "/BMresults"
    type: Literal["std_msgs/Float64MultiArray"] = "std_msgs/Float64MultiArray"
    uri: str = ""

    @field_validator("uri")
    @classmethod
    def _uri_or_nothing(cls, uri: str) -> str:
        return websocket_uri(uri) if uri else uri


class DeploymentFile(_Section):
    """What `deployment.toml` says, checked as a whole."""

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
                f"a searched variable is called {REPLICA!r}, which is what the dimension of replicas is called"
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
                "[prior] says where a written prior comes from, but the machine's is a table (prior_mode)"
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
        """The variables that are columns of the machine, in the columns' order."""
        return tuple(variable for variable in self.variables if variable.kind == "sensor")

    @property
    def prior_select(self) -> Variable | None:
        """The variable that selects the prior, or None where the prior is one row."""
        return next((variable for variable in self.variables if variable.kind == "prior_select"), None)

    def machine_addresses(self, addresses: Iterable[int | None]) -> tuple[tuple[int | None, ...], int]:
        """Return the sensors' addresses in the columns' order, and the row of the prior's table.

        Args:
            addresses: One per variable, in the order of `variables`; None for a missing reading.

        Raises:
            ValueError: Another number of addresses than variables.
        """
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
        """The dimensions of what is published: the searched ones, and before them the replicas where there are several."""
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
        """Where its `deployment.toml` is."""
        return self.directory / FILE_NAME

    def image_path(self, board: int) -> Path:
        """Return where a board's image is."""
        return self.directory / self.boards[board].image

    def output_uri(self, output: Output) -> str:
        """Return the rosbridge server on which an output is published."""
        return output.uri or self.sources[0].uri


def parse_interface(text: str) -> tuple[int, int]:
    """Return inputs and results of an interface such as `20x1200` (thesis 3.2).

    Raises:
        ValueError: Not two numbers from 1 with an `x` between.
    """
    match = _INTERFACE.fullmatch(text)
    if not match:
        raise ValueError(f"{text!r} is no interface; expected inputs x results, such as '20x1200'")
    return int(match[1]), int(match[2])


def deployment_hash(deployment: DeploymentFile) -> str:
    """Return the SHA-256 (hexadecimal) of all that follows from the model: all but URIs, endpoints and compression."""
    content = deployment.model_dump(
        mode="json",
        exclude={
            "hash": True,
            "sources": {"__all__": {"uri", "compression"}},
            "boards": {"__all__": {"endpoint"}},
            "outputs": {"__all__": {"uri"}},
        },
    )
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def load_deployment(directory: Path, *, images: bool = True, edited: bool = False) -> Deployment:
    """Read and check a deployment.

    Args:
        directory: The folder that `toolchain build` wrote.
        images: Whether to read the boards' images too and compare their hashes; a process that drives no
            boards may leave it out, and starts without NumPy.
        edited: Whether `deployment.toml` may have been edited, so that its hash is not that of what it says.

    Raises:
        DeploymentError: Not there, not TOML, a wrong key or value (file, line, nearest right name).
        DeploymentVersionError: Another format.
        DamagedDeploymentError: `deployment.toml` or an image is not what was built; says which file and
            which hash.
    """
    directory = Path(directory)
    path = directory / FILE_NAME
    if directory.is_file():
        raise DeploymentError(
            f"{directory} is a file; give the folder that 'toolchain build' wrote, here perhaps {directory.parent}"
        )
    if not path.is_file():
        raise DeploymentError(
            f"{directory} holds no deployment: {path} is not there; make one with 'toolchain build'"
        )
    text = read_text(path, DeploymentError)
    tables = parse_toml(text, path, DeploymentError)
    version = tables.get("format")
    if version != FORMAT or isinstance(version, bool):
        found = "has no key 'format'" if version is None else f"is of format {version!r}"
        raise DeploymentVersionError(
            f"{path} {found}, and this version reads format {FORMAT}: build it again with 'toolchain build'"
        )
    file = validate(DeploymentFile, tables, text, path, DeploymentError)
    computed = deployment_hash(file)
    if computed != file.hash and not edited:
        raise DamagedDeploymentError(
            f"{path} is not as it was built: its hash is {computed[:16]}, "
            f"it says {file.hash[:16] or 'nothing'}; only URIs, endpoints and compression may be edited: "
            "build it again with 'toolchain build', or keep the edit with 'toolchain regenerate deployment'"
        )
    deployment = Deployment(**dict(file), directory=directory)
    if images:
        _check_images(deployment)
    return deployment


def write_deployment(directory: Path, deployment: DeploymentFile) -> Deployment:
    """Write `deployment.toml` with its hash, whole or not at all, and return what was written.

    Raises:
        DeploymentError: The folder can't be written.
    """
    directory = Path(directory)
    fields = dict(deployment) | {"hash": deployment_hash(deployment), "directory": directory}
    written = Deployment(**fields)
    partial = directory / (FILE_NAME + ".part")
    try:
        partial.write_text(deployment_text(written), encoding="utf-8")
        partial.replace(written.path)
    except OSError as reason:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise DeploymentError(f"{written.path} can't be written: {reason.strerror or reason}") from None
    return written


def deployment_text(deployment: DeploymentFile) -> str:
    """Return the text of `deployment.toml`: the same deployment gives the same bytes."""
    content: dict[str, Any] = deployment.model_dump(mode="json", exclude_none=True)
    aliases = {name: field.validation_alias for name, field in type(deployment).model_fields.items()}
    plain = {key: value for key, value in content.items() if not isinstance(value, list | dict)}
    parts = [_HEADER + tomli_w.dumps(plain)]
    for key, value in content.items():
        heading = str(aliases[key] or key)
        if isinstance(value, dict):
            parts.append(f"[{heading}]\n" + tomli_w.dumps(value))
        elif isinstance(value, list):
            parts.extend(f"[[{heading}]]\n" + tomli_w.dumps(item) for item in value)
    return "\n".join(parts)


def _check_images(deployment: Deployment) -> None:
    # Here, not above: a subscriber loads a deployment without NumPy.
    from pcie_shim.errors import DamagedImageError, PcieShimError
    from pcie_shim.programming_file import read_image

    for index, board in enumerate(deployment.boards):
        path = deployment.image_path(index)
        if not path.is_file():
            raise DamagedDeploymentError(
                f"{path}, the image of board {index}, is not there: build it again with 'toolchain build'"
            )
        try:
            image = read_image(path)
        except DamagedImageError as reason:
            raise DamagedDeploymentError(str(reason)) from reason
        except PcieShimError as reason:
            raise DeploymentError(str(reason)) from reason
        if image.image_hash != board.image_hash:
            raise DamagedDeploymentError(
                f"{path} is another board's or another build's image: its hash is {image.image_hash[:16]}, "
                f"{deployment.path} says {board.image_hash[:16]}"
            )
