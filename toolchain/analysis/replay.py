"""All frames of a recording through the machines of a deployment, as `master --loop --queue all` would compute them.

    recording ──rows──▶ addresses ──▶ Replay (a job: one piece per frame) ──▶ OUT.frames ──▶ OUT.npz or OUT.mcap

`OUT.frames` has a place for the record of each frame, behind a line that names everything on which the results depend. A run
that was killed goes on from it. `OUT` is written at the end, and has the same bytes whoever has computed the frames.
"""

import fcntl
import json
import math
import os
import shutil
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, TypeAlias
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from machines.kind import Blocks, BoardResult, FrameInput, FrameSettings
from machines.parameters import RngReset
from pcie_shim import register_map as rm
from pcie_shim.programming_file import Image
from toolchain.analysis.readings import MISSING
from toolchain.bounded_files import file_errors, whole_file
from toolchain.building.build import read_images
from toolchain.cluster import Run, Work, in_this_process, software
from toolchain.deployment import Deployment
from toolchain.deployment.address import to_address
from toolchain.errors import BuildError, ModelError, ReadingError
from toolchain.learning.recording import read_recording, reading_columns

_FORMAT: Final = 1
_TOPIC: Final = "/BMresults"

_Records: TypeAlias = "np.memmap[Any, np.dtype[np.void]]"


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """The frames of a recording.

    Attributes:
        addresses: int64[frames, variables], in the order of the deployment; `MISSING` for a missing reading.
        fits: bool[frames], whether a row has readings that the deployment takes; the others have no posterior.
        stamps: int64[frames], nanoseconds: of the messages of a bag, or else 0, 1, 2, ..., the numbers of the rows.
        why: What is wrong with the first row that does not fit; empty if all do.
    """

    addresses: NDArray[np.int64]
    fits: NDArray[np.bool_]
    stamps: NDArray[np.int64]
    why: str

    def __len__(self) -> int:
        return len(self.addresses)


def recorded_frames(
    path: Path, deployment: Deployment, given: Sequence[str], *, tolerance_s: float = 0.1
) -> Frames:
    """Return the frames of a recording for a deployment.

    `given` are NAME=COLUMN for variables whose column has another name (`reading_columns`).

    Raises:
        BuildError: The machine takes arrays, or a name in `given` is unknown.
        ModelError: The recording is missing or damaged, lacks a column, or no row fits.
    """
    if not deployment.machine.is_plain or deployment.prior is not None:
        raise BuildError(
            f"{deployment.directory} reads arrays of numbers (for each line or replica, or a prior), but the columns of a "
            "recording are numbers"
        )
    variables = deployment.variables
    columns = reading_columns([each.name for each in variables], given)
    unnamed = [each.name for each in variables if each.name not in columns and each.on_missing == "error"]
    if unnamed:
        raise BuildError(f"{', '.join(unnamed)}: no column; add --reading {unnamed[0]}=COLUMN")
    recording = read_recording(path, list(dict.fromkeys(columns.values())), tolerance_s=tolerance_s)
    addresses = np.full((recording.rows, len(variables)), MISSING, np.int64)
    fits, why = np.ones(recording.rows, bool), ""
    for row in range(recording.rows):
        try:
            for at, variable in enumerate(variables):
                value = recording.columns[columns[variable.name]][row] if variable.name in columns else None
                address = to_address(variable, value)
                addresses[row, at] = MISSING if address is None else address
        except ReadingError as error:
            addresses[row], fits[row] = MISSING, False
            why = why or f"row {row}: {error}"
    if not fits.any():
        raise ModelError(f"{path} has no row that fits this machine: {why or 'it has no rows'}")
    stamps = np.array(recording.stamps or range(recording.rows), np.int64)
    return Frames(addresses, fits, stamps, why)


class _Boards:
    """The boards of a deployment in this process: machines behind the registers that they use, and their host."""

    def __init__(self, deployment: Deployment, images: Sequence[Image]) -> None:
        self._deployment = deployment
        kind = deployment.machine.kind
        self._host = kind.on_host([image.machine for image in images])
        self._registers = [image.registers for image in images]
        # The register map of each board, and its machine, which reads and writes there.
        self._memories: list[dict[str, memoryview]] = []
        self._machines = []
        for image in images:
            whole = memoryview(bytearray(rm.BAR_SIZE))
            memory = {name: whole[block : block + 4 * block.words] for name, block in rm.BLOCKS.items()}
            for name, words in kind.contents(image.machine).items():
                memory[name][: len(words)] = words
            machine = kind.on_board(kind.kernel(image.machine), memory)
            machine.prepare()
            self._memories.append(memory)
            self._machines.append(machine)

    def run(
        self, addresses: Sequence[int | None], bank: int, prior: NDArray[np.uint16] | None
    ) -> list[BoardResult]:
        """Compute a frame; the results are those of a board's registers."""
        section = self._deployment.machine
        columns, row = self._deployment.machine_addresses(addresses)
        course = self._host.begin(
            FrameInput(
                addresses=columns,
                prior_address=row,
                prior_codes=prior,
                target_count=section.target_count,
                max_cycles=section.max_cycles,
                bank=bank,
                stop="own" if section.stop == "own" else "slices",
            )
        )
        for number, (machine, blocks) in enumerate(zip(self._machines, course.starts, strict=True)):
            self._write(number, blocks, course.settings)
            machine.start(course.settings, course.end)
        while True:
            reasons = [(machine.reason,) for machine in self._machines]
            numbers, blocks = course.proceed(reasons, self._answers())
            if not numbers:
                break
            for number in numbers:
                self._write(number, blocks, course.settings)
                self._machines[number].resume(course.end)
        results = [
            BoardResult(bytes(memory["RESULTS"][: 4 * used.result_words]), machine.cycles, machine.reason)
            for memory, used, machine in zip(self._memories, self._registers, self._machines, strict=True)
        ]
        return list(course.conclude(results))

    def _write(self, number: int, blocks: Blocks, settings: FrameSettings) -> None:
        target = {"TARGET_COUNT": settings.target_count.to_bytes(4, "little")}  # a resume takes it from there
        for name, words in {**blocks, **target}.items():
            self._memories[number][name][: len(words)] = words

    def _answers(self) -> list[memoryview]:
        return [
            memoryview(b"".join(memory[name][: 4 * words] for name, words in used.answer.items()))
            for memory, used in zip(self._memories, self._registers, strict=True)
        ]


def _none(_: int) -> None:
    """Return no posterior; unlike a lambda, it can be pickled."""


@dataclass(frozen=True, slots=True)
class Replay:
    """The job of a recording's frames: piece n is row n, which is frame n + 1 of a master."""

    deployment: Deployment
    images: Sequence[Image]
    frames: Frames
    done: Callable[[int], NDArray[np.float64] | None] = _none
    """Returns the posterior of an earlier row, from which a filter goes on; it stays in its process."""

    @property
    def is_sequence(self) -> bool:
        """True if a frame depends on the frames before it, because of a filter or of generators that are never reset."""
        section = self.deployment.machine
        return self.deployment.filter is not None or section.rng_reset is RngReset.FREE

    def prepare(self) -> Work:
        """Return the function that computes the record of a row."""
        deployment, frames = self.deployment, self.frames
        boards, kind = _Boards(deployment, self.images), deployment.machine.kind
        numbers, layout = np.cumsum(frames.fits), record_layout(deployment)
        own, at, steps = deployment.new_filter(), 0, 0

        def prior_of(row: int) -> NDArray[np.uint16] | None:
            nonlocal at, steps
            if own is None:
                return None
            prior = None
            for each in range(at, row + 1):  # first those of an interrupted run
                steps += 1  # as a master predicts: also for the rows before that do not fit
                if frames.fits[each]:
                    prior, steps = own.predict(steps), 0
                    if each < row:
                        own.update(self.done(each))
            at = row + 1
            return prior

        def compute(row: int) -> bytes:
            prior, record = prior_of(row), np.zeros((), layout)
            record["posterior"] = np.nan
            if frames.fits[row]:
                addresses = [None if each == MISSING else each for each in frames.addresses[row].tolist()]
                results = boards.run(addresses, int(numbers[row]) % deployment.machine.rng_banks, prior)
                posterior = kind.infer(results, deployment.machine.variables).posterior
                record["cycles"] = max(each.cycles for each in results)
                if posterior is not None:
                    record["posterior"] = posterior
                if own is not None:
                    own.update(posterior)
            record["crc"] = crc32(record.tobytes()[_CRC_BYTES:])
            return record.tobytes()

        return compute


_CRC_BYTES: Final = 8


def record_layout(deployment: Deployment) -> "np.dtype[np.void]":
    """Return the layout of a record: a checksum of the rest, the cycles of the slowest board, the posterior or NaN."""
    return np.dtype([("crc", "<u8"), ("cycles", "<u8"), ("posterior", "<f8", deployment.machine.results)])


class PartFile:
    """The records so far, each at the place of its row, behind a line with the key of the work.

    A place that was not written, or only in part, has a wrong checksum, so its row counts as missing.
    """

    def __init__(self, path: Path, key: str, layout: "np.dtype[np.void]", frames: int) -> None:
        """Open or create the file with room for all, or raise a BuildError; one of other work is refused."""
        self.path = path
        # Where the first record begins, and the length of each; `_file` is locked against other runs.
        heading = json.dumps({"rosbayes": _FORMAT, "key": key}).encode() + b"\n"
        self._begin, self._size = len(heading), layout.itemsize
        with file_errors(path, "written", BuildError):
            self._file = os.fdopen(
                os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+b", buffering=0
            )
            try:
                self._begin_file(heading, frames)
            except BaseException:
                self._file.close()
                raise
            # All records as they are in the file, also those that `add` writes later.
            self.records = np.memmap(path, layout, "r", self._begin, (frames,))

    def _begin_file(self, heading: bytes, frames: int) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BuildError(
                f"another run is writing {self.path}; wait for it, or name another file with -o"
            ) from None
        found = self._file.read(len(heading))
        if not heading.startswith(found):
            raise BuildError(
                f"{self.path} belongs to another recording, deployment or version; delete it, or name another file with -o"
            )
        os.pwrite(self._file.fileno(), heading, 0)
        os.posix_fallocate(self._file.fileno(), 0, self._begin + frames * self._size)

    def missing(self) -> list[int]:
        """Return the rows without a record, in order."""
        return [
            row
            for row, record in enumerate(self.records)
            if crc32(record.tobytes()[_CRC_BYTES:]) != record["crc"]
        ]

    def add(self, row: int, record: bytes) -> None:
        """Write the record of a row; a BuildError if the disk fails, which keeps the others."""
        with file_errors(self.path, "written", BuildError):
            os.pwrite(self._file.fileno(), record, self._begin + row * self._size)

    def posterior(self, row: int) -> NDArray[np.float64] | None:
        """Return the posterior of a row that is done; None without one."""
        found: NDArray[np.float64] = self.records[row]["posterior"]
        return None if math.isnan(found[0]) else np.array(found)

    def close(self, *, remove: bool) -> None:
        """Close the file, and remove it if its work is done."""
        if remove:
            self.path.unlink(missing_ok=True)
        self._file.close()


@dataclass(frozen=True, slots=True)
class Summary:
    """Numbers of frames of a recording that were computed, kept or left out."""

    frames: int
    computed: int
    """Those that this run computed; the others were in the part file."""
    without: int
    """Those without a posterior."""
    unfit: int
    """Of these, rows that do not fit the machine."""


def replay(
    deployment: Deployment,
    frames: Frames,
    output: Path,
    run: Run,
    *,
    advance: Callable[[], None] = lambda: None,
    begun: Callable[[int], None] = lambda _: None,
) -> Summary:
    """Compute all frames that are not done, and write the output.

    `begun` is called with the number of frames that an earlier run has left, `advance` after each other one. The frames
    of a sequence are computed in this process.

    Raises:
        BuildError: A file cannot be written, or belongs to other work.
    """
    job = Replay(deployment, read_images(deployment), frames)
    part = PartFile(
        output.with_name(output.name + ".frames"),
        _key(deployment, frames),
        record_layout(deployment),
        len(frames),
    )
    done = False
    try:
        missing = part.missing()
        if missing and deployment.machine.rng_reset is RngReset.FREE:
            missing = list(range(len(frames)))  # the state of the generators is not in the records
        begun(len(frames) - len(missing))

        def keep(row: int, record: bytes) -> None:
            part.add(row, record)
            advance()

        if job.is_sequence:
            in_this_process(replace(job, done=part.posterior), missing, keep)
        else:
            run(job, missing, keep)
        _WRITERS[output.suffix](output, deployment, frames, part.records)
        without = int(np.isnan(part.records["posterior"][:, 0]).sum())
        done = True
    finally:
        part.close(remove=done)
    return Summary(len(frames), len(missing), without, int((~frames.fits).sum()))


def _key(deployment: Deployment, frames: Frames) -> str:
    """Return a hash of everything on which the records depend."""
    digest = sha256(software().encode())
    digest.update(json.dumps([board.image_hash for board in deployment.boards]).encode())
    digest.update(deployment.hash.encode())
    digest.update(frames.addresses.tobytes() + frames.fits.tobytes())
    return digest.hexdigest()


def _write_archive(path: Path, deployment: Deployment, frames: Frames, records: _Records) -> None:
    """Write the arrays of `listen --save FILE.npz`; posteriors pass through memory in parts."""
    dimensions = deployment.searched
    shape = (len(frames), *(each.size for each in dimensions))
    arrays: dict[str, NDArray[Any]] = {
        "probabilities": records["posterior"].reshape(shape),
        "frame": np.where(frames.fits, np.cumsum(frames.fits), -1),
        "stamp_ns": frames.stamps,
        "cycles": records["cycles"],
        "labels": np.array([each.label for each in dimensions]),
    }
    for at, each in enumerate(dimensions):
        arrays[f"axis{at}"] = np.array(each.states or [each.value(index) for index in range(each.size)])
    with whole_file(path, BuildError) as partial, zipfile.ZipFile(partial, "w") as archive:
        for name, array in arrays.items():
            # with a fixed date, so that the same posteriors are the same bytes
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def _write_bag(path: Path, deployment: Deployment, frames: Frames, records: _Records) -> None:
    """Write a message of the topic of results for each frame with a posterior, at the stamp of its row."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    kinds = [store.types[f"std_msgs/msg/{name}"] for name in _TYPES]
    array, layout, dimension = kinds
    sizes = [each.size for each in deployment.searched]
    strides = [math.prod(sizes[at:]) for at in range(len(sizes))]
    labelled = zip(deployment.searched, sizes, strides, strict=True)
    dim = [dimension(label=each.label, size=size, stride=stride) for each, size, stride in labelled]
    folder = path.with_name(path.name + ".bag")
    with whole_file(path, BuildError) as partial:
        shutil.rmtree(folder, ignore_errors=True)  # of an interrupted run
        try:
            with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                topic = writer.add_connection(_TOPIC, array.__msgtype__, typestore=store)
                for record, stamp in zip(records, frames.stamps.tolist(), strict=True):
                    values = np.array(record["posterior"])
                    if not math.isnan(values[0]):
                        message = array(layout=layout(dim=dim, data_offset=0), data=values)
                        writer.write(topic, stamp, store.serialize_cdr(message, array.__msgtype__))
            next(folder.glob("*.mcap")).replace(partial)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


_TYPES: Final = ("Float64MultiArray", "MultiArrayLayout", "MultiArrayDimension")
_WRITERS: Final = {".npz": _write_archive, ".mcap": _write_bag}


def check_output(path: Path) -> None:
    """Raise a BuildError before a long run for an output of an unknown format, or that cannot be written."""
    if path.suffix not in _WRITERS:
        raise BuildError(
            f"-o {path}: the name must end with {' or '.join(_WRITERS)}, which selects the format"
        )
    if path.suffix == ".mcap":
        try:
            import rosbags  # noqa: F401 - only whether it is there
        except ImportError:
            raise BuildError(f"-o {path}: MCAP files need rosbags: pip install rosbags") from None
    if not path.parent.is_dir():
        raise BuildError(f"-o {path}: {path.parent} is not a folder; create it first")
