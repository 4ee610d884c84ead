"""Programming files, which the toolchain builds from a model and the loader sends to a board (thesis 3.4).

A file has a fixed header, a manifest, and a section for each table of the machine. The manifest is readable JSON
(`head -c 4000 board0.bm`). The header contains the SHA-256 of the manifest, and the manifest the SHA-256 of every
section. An error therefore names the damaged part. Equal images have equal bytes.

`image_hash` identifies the computation: parameters, tables, partition, interface, model and register map. It does not
cover the build date and the version of the tools.
"""

import hashlib
import json
import math
import struct
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Final, Generic, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from machines import KINDS, kind_of
from machines.errors import MachineError
from machines.kind import MachineKind, UsedRegisters
from pcie_shim import register_map
from pcie_shim.errors import DamagedImageError, ImageError, ImageMismatchError
from pcie_shim.register_layout import interface_room

MAGIC: Final = b"BMIMAGE\x01"
"""First bytes of a programming file. The last of these bytes is the version of the file format."""

MAX_IMAGE_BYTES: Final = 1 << 30
"""Maximum size of a programming file in bytes."""

_HEADER: Final = struct.Struct("<8sII32s")  # magic, length of the manifest, zero, SHA-256 of the manifest

_Word: TypeAlias = Annotated[int, Field(ge=0, lt=2**32)]  # pydantic checks it when a file is read


@dataclass(frozen=True)
class Partition:
    """The part of a model on one board: a block of lines.

    Attributes:
        index: Number of the board, from 0.
        count: Number of boards.
        line_offset: First line of the model on the board.
        total_lines: Number of lines of the model, on all boards together.
    """

    index: _Word
    count: _Word
    line_offset: _Word
    total_lines: _Word


@dataclass(frozen=True, eq=False)
class Image:
    """The content of the programming file of one board.

    Attributes:
        machine: The board's machine, of any kind, with the board's lines.
        partition: Position of the board's lines in the model.
        interface_sensors: Number of input words that the board implements (thesis 3.2: 20).
        interface_results: Number of result words that the board implements (thesis 3.2: 1200).
        model_hash: SHA-256 (hex) of the model. All boards of a deployment have an identical hash.
        build_date: Date of the build, ISO 8601.

    Raises:
        ImageError: The machine does not fit the interface, the interface does not fit the register map, or the
            partition does not match the lines.
    """

    machine: Any
    partition: Partition
    interface_sensors: int
    interface_results: int
    model_hash: str
    build_date: str
    tool_version: str

    def __post_init__(self) -> None:
        """Check that a board can hold the image."""
        registers, part = self.registers, self.partition
        lines, words = registers.lines, interface_room(registers)
        inputs, results = registers.input_words, registers.result_words
        if not (0 < self.interface_sensors <= words[0] and 0 < self.interface_results <= words[1]):
            raise ImageError(
                f"The interface {self.interface_sensors}x{self.interface_results} does not fit the register "
                f"map, which has room for 1x1 to {words[0]}x{words[1]}"
            )
        if inputs > words[0] or results > words[1]:
            raise ImageError(
                f"The machine has {registers.size}; the register map has room for {words[0]}x{words[1]}: "
                "use more partitions" + (", or fewer replicas" if registers.replicas > 1 else "")
            )
        if inputs > self.interface_sensors or results > self.interface_results:
            raise ImageError(
                f"The machine has {registers.size}; the interface "
                f"{self.interface_sensors}x{self.interface_results} is smaller: use --interface "
                f"{max(inputs, self.interface_sensors)}x{max(results, self.interface_results)}, "
                "or more partitions"
            )
        if not (0 <= part.index < part.count < 1 << 16 and 0 <= part.line_offset <= part.total_lines - lines):
            raise ImageError(
                f"Part {part.index} of {part.count} cannot hold {lines} lines from line {part.line_offset} "
                f"on: the model has {part.total_lines}"
            )
        if registers.part not in {None, (part.index, part.count)}:
            raise ImageError(
                f"The machine is part (number, of) {registers.part}, the image {part.index, part.count}"
            )

    @cached_property
    def kind(self) -> MachineKind:
        """The kind of the machine."""
        return kind_of(self.machine.parameters)

    @cached_property
    def registers(self) -> UsedRegisters:
        """The registers that a board with the image uses."""
        return self.kind.registers(self.machine.parameters)

    @property
    def map_hash(self) -> str:
        """SHA-256 (hex) of this software's register map. The image is built for this register map."""
        return register_map.MAP_SHA256

    @cached_property
    def image_hash(self) -> str:
        """SHA-256 (hex) of everything that determines what the board computes. The build date is not included."""
        return _manifest(self, self.kind.sections(self.machine)).image_hash


class _Checked(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


# SHA-256 in hex, or the name of a kind: bounded, because errors quote them
_Quoted: TypeAlias = Annotated[str, Field(max_length=64)]


class _Interface(_Checked):
    sensors: _Word
    results: _Word


class _Section(_Checked):
    name: str
    dtype: str
    shape: tuple[_Word, ...]
    sha256: _Quoted


_Parameters = TypeVar("_Parameters")


class _Identity(_Checked, Generic[_Parameters]):
    """The data from which the image hash is computed."""

    machine: str
    parameters: _Parameters
    partition: Partition
    interface: _Interface
    model_hash: _Quoted
    map_hash: _Quoted
    sections: tuple[_Section, ...]

    @property
    def hash(self) -> str:
        return hashlib.sha256(_canonical(self.model_dump(mode="json"))).hexdigest()


class _Manifest(_Checked, Generic[_Parameters]):
    emulated: bool
    tool_version: str
    build_date: str
    image_hash: _Quoted
    identity: _Identity[_Parameters]


class _Named(BaseModel):
    """The only field of `_Identity` that is read at first: the name of the kind of machine."""

    machine: _Quoted


class _Kind(BaseModel):
    """The part of a `_Manifest` that is read first, to learn the kind of machine."""

    identity: _Named


def tool_version() -> str:
    """Return the installed version of this software, for `Image.tool_version`."""
    return version("rosbayes")


def image_bytes(image: Image) -> bytes:
    """Return the bytes of the programming file for an image. Equal images give equal bytes."""
    sections = image.kind.sections(image.machine)
    manifest = _canonical(_manifest(image, sections).model_dump(mode="json"))
    header = _HEADER.pack(MAGIC, len(manifest), 0, hashlib.sha256(manifest).digest())
    return b"".join([header, manifest, *(array.tobytes() for _, array in sections)])


def read_image(path: Path) -> Image:
    """Return the image in a programming file, and check all hashes.

    Raises:
        ImageError: The file cannot be read.
        DamagedImageError: A hash is wrong.
        ImageMismatchError: The file is for another register map or format.
    """
    return image_from_bytes(read_bytes(path), str(path))


def read_bytes(path: Path) -> bytes:
    """Return the first `MAX_IMAGE_BYTES` + 1 bytes of a file, or raise an ImageError if the file cannot be read."""
    try:
        with path.open("rb") as file:
            # one byte more than allowed, to detect a file that is too large
            return file.read(MAX_IMAGE_BYTES + 1)
    except OSError as error:
        raise ImageError(f"{path} cannot be read: {error.strerror}") from error


def image_from_bytes(content: bytes, name: str = "the image") -> Image:
    """Decode the image in the bytes of a programming file, and check all hashes. Errors call the file `name`.

    Raises:
        DamagedImageError: A hash is wrong.
        ImageMismatchError: The file is for another register map or format.
    """
    kind, manifest, data_start = _read_manifest(content, name)
    if manifest.identity.map_hash != register_map.MAP_SHA256:
        raise ImageMismatchError(
            f"{name} was built for register map {manifest.identity.map_hash}, this software has "
            f"{register_map.MAP_SHA256}: build the deployment again"
        )
    # before the image hash, so that an error names the damaged table
    sections = _read_sections(content, name, kind, manifest, data_start)
    if manifest.identity.hash != manifest.image_hash:
        raise DamagedImageError(
            f"{name} is damaged: the image hash is {manifest.identity.hash}, its manifest says "
            f"{manifest.image_hash}; build the deployment again"
        )
    interface = manifest.identity.interface
    try:
        return Image(
            machine=kind.machine(manifest.identity.parameters, sections),
            partition=manifest.identity.partition,
            interface_sensors=interface.sensors,
            interface_results=interface.results,
            model_hash=manifest.identity.model_hash,
            build_date=manifest.build_date,
            tool_version=manifest.tool_version,
        )
    except MachineError as error:
        raise ImageMismatchError(f"{name} contains a machine that cannot be built: {error}") from error


def _read_manifest(content: bytes, name: str) -> tuple[MachineKind, _Manifest[Any], int]:
    """Return the kind of machine, the manifest, and the offset of the first section."""
    if len(content) > MAX_IMAGE_BYTES:
        raise ImageMismatchError(
            f"{name} is larger than {MAX_IMAGE_BYTES} bytes: it is not a programming file"
        )
    if len(content) < _HEADER.size or content[:7] != MAGIC[:7]:
        raise DamagedImageError(
            f"{name} is not a programming file: it does not start with {MAGIC[:7].decode()}"
        )
    magic, length, _, digest = _HEADER.unpack_from(content)
    if magic != MAGIC:
        raise ImageMismatchError(
            f"{name} has format {magic[7]}, this software reads format {MAGIC[7]}: build the deployment again"
        )
    # nothing of the manifest is used before its hash was compared
    start = _HEADER.size + length
    text = content[_HEADER.size : start]
    _check_hash(name, "its manifest", text, digest.hex(), "its header")
    try:
        named = _Kind.model_validate_json(text).identity.machine
        if named not in KINDS:
            raise ImageMismatchError(
                f"{name} is for a machine of kind {named!r}, and this software has {', '.join(KINDS)}: build the "
                "deployment again"
            )
        kind = KINDS[named]()
        # a generic model of the kind's parameters: `parameters` is a type that is known at run time
        return kind, _Manifest[kind.parameters].model_validate_json(text), start  # type: ignore[name-defined]
    except (ValidationError, MachineError) as error:
        first = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise ImageMismatchError(f"{name} has a manifest that this software cannot read: {first}") from error


def _read_sections(
    content: bytes, name: str, kind: MachineKind, manifest: _Manifest[Any], start: int
) -> dict[str, npt.NDArray[Any]]:
    """Return the tables by name, after checking the sections against those that the parameters need."""
    sections: dict[str, npt.NDArray[Any]] = {}
    due = kind.due_sections(manifest.identity.parameters)
    for section in manifest.identity.sections:
        name_due, dtype, shape = next(due, ("no further section", "", ()))
        # -1 stands for a length that the parameters do not define
        fits = len(shape) == len(section.shape) and all(
            size in {-1, given} for size, given in zip(shape, section.shape, strict=True)
        )
        if (section.name, section.dtype) != (name_due, dtype) or not fits:
            raise ImageMismatchError(
                f"{name} is not an image of its parameters: they need {name_due} of {dtype}{list(shape)} next"
            )
        end = start + np.dtype(dtype).itemsize * math.prod(section.shape)
        data = content[start:end]
        _check_hash(name, f"section '{section.name}'", data, section.sha256, "its manifest")
        if end > len(content):
            raise DamagedImageError(f"{name} is damaged: it ends within section '{section.name}'")
        sections[section.name] = np.frombuffer(data, dtype).reshape(section.shape)
        start = end
    if (missing := next(due, None)) is not None:
        raise ImageMismatchError(f"{name} has no section '{missing[0]}', which its parameters need")
    if start != len(content):
        raise DamagedImageError(f"{name} is damaged: {len(content) - start} bytes follow the last section")
    return sections


def _check_hash(name: str, what: str, data: bytes, expected: str, source: str) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise DamagedImageError(
            f"{name} is damaged: the sha256 of {what} is {found}, {source} says {expected}; "
            "build the deployment again"
        )


def _manifest(image: Image, sections: list[tuple[str, npt.NDArray[Any]]]) -> _Manifest[Any]:
    # the date and the version are outside: they do not change what the board computes
    parameters = image.kind.parameters
    identity = _Identity[parameters](  # type: ignore[valid-type]
        machine=image.kind.name,
        parameters=image.machine.parameters,
        partition=image.partition,
        interface=_Interface(sensors=image.interface_sensors, results=image.interface_results),
        model_hash=image.model_hash,
        map_hash=image.map_hash,
        sections=tuple(
            _Section(
                name=name,
                dtype=array.dtype.str,
                shape=array.shape,
                sha256=hashlib.sha256(array.tobytes()).hexdigest(),
            )
            for name, array in sections
        ),
    )
    return _Manifest[parameters](  # type: ignore[valid-type]
        emulated=True,
        tool_version=image.tool_version,
        build_date=image.build_date,
        image_hash=identity.hash,
        identity=identity,
    )


def _canonical(value: object) -> bytes:
    """Return a value as readable JSON; equal values give equal bytes."""
    return json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False).encode() + b"\n"
