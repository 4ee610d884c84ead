"""The posteriors of all rows of a recording, as `master --loop --queue all` would compute them, written to OUT.

    recording ──rows──▶ addresses ──▶ Replay (a job: one piece per frame) ──▶ OUT.frames ──▶ OUT.npz or OUT.mcap

`OUT.frames` begins with a line that identifies everything on which the results depend. After this line, the file has
room for the record of each frame. So a killed run can be resumed. `OUT` is written in the order of the rows. Its bytes
therefore do not depend on which process computed a frame, or when.
"""

import fcntl
import math
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import IO, Any, Final, TypeAlias
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

_TOPIC: Final = "/BMresults"
_TOGETHER: Final = 64
"""Number of records that are written to the output together."""
_CRC_BYTES: Final = 8

_Posterior: TypeAlias = NDArray[np.float64] | None
_Row: TypeAlias = Callable[[int, int, NDArray[np.uint16] | None], tuple[_Posterior, int]]
"""A function that takes a row, the bank of its frame, and its written prior, and returns its posterior and cycles."""
_Write: TypeAlias = Callable[[NDArray[np.void]], None]


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
    """The `toolchain.cluster.Job` that computes the frames of a recording. Piece n is row n of the recording."""

    deployment: Deployment
    machines: Sequence[Any]
    frames: Frames
    earlier: Callable[[int], tuple[_Posterior, int] | None] | None = None
    """Function that returns a row's posterior and cycles from an interrupted run, or None if that run lacks the row.

    A filter needs the posteriors of all rows, in order. With a filter, the function supplies the stored ones. Without a
    filter, the function is not used.
    """

    @property
    def is_sequence(self) -> bool:
        """True if each frame depends on earlier frames, because of a filter or of generators that are never reset."""
        section = self.deployment.machine
        return self.deployment.filter is not None or section.rng_reset is RngReset.FREE

    def prepare(self) -> Work:
        """Return the function that computes the record of a row."""
        deployment, fits = self.deployment, self.frames.fits
        run = _run_on(deployment, self.machines, self.frames.readings)
        numbers, layout = np.cumsum(fits), record_layout(deployment)
        own, steps = deployment.new_filter(), 0

        def compute(row: int) -> bytes:
            nonlocal steps
            steps += 1  # as a master predicts: also for the rows before that do not fit
            record, posterior, prior = np.zeros((), layout), None, None
            if fits[row]:
                if own is not None:
                    prior, steps = own.predict(steps), 0
                found = None if self.earlier is None else self.earlier(row)
                bank = int(numbers[row]) % deployment.machine.rng_banks
                posterior, record["cycles"] = found or run(row, bank, prior)
                if own is not None:
                    own.update(posterior)
            record["posterior"] = np.nan if posterior is None else posterior
            record["crc"] = crc32(record.tobytes()[_CRC_BYTES:])
            return record.tobytes()

        return compute


def record_layout(deployment: Deployment) -> "np.dtype[np.void]":
    """Return the layout of a record: checksum of the other fields, cycles of the longest-running board, posterior."""
    return np.dtype([("crc", "<u8"), ("cycles", "<u8"), ("posterior", "<f8", deployment.machine.results)])


@dataclass(slots=True)
class PartFile:
    """A file with room for one record per row of a recording. An interrupted run leaves some records in the file."""

    file: int
    """The descriptor of the file."""
    begin: int
    """Offset of the first record in bytes."""
    records: NDArray[np.void]
    """All records, memory-mapped from the file. Records that `add` writes later appear in this array too."""
    there: bytearray
    """For each row, 1 if the row's record is in the file, else 0."""
    written: int = 0
    """Number of rows that `ready` has yielded."""

    @classmethod
    @contextmanager
    def opened(cls, path: Path, key: str, layout: "np.dtype[np.void]", frames: int) -> Iterator["PartFile"]:
        """Open or create the file, lock it, and reserve room for all records.

        The file begins with `key`. A record that is absent or incomplete has a wrong checksum. If the `with` block
        ends without an error, the file is removed.

        Raises:
            BuildError: The file cannot be written, is locked by another run, or has another key.
        """
        heading, elsewhere = f"rosbayes infer {key}\n".encode(), "or name another file with -o"
        with file_errors(path, "written", BuildError):
            path.touch()
            with path.open("r+b", buffering=0) as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise BuildError(f"another run is writing {path}; wait for it, {elsewhere}") from None
                found = os.pread(file.fileno(), len(heading), 0)
                if not heading.startswith(found):
                    raise BuildError(
                        f"{path} belongs to another recording, deployment or version; delete it, {elsewhere}"
                    )
                os.pwrite(file.fileno(), heading, 0)
                os.posix_fallocate(file.fileno(), 0, len(heading) + frames * layout.itemsize)
                # opened by its path, because a mapping of `file` would keep the lock
                records = np.memmap(path, layout, "r", len(heading), (frames,))
                whole = (crc32(each.tobytes()[_CRC_BYTES:]) == int(each["crc"]) for each in records)
                there = bytearray(whole if found else frames)
                yield cls(file.fileno(), len(heading), records, there)
                path.unlink(missing_ok=True)

    def add(self, row: int, record: bytes) -> None:
        """Write the record of a row."""
        os.pwrite(self.file, record, self.begin + row * len(record))
        self.there[row] = 1

    def earlier(self, row: int) -> tuple[_Posterior, int] | None:
        """Return the posterior and the cycles of a row, or None if the file lacks the row's record.

        The posterior is None if the frame of the row had no posterior.
        """
        if not self.there[row]:
            return None
        posterior: NDArray[np.float64] = np.array(self.records[row]["posterior"])
        return None if math.isnan(posterior[0]) else posterior, int(self.records[row]["cycles"])

    def ready(self) -> Iterator[NDArray[np.void]]:
        """Yield batches of new records in the order of the rows, up to the first absent record."""
        rows = len(self.records)
        gap = self.there.find(0, self.written) % (rows + 1)  # -1, for none, becomes the number of rows
        while self.written + _TOGETHER <= gap or self.written < gap == rows:
            begin, self.written = self.written, min(self.written + _TOGETHER, rows)
            yield self.records[begin : self.written]


def replay(
    deployment: Deployment,
    frames: Frames,
    output: Path,
    run: Run,
    *,
    advance: Callable[[], None] = lambda: None,
    begun: Callable[[int], None] = lambda _: None,
) -> tuple[int, int]:
    """Compute all frames that an interrupted run has not computed, and write the output.

    First, `begun` is called with the number of frames from the interrupted run. After each further frame, `advance` is
    called. If a frame depends on earlier frames, the frames are computed in order in this process, without `run`.
    Return the number of frames computed now, and the number of all frames without a posterior.

    Raises:
        BuildError: A file cannot be written, or belongs to another recording, deployment or version.
    """
    job = Replay(deployment, [image.machine for image in read_images(deployment)], frames)
    path, layout = output.with_name(output.name + ".frames"), record_layout(deployment)
    with (
        PartFile.opened(path, _key(deployment, frames), layout, len(frames)) as part,
        _WRITERS[output.suffix](output, deployment, frames) as write,
    ):
        if deployment.machine.rng_reset is RngReset.FREE:
            part.there[:] = bytes(len(frames))  # all again: records lack the generators' state
        missing = [row for row, there in enumerate(part.there) if not there]
        begun(len(frames) - len(missing))

        def keep(row: int, record: bytes) -> None:
            if not part.there[row]:
                part.add(row, record)
                advance()
            for records in part.ready():
                write(records)

        if job.is_sequence:
            in_this_process(replace(job, earlier=part.earlier), range(len(frames)) if missing else (), keep)
        else:
            run(job, missing, keep)
        for records in part.ready():
            write(records)
        return len(missing), int(np.isnan(part.records["posterior"][:, 0]).sum())


def _key(deployment: Deployment, frames: Frames) -> str:
    """Return a hash of everything on which the records depend."""
    readings, digest = frames.readings, sha256(f"{software()} {deployment.hash}".encode())
    digest.update(readings.addresses.tobytes() + readings.prior_addresses.tobytes() + frames.fits.tobytes())
    return digest.hexdigest()


@contextmanager
def _archive(path: Path, deployment: Deployment, frames: Frames) -> Iterator[_Write]:
    """Write an archive with the arrays that `listen --save FILE.npz` writes."""
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
    """Write an MCAP file with a message on /BMresults for each frame with a posterior, at the stamp of its row."""
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
    """Before a long run, raise a BuildError if the output `path` is unusable or the deployment reads arrays."""
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
