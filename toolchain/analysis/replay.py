"""All frames of a recording through the machines of a deployment, as `master --loop --queue all` would compute them.

    recording ──rows──▶ addresses ──▶ Replay (a job: one piece per frame) ──▶ OUT.frames ──▶ OUT.npz or OUT.mcap

`OUT.frames` has a place for the record of each frame, behind a line that names everything on which the results depend. A run
that was killed goes on from it. `OUT` grows in the order of the rows, and has the same bytes whoever has computed them.
"""

import fcntl
import json
import math
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, TypeAlias
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from machines.bm2_kind import BM2, kernels_of, run_batches
from machines.kind import FrameInput
from machines.parameters import RngReset
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.analysis.readings import MISSING, Frames, Readings
from toolchain.bounded_files import file_errors, whole_file
from toolchain.building.build import read_images
from toolchain.cluster import Run, Work, in_this_process, software
from toolchain.deployment import Deployment
from toolchain.errors import BuildError

_FORMAT: Final = 1
_TOPIC: Final = "/BMresults"

_TOGETHER: Final = 64
"""Records that are written to the output at once."""

_Records: TypeAlias = "np.memmap[Any, np.dtype[np.void]]"
_Write: TypeAlias = Callable[[NDArray[np.void]], None]
_Posterior: TypeAlias = NDArray[np.float64] | None


_Row: TypeAlias = Callable[[int, int, NDArray[np.uint16] | None], tuple[_Posterior, int]]
"""A row, the bank of its frame, and its written prior, to posterior and cycles."""


def _run_on(deployment: Deployment, machines: Sequence[Any], readings: Readings) -> _Row:
    """Return the function that runs a row on the boards of a deployment, in this process."""
    section = deployment.machine
    target_count, max_cycles = section.target_count, section.max_cycles
    if section.is_divided:
        boards = EmulatedBoards(machines, target_count=target_count, max_cycles=max_cycles, stop=section.stop)

        def run_lines(row: int, bank: int, prior: NDArray[np.uint16] | None) -> tuple[_Posterior, int]:
            ran = boards.run(*readings.of_machine(row, machines[0]), bank, prior)
            return ran.posterior, ran.length

        return run_lines
    kernels = kernels_of(machines)

    def run_chains(row: int, bank: int, _: object) -> tuple[_Posterior, int]:
        addresses = tuple(None if at == MISSING else at for at in readings.addresses[row].tolist())
        frame = FrameInput(addresses=addresses, target_count=target_count, max_cycles=max_cycles, bank=bank)
        return BM2.infer(run_batches(kernels, frame)).posterior, max(each.cycles for each in kernels)

    return run_chains


@dataclass(frozen=True, slots=True)
class Replay:
    """The job of a recording's frames: piece n is row n, which is frame n + 1 of a master."""

    deployment: Deployment
    machines: Sequence[Any]
    frames: Frames
    done: Callable[[int], _Posterior] | None = None
    """Of a filter that goes on after an interruption: returns the posterior of an earlier row."""

    @property
    def is_sequence(self) -> bool:
        """True if a frame depends on those before it, because of a filter or of generators that are never reset."""
        section = self.deployment.machine
        return self.deployment.filter is not None or section.rng_reset is RngReset.FREE

    def prepare(self) -> Work:
        """Return the function that computes the record of a row."""
        deployment, frames = self.deployment, self.frames
        run = _run_on(deployment, self.machines, frames.readings)
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
                        own.update(self.done(each) if self.done else None)
            at = row + 1
            return prior

        def compute(row: int) -> bytes:
            prior, record = prior_of(row), np.zeros((), layout)
            record["posterior"] = np.nan
            if frames.fits[row]:
                bank = int(numbers[row]) % deployment.machine.rng_banks
                posterior, record["cycles"] = run(row, bank, prior)
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
        # Where the first record begins, and the length of each; `_file` is locked against other runs, and is new until
        # it has a record.
        heading = json.dumps({"rosbayes": _FORMAT, "key": key}).encode() + b"\n"
        if path.exists() and not path.is_file():
            raise BuildError(f"{path} is not a regular file; delete it, or name another file with -o")
        self._begin, self._size = len(heading), layout.itemsize
        with file_errors(path, "written", BuildError), ExitStack() as opened:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            self._file = opened.enter_context(os.fdopen(descriptor, "r+b", buffering=0))
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BuildError(
                    f"another run is writing {path}; wait for it, or name another file with -o"
                ) from None
            found = self._file.read(len(heading))
            self._is_new = not found
            if not heading.startswith(found):
                raise BuildError(
                    f"{path} belongs to another recording, deployment or version; delete it, or name another file with -o"
                )
            os.pwrite(descriptor, heading, 0)
            os.posix_fallocate(descriptor, 0, self._begin + frames * self._size)
            # All records as they are in the file, also those that `add` writes later.
            self.records = np.memmap(path, layout, "r", self._begin, (frames,))
            opened.pop_all()

    def missing(self) -> list[int]:
        """Return the rows without a record, in order."""
        if self._is_new:
            return list(range(len(self.records)))
        return [
            row
            for row, record in enumerate(self.records)
            if crc32(record.tobytes()[_CRC_BYTES:]) != record["crc"]
        ]

    def add(self, row: int, record: bytes) -> None:
        """Write the record of a row; a BuildError if the disk fails, which keeps the others."""
        with file_errors(self.path, "written", BuildError):
            os.pwrite(self._file.fileno(), record, self._begin + row * self._size)
        self._is_new = False

    def posterior(self, row: int) -> _Posterior:
        """Return the posterior of a row that is done; None without one."""
        found: NDArray[np.float64] = self.records[row]["posterior"]
        return None if math.isnan(found[0]) else np.array(found)

    def close(self, *, remove: bool) -> None:
        """Close the file, and remove it if its work is done."""
        if remove:
            self.path.unlink(missing_ok=True)
        self._file.close()


class _InOrder:
    """Writes records in the order of their rows, each as soon as those before it are there."""

    def __init__(self, records: _Records, missing: Sequence[int], write: _Write) -> None:
        self._records, self._write = records, write
        # A byte for each row, 1 if it has a record; and how many rows are written.
        self._there, self._written = bytearray(b"\1" * len(records)), 0
        for row in missing:
            self._there[row] = 0
        self._write_on()

    def add(self, row: int) -> None:
        """Note that a row has its record."""
        self._there[row] = 1
        self._write_on()

    def _write_on(self) -> None:
        rows = len(self._records)
        gap = self._there.find(0, self._written) % (rows + 1)  # -1, for none, becomes the number of rows
        while self._written + _TOGETHER <= gap or self._written < gap == rows:
            end = min(self._written + _TOGETHER, rows)
            self._write(self._records[self._written : end])
            self._written = end


class Summary(NamedTuple):
    """Numbers of frames of a recording: all, those that this run computed, and those without a posterior."""

    frames: int
    computed: int
    without: int


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
    job = Replay(deployment, [image.machine for image in read_images(deployment)], frames)
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

        with _WRITERS[output.suffix](output, deployment, frames) as write:
            ordered = _InOrder(part.records, missing, write)

            def keep(row: int, record: bytes) -> None:
                part.add(row, record)
                ordered.add(row)
                advance()

            if job.is_sequence:
                in_this_process(replace(job, done=part.posterior), missing, keep)
            else:
                run(job, missing, keep)
        without = int(np.isnan(part.records["posterior"][:, 0]).sum())
        done = True
    finally:
        part.close(remove=done)
    return Summary(len(frames), len(missing), without)


def _key(deployment: Deployment, frames: Frames) -> str:
    """Return a hash of everything on which the records depend."""
    digest = sha256(software().encode())
    digest.update(json.dumps([board.image_hash for board in deployment.boards]).encode())
    digest.update(deployment.hash.encode())
    readings = frames.readings
    digest.update(readings.addresses.tobytes() + readings.prior_addresses.tobytes() + frames.fits.tobytes())
    return digest.hexdigest()


@contextmanager
def _archive(path: Path, deployment: Deployment, frames: Frames) -> Iterator[_Write]:
    """Write the arrays of `listen --save FILE.npz`."""
    dimensions, cycles = deployment.searched, list[NDArray[np.uint64]]()
    shape = (len(frames), *(each.size for each in dimensions))
    with whole_file(path, BuildError) as partial, zipfile.ZipFile(partial, "w") as archive:

        def member(name: str) -> IO[bytes]:
            # with a fixed date, so that the same posteriors are the same bytes
            return archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True)

        with member("probabilities") as file:
            np.lib.format.write_array_header_1_0(
                file, {"descr": "<f8", "fortran_order": False, "shape": shape}
            )

            def write(records: NDArray[np.void]) -> None:
                file.write(records["posterior"].tobytes())
                cycles.append(records["cycles"].copy())

            yield write
        arrays: dict[str, NDArray[Any]] = {
            "frame": np.where(frames.fits, np.cumsum(frames.fits), -1),
            "stamp_ns": frames.stamps,
            "cycles": np.concatenate(cycles),
            "labels": np.array([each.label for each in dimensions]),
        }
        for at, each in enumerate(dimensions):
            arrays[f"axis{at}"] = np.array(each.states or [each.value(index) for index in range(each.size)])
        for name, array in arrays.items():
            with member(name) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


@contextmanager
def _bag(path: Path, deployment: Deployment, frames: Frames) -> Iterator[_Write]:
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
    folder, stamps = path.with_name(path.name + ".bag"), iter(frames.stamps.tolist())
    with whole_file(path, BuildError) as partial:
        shutil.rmtree(folder, ignore_errors=True)  # of an interrupted run
        try:
            # rosbag2's metadata names the bag, so a fixed name gives the same bytes whatever the output is called
            with Writer(folder / "BMresults", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                topic = writer.add_connection(_TOPIC, array.__msgtype__, typestore=store)

                def write(records: NDArray[np.void]) -> None:
                    for values, stamp in zip(records["posterior"], stamps, strict=False):
                        if not math.isnan(values[0]):
                            message = array(layout=layout(dim=dim, data_offset=0), data=np.array(values))
                            writer.write(topic, stamp, store.serialize_cdr(message, array.__msgtype__))

                yield write
            next(folder.glob("*/*.mcap")).replace(partial)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


_TYPES: Final = ("Float64MultiArray", "MultiArrayLayout", "MultiArrayDimension")
_WRITERS: Final = {".npz": _archive, ".mcap": _bag}


def check_request(path: Path, deployment: Deployment) -> None:
    """Raise a BuildError before a long run for an output that cannot be written, or machines that take arrays."""
    if not deployment.machine.is_plain or deployment.prior is not None:
        raise BuildError(
            f"{deployment.directory} reads arrays of numbers (for each line or replica, or a prior), but the columns of a "
            "recording are numbers"
        )
    if path.suffix not in _WRITERS:
        raise BuildError(
            f"-o {path}: the name must end with {' or '.join(_WRITERS)}, which selects the format"
        )
    if path.suffix == ".mcap":
        try:
            import rosbags  # noqa: F401 - only whether it is there
        except ImportError:
            raise BuildError(f"-o {path}: MCAP files need rosbags: pip install rosbags") from None
    if path.is_dir():
        raise BuildError(f"-o {path} is a folder; name a file")
    if not path.parent.is_dir():
        raise BuildError(f"-o {path}: {path.parent} is not a folder; create it first")
