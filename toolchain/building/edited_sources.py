"""Building of images (programming files) from edited sources of a deployment (thesis 3.2, 3.4).

The sources are MIFs and `bm1_parameters.vhd`. To find contradictions between edited sources, the toolchain writes the
sources again from the new images. An edit is accepted only if these sources equal the edited sources.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from machines.errors import MachineError
from machines.parameters import RngReset
from pcie_shim.errors import PcieShimError
from pcie_shim.programming_file import Image
from toolchain.building.build import check_agreement, read_images
from toolchain.building.machine import MACHINE_KEYS
from toolchain.deployment import FILE_NAME, Deployment, deployment_text, load_deployment
from toolchain.deployment.deployment import other_image, with_hash
from toolchain.errors import BuildError, counted
from toolchain.outputs.memories import MEMORIES_FOLDER, Memory, memories, unpacked_codes
from toolchain.outputs.mif import read_mif
from toolchain.outputs.output_files import (
    Change,
    image_files,
    memory_files,
    quartus_files,
    text_file,
    write_files,
)
from toolchain.outputs.vhdl_parameters import PARAMETERS_FILE, PackageTokens, parameters_vhd


def _number(text: str) -> int:
    return int(text[2:-1], 16) if text.startswith('x"') else int(text)


_PARAMETERS: Final[dict[str, tuple[str, Callable[[str], Any]]]] = {
    "COUNTER_BITS": ("counter_bits", _number),
    "STEPS_PER_CLOCK": ("steps_per_clock", _number),
    "RNG_RESET_BANK": ("rng_reset", {"true": RngReset.BANK, "false": RngReset.FREE}.__getitem__),
    "TARGET_COUNT": ("target_count", _number),
    "MAX_CYCLES": ("max_cycles", _number),
}
"""The constants of `bm1_parameters.vhd` that may be edited; for each, its key in `[machine]` and its parser.

The other constants are sizes of memories and boards, and the kind of generators, on which the seeds depend.
"""
_SHOWN: Final = 3
"""Maximum number of changed codes that are listed for a memory."""


def regenerate_images(directory: Path) -> tuple[list[str], list[tuple[str, Change]]]:
    """Write the images again from a deployment's edited files of memories and parameters.

    Return the edits as sentences, and the changed files. The edited files are rewritten in canonical form, and
    `deployment.toml` gets the new hashes and parameters. An interrupted call may leave new images before
    `deployment.toml` has their hashes. The next call accepts such images and completes the work.

    Raises:
        BuildError: The edited files contradict each other, contain an invalid value, or change a constant or a seed
            that only a new build can change.
        MifError: A memory's file does not fit this machine.
        DeploymentError: The deployment is missing or damaged.
    """
    deployment = load_deployment(directory, interrupted=True)
    deployment.new_filter()
    images = read_images(deployment)
    check_agreement(deployment, images, edited={key for key, _ in _PARAMETERS.values()})
    changed, new = deployment, images
    edits: list[str] = []
    if deployment.machine.type == "BM1":
        changed, new, edits = _with_parameters(directory, deployment, images)
    for memory in memories(changed, new):
        new, edit = _with_memory(directory / MEMORIES_FOLDER / memory.name, memory, new)
        edits += edit
    boards = []
    for board, old, image in zip(changed.boards, images, new, strict=True):
        # a BM1's package has the model's hash, as images[0] has; no source of a BM2 says which values are possible
        same_model = changed.machine.type == "BM1" and old.model_hash == images[0].model_hash
        if not same_model and old.image_hash not in {board.image_hash, image.image_hash}:
            raise other_image(changed.directory / board.image, old.image_hash, board.image_hash)
        built = board.built_hash or board.image_hash
        edited = image.image_hash != built
        boards.append(board.replace(image_hash=image.image_hash, built_hash=built if edited else None))
    changed = with_hash(changed.replace(boards=tuple(boards)))
    parts = [image_files(changed, new), memory_files(changed, new), quartus_files(changed, new)]
    if changed != deployment:  # last, so that a partially written folder has the old hashes
        parts.append(text_file(FILE_NAME, deployment_text(changed)))
    return edits, write_files(directory, *parts)


def _with_parameters(
    directory: Path, deployment: Deployment, images: Sequence[Image]
) -> tuple[Deployment, list[Image], list[str]]:
    """Return deployment and images with the VHDL package's parameters, and the edits of the package, as sentences."""
    found = PackageTokens.read(directory / PARAMETERS_FILE)
    built = PackageTokens.of(parameters_vhd(deployment, images))
    values: dict[str, Any] = {}
    edits = []
    for constant, (key, value) in _PARAMETERS.items():
        (old, _), (new, line) = built.value(constant), found.value(constant)
        if new != old:
            edits.append(f"{PARAMETERS_FILE}, line {line}: {constant} {old} -> {new}")
        try:  # also if the value was not edited: after an interruption, another board may still have an earlier one
            values[key] = value(new)
        except (ValueError, KeyError):
            what = f"{constant} is {new}, expected a value such as {old}"
            raise BuildError(what, path=found.name, line=line) from None
    own = {key: value for key, value in values.items() if key in MACHINE_KEYS}
    try:
        machines = [
            replace(image.machine, parameters=replace(image.machine.parameters, **own)) for image in images
        ]
        same = {key: getattr(machines[0].parameters, key) for key in own}
        machine = deployment.machine.replace(**values | same)
        changed = deployment.replace(machine=machine)
        new_images = [replace(image, machine=each) for image, each in zip(images, machines, strict=True)]
    except ValidationError as reason:
        detail = reason.errors()[0]
        what = detail["msg"].removeprefix("Value error, ")
        for constant, (key, _) in _PARAMETERS.items():
            if key in detail["loc"]:
                new, line = found.value(constant)
                what = f"{constant} is {new}, expected {what.removeprefix('Input should be ')}"
                raise BuildError(what, path=found.name, line=line) from None
        raise BuildError(what, path=found.name) from None
    except (MachineError, PcieShimError) as reason:
        raise BuildError(str(reason), path=found.name) from None
    found.check_same(PackageTokens.of(parameters_vhd(changed, new_images)))
    return changed, new_images, edits


def _with_memory(path: Path, memory: Memory, images: Sequence[Image]) -> tuple[list[Image], list[str]]:
    """Return the images with the codes of a memory's file, and a sentence for each image that this changes."""
    words = read_mif(path, (memory.width, memory.depth)).words
    if not memory.section:
        for address, (seed, due) in enumerate(zip(words, memory.words(), strict=True)):
            if seed != due:
                raise BuildError(
                    f"address {address:#x} has {seed:#x}, expected {due:#x}: seeds follow from the generators of the build; "
                    "set it back, or undo all edits with 'toolchain regenerate memories'",
                    path=path,
                )
        return list(images), []
    bits = images[0].machine.parameters.prob_bits
    found = unpacked_codes(words, bits, memory.width // bits)
    new, edits = list(images), []
    for board, image in enumerate(images):
        if memory.board not in {None, board}:
            continue
        before = dict(image.kind.sections(image.machine))[memory.section]
        if before.size != found.size:  # of a build whose table of random numbers is longer or shorter
            raise BuildError(
                f"the image of board {board} has {before.size} of these, not {found.size}", path=path
            )
        old = before.reshape(found.shape) & (1 << bits) - 1
        if (found == old).all():
            continue
        # where a code has not changed, the image keeps the bits above it: random numbers may have more than the MIF
        codes = np.where(found == old, before.reshape(found.shape), found).astype(before.dtype)
        new[board] = _with_section(path, image, memory.section, codes.reshape(before.shape))
        edits.append(_sentence(path, old, found, image.partition.line_offset))
    return new, edits[:1]


def _with_section(path: Path, image: Image, section: str, codes: NDArray[Any]) -> Image:
    sections = dict(image.kind.sections(image.machine)) | {section: codes}
    try:
        return replace(image, machine=image.kind.machine(image.machine.parameters, sections))
    except MachineError as reason:
        raise BuildError(str(reason).rstrip("."), path=path) from None


def _sentence(path: Path, old: NDArray[Any], new: NDArray[Any], offset: int) -> str:
    """Return a sentence: how many codes of a memory have changed, and the old and new values of the first ones."""
    places = np.argwhere(old != new)
    shown = []
    for address, line in places[:_SHOWN].tolist():
        where = f"address {address:#x}" + (
            f" of the model's line {offset + line}" if old.shape[1] > 1 else ""
        )
        shown.append(f"{where}: {old[address, line]:#x} -> {new[address, line]:#x}")
    more = f"; and {len(places) - _SHOWN} more" if len(places) > _SHOWN else ""
    return f"{MEMORIES_FOLDER}/{path.name}: {counted(len(places), 'code')}: {'; '.join(shown)}{more}"
