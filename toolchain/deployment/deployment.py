"""The deployment: all that services must know of a model and its machine, with checks, hash and file (thesis 3.3)."""

import hashlib
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import tomli_w
from pydantic import Field, model_validator

from machines.parameters import PriorMode
from toolchain.bounded_files import TomlFile
from toolchain.deployment.sections import (
    BoardSection,
    Choice,
    Dimension,
    FilterSection,
    MachineSection,
    ModelSection,
    Name,
    Output,
    Queue,
    Section,
    Sequence,
    Source,
    TopicsSection,
    Variable,
    WrittenPrior,
    names_differ,
)
from toolchain.errors import DamagedDeploymentError, DeploymentError, DeploymentVersionError

if TYPE_CHECKING:
    from toolchain.deployment.filter import Filter

FORMAT: Final = 1
FILE_NAME: Final = "deployment.toml"
UNFINISHED: Final = f"{FILE_NAME}.unfinished"
"""Name of a file that a folder has while a build writes the folder, and after a build that was interrupted."""
FORMER_KEYS: Final = frozenset({"integrity", "integrity_frames"})
"""Keys that earlier versions wrote. A file with such a key is refused, and the error tells the user to delete the key.

The hash never included these keys, so it stays valid after the deletion.
"""
MOST_TRANSITIONS: Final = 2**24
"""Maximum number of transitions of a filter, lines x lines (128 MiB as float64)."""
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
    hidden: Sequence[Dimension] = Field(default=(), exclude_if=lambda hidden: not hidden)
    machine: MachineSection
    prior: WrittenPrior | None = Field(default=None, exclude_if=lambda prior: prior is None)
    filter: FilterSection | None = Field(default=None, exclude_if=lambda section: section is None)
    boards: Sequence[BoardSection] = Field(validation_alias="board", min_length=1)
    model: ModelSection = Field(default=ModelSection(), exclude_if=lambda model: model == ModelSection())
    outputs: Sequence[Output] = Field(default=(Output(),), validation_alias="output")
    topics: TopicsSection = Field(
        default=TopicsSection(), exclude_if=lambda topics: topics == TopicsSection()
    )

    @model_validator(mode="after")
    def _parts_agree(self) -> Self:
        names_differ("variable", [variable.name for variable in self.variables])
        names_differ("searched", [dimension.label for dimension in self.searched])
        names_differ("hidden", [dimension.label for dimension in self.hidden])
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
        if not self.machine.is_divided and offset != len(self.boards):
            raise ValueError("every board of this machine has lines = 1: it runs a whole machine")
        if self.machine.is_divided and offset != self.machine.lines:
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
        machine, is_written = self.machine, self.machine.prior_mode is PriorMode.WRITTEN
        if self.filter is not None and not (is_written and machine.is_plain and self.prior is None):
            raise ValueError(
                "[filter] writes the prior of a single machine with one reading per variable (prior_mode = written), and is "
                "not used with [prior]"
            )
        if self.filter is not None and machine.lines**2 > MOST_TRANSITIONS:
            raise ValueError(
                f"[filter] has {machine.lines} x {machine.lines} transitions; the maximum is {MOST_TRANSITIONS}"
            )
        if self.prior is None:
            return
        if not is_written:
            raise ValueError(
                "[prior] is for a written prior, but the prior of the machine is a table (prior_mode)"
            )
        if self.prior.source >= len(self.sources):
            raise ValueError(
                f"the prior comes from source {self.prior.source}, but the last one is {len(self.sources) - 1}"
            )


class Deployment(DeploymentFile):
    """The content of `deployment.toml` and its folder, for the services."""

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
        """Split the addresses of all variables into the columns' addresses (None: missing) and the prior's row."""
        sensors: list[int | None] = []
        row = 0
        for variable, address in zip(self.variables, addresses, strict=True):
            if variable.kind == "sensor":
                sensors.append(address)
            else:
                row = 2**variable.bits - 1 if address is None else address
        return tuple(sensors), row

    @property
    def state_dimensions(self) -> tuple[Dimension, ...]:
        """The variables of a BM2's sampled state, in the order of the state's bits.

        If the deployment does not describe one of these variables, the result is ().
        """
        keys = {"offset", "step", "unit", "states"}
        known = (Dimension(label=v.name, size=v.values, **v.model_dump(include=keys)) for v in self.variables)
        described = {each.label: each for each in (*known, *self.searched, *self.hidden)}
        names = self.machine.variables
        return tuple(described[name] for name in names) if described.keys() >= set(names) else ()

    @property
    def result_dimensions(self) -> tuple[Dimension, ...]:
        """The dimensions of a published result. If there are several replicas, their dimension comes first."""
        replicas = self.machine.replicas
        if replicas == 1:
            return tuple(self.searched)
        return (Dimension(label=REPLICA, size=replicas), *self.searched)

    def reading_shape(self, variable: Variable) -> tuple[int, ...]:
        """Return the shape of a variable's reading: () for a number, (lines,), (replicas,) or (replicas, lines)."""
        machine = self.machine
        per_line = machine.reads_lines and variable.kind == "sensor"
        replicas = () if machine.replicas == 1 else (machine.replicas,)
        return (*replicas, machine.lines) if per_line else replicas

    @property
    def path(self) -> Path:
        """The path of `deployment.toml`."""
        return self.directory / FILE_NAME

    def image_path(self, board: int) -> Path:
        """Return the path of a board's image."""
        return self.directory / self.boards[board].image

    def new_filter(self) -> "Filter | None":
        """Load the filter from the file that the section `[filter]` names. Return None if there is no such section.

        Raises a DeploymentError if the file is unusable.
        """
        if self.filter is None:
            return None
        # here, because a subscriber loads a deployment without NumPy
        from toolchain.deployment.filter import Filter, Transition

        path, machine = self.directory / self.filter.file, self.machine
        return Filter(Transition.read(path, machine.lines, self.filter.hash), machine.prob_bits)

    @property
    def edited_boards(self) -> tuple[int, ...]:
        """Indices of the boards whose images come from hand-edited files (MIFs or parameters).

        These images may differ from the model.
        """
        return tuple(index for index, board in enumerate(self.boards) if board.built_hash)

    def output_uri(self, output: Output) -> str:
        """Return the URI of the rosbridge server on which an output is published."""
        return output.uri or self.sources[0].uri


def deployment_hash(deployment: DeploymentFile) -> str:
    """Return the SHA-256 (hexadecimal) of the part of a deployment that follows from the model.

    The hash leaves out URIs, endpoints, units of readings and similar keys, so that a user can edit these keys for
    another robot. Any edit that contradicts the tables in the images changes the hash.
    """
    content = deployment.model_dump(
        mode="json",
        exclude={
            "hash": True,
            "sources": {"__all__": {"uri", "compression", "topic_bytes"}},
            "variables": {"__all__": {"unit"}},
            "boards": {"__all__": {"endpoint"}},
            "outputs": {"__all__": {"uri"}},
            "topics": True,
            "model": True,
        },
    )
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def with_hash(deployment: Deployment) -> Deployment:
    """Return a copy of a deployment with the hash of its content."""
    return deployment.replace(hash=deployment_hash(deployment))


def load_deployment(
    directory: Path, *, images: bool = True, edited: bool = False, interrupted: bool = False
) -> Deployment:
    """Read and check the deployment in a folder written by `toolchain build`.

    Without `images`, the images are not read or compared with their hashes, and NumPy is not imported. With `edited`,
    `deployment.toml` may have a hash that does not match its content. With `interrupted`, images and the filter's file
    may differ from their hashes in `deployment.toml`. An interrupted command leaves such files, because it writes
    `deployment.toml` last.

    Raises:
        DeploymentError: The deployment is absent, not TOML, or has a wrong key or value.
        DeploymentVersionError: The deployment has another format.
        DamagedDeploymentError: `deployment.toml` or an image has changed since the build, or an image is absent.
            The error names the file, and both hashes if it has changed.
    """
    directory = Path(directory)
    path = directory / FILE_NAME
    if directory.is_file():
        raise DeploymentError(
            f"{directory} is a file; give the folder written by 'toolchain build', here perhaps {directory.parent}"
        )
    if not path.is_file():
        if (directory / UNFINISHED).exists():
            raise DeploymentError(
                f"the build of {directory} has not ended or was interrupted; repeat that 'toolchain build'"
            )
        raise DeploymentError(
            f"{directory} does not contain a deployment: {path} does not exist; create one with 'toolchain build'"
        )
    toml = TomlFile.read(path, DeploymentError)
    version = toml.tables.get("format")
    if version != FORMAT or isinstance(version, bool):
        found = "has no key 'format'" if version is None else f"is of format {version!r}"
        raise DeploymentVersionError(
            f"{path} {found}, and this version reads format {FORMAT}: build it again with 'toolchain build'"
        )
    for key in FORMER_KEYS & toml.tables.keys():
        raise toml.mistake(
            (key,), f"'{key}' belonged to a check of the boards that is gone; delete this line"
        )
    file = toml.validated(DeploymentFile)
    computed = deployment_hash(file)
    if computed != file.hash and not edited:
        raise DamagedDeploymentError(
            f"{path} is not as it was built: its hash is {computed[:16]}, "
            f"but it names {file.hash[:16] or 'none'}; only URIs, endpoints, compression, topic_bytes, units of variables and [topics] may be edited: "
            "build it again with 'toolchain build', or keep the edit with 'toolchain regenerate deployment'"
        )
    deployment = Deployment(**dict(file), directory=directory)
    if images:
        _check_images(deployment, interrupted)
        if not interrupted:
            deployment.new_filter()
    return deployment


def other_image(path: Path, found: str, named: str) -> DamagedDeploymentError:
    """Return the error for an image with the hash `found`, where `deployment.toml` has the hash `named`."""
    return DamagedDeploymentError(
        f"{path} is another board's or another build's image: its hash is {found[:16]}, {FILE_NAME} names {named[:16]}; "
        "if 'toolchain regenerate' was interrupted, run it again, otherwise build again with 'toolchain build'"
    )


def _check_images(deployment: Deployment, interrupted: bool) -> None:
    # Here, not above, because a subscriber loads a deployment without NumPy.
    from pcie_shim.errors import DamagedImageError, PcieShimError
    from pcie_shim.programming_file import read_image

    for index, board in enumerate(deployment.boards):
        path = deployment.image_path(index)
        if not path.is_file():
            raise DamagedDeploymentError(
                f"{path}, the image of board {index}, does not exist: build it again with 'toolchain build'"
            )
        try:
            image = read_image(path)
        except DamagedImageError as reason:
            raise DamagedDeploymentError(str(reason)) from reason
        except PcieShimError as reason:
            raise DeploymentError(str(reason)) from reason
        if image.image_hash != board.image_hash and not interrupted:
            raise other_image(path, image.image_hash, board.image_hash)


_TOML_HEADER: Final = """\
# Written by `toolchain build`. URIs and endpoints may be changed here; the rest belongs to the boards' images
# and is guarded by the hash: change the model and build again.
"""


def deployment_text(deployment: DeploymentFile) -> str:
    """Return the text of `deployment.toml`. Equal deployments give the same bytes."""
    content: dict[str, Any] = deployment.model_dump(mode="json", exclude_none=True)
    aliases = {name: field.validation_alias for name, field in type(deployment).model_fields.items()}
    plain = {key: value for key, value in content.items() if not isinstance(value, list | dict)}
    parts = [_TOML_HEADER + tomli_w.dumps(plain)]
    for key, value in content.items():
        heading = str(aliases[key] or key)
        if isinstance(value, dict):
            parts.append(f"[{heading}]\n" + tomli_w.dumps(value))
        elif isinstance(value, list):
            parts.extend(f"[[{heading}]]\n" + tomli_w.dumps(item) for item in value)
    return "\n".join(parts)
