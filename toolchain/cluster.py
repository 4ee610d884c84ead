"""Independent pieces of work, in this process or on the workers of a dask scheduler (the extra `cluster`).

    this process                          scheduler           workers
    job, once ────────────────────────────────┼─────────────▶ prepare(): tables and kernels, once for each
    batches of numbers, 2 s at most each ─────┼─────────────▶ work(number) for each number
    keep(number, result) ◀────────────────────┴────────────── as batches are done, in any order

The job contains the tables, and is sent once. A piece of work is only a number. The result of a piece depends only on
the job and the number, not on the worker or the order of the pieces. A caller that keeps results on disk can resume an
interrupted job with the numbers that have no result yet.
"""

import asyncio
import logging
import pickle
import re
import ssl
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import get_ident
from typing import Annotated, Any, Final, Protocol, TypeAlias

import typer

from toolchain.errors import BuildError, ToolchainError

Work: TypeAlias = Callable[[int], Any]
Keep: TypeAlias = Callable[[int, Any], None]

BATCH_S: Final = 2.0
"""Maximum seconds of work in a batch. Batches are long, because dask takes about 15 ms of CPU time for each batch."""
_SMALLEST_S: Final = BATCH_S / 20
"""Seconds of work in the first batches, until the speed is known, and in the last, so that workers finish together."""
_AHEAD: Final = 3
"""Number of batches under way for each worker: one being computed, one that waits there, one at the scheduler."""
_PATIENCE_S: Final = 60.0
"""Seconds within which a lost scheduler must come back, or one without workers must get a worker again."""
_CONNECT_S: Final = 10.0
_POLL_S: Final = 1.0
_LEAN: Final = {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "1s"}
"""Settings of the processes of `local`: with dask's defaults, each spends 3 to 5 % of a core on monitoring itself."""
_ADDRESS: Final = re.compile(r"(tcp|tls)://(\[[\da-fA-F:.]+]|[^][:/]+):\d{1,5}")
_LOOPBACK: Final = re.compile(r"127(\.\d+){3}|\[::1]|localhost")


class Job(Protocol):
    """Numbered pieces of work that use the same tables. Jobs and results must be picklable."""

    def prepare(self) -> Work:
        """Return a function that takes the number of a piece of work, does the piece, and returns the result."""


Run: TypeAlias = Callable[[Job, Sequence[int], Keep], None]
"""A function that does the numbered pieces of a job, and passes each result to `keep` as soon as it has the result."""


def in_this_process(job: Job, numbers: Sequence[int], keep: Keep) -> None:
    """Do the pieces with these numbers in this process, one after another."""
    if numbers:
        work = job.prepare()
        for number in numbers:
            keep(number, work(number))


def in_order(run: Run, job: Job, numbers: Sequence[int], advance: Callable[[], None]) -> list[Any]:
    """Do the numbered pieces of a job with `run`, and call `advance` after each piece.

    The results are returned in the order of `numbers`, because sums of floats depend on the order.
    """
    found: dict[int, Any] = {}

    def keep(number: int, result: object) -> None:
        found[number] = result
        advance()

    run(job, numbers, keep)
    return [found[number] for number in numbers]


class ClusterError(ToolchainError):
    """A scheduler cannot be used, or its workers cannot do the work."""


@dataclass(frozen=True, kw_only=True)
class SchedulerOptions:
    """The flags that choose where independent pieces of work are done: in this process or on a cluster."""

    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Do the work on the workers of a dask scheduler; local: one worker for each core of this host.",
            metavar="tcp://HOST:PORT|tls://HOST:PORT|local",
            show_default="in this process",
        ),
    ] = None
    tls_ca_file: Annotated[
        Path | None, typer.Option(help="Of tls://: trusted certificates.", metavar="PEM")
    ] = None
    tls_cert: Annotated[Path | None, typer.Option(help="Of tls://: our certificate.", metavar="PEM")] = None
    tls_key: Annotated[Path | None, typer.Option(help="Of tls://: its key.", metavar="PEM")] = None
    insecure: Annotated[bool, typer.Option("--insecure", help="Permit tcp:// to another host.")] = False

    def __post_init__(self) -> None:
        """Refuse flags that contradict each other, and files that cannot be used."""
        files = {"--tls-ca-file": self.tls_ca_file, "--tls-cert": self.tls_cert, "--tls-key": self.tls_key}
        given = [flag for flag, file in files.items() if file is not None]
        flag, address = f"--scheduler {self.scheduler}", _ADDRESS.fullmatch(self.scheduler or "")
        if address is None and self.scheduler not in (None, "local"):
            raise BuildError(
                f"{flag}: expected tcp://HOST:PORT or tls://HOST:PORT, as the scheduler prints it, or local"
            )
        if address is not None and address[1] == "tls":
            if len(given) < len(files):
                raise BuildError(f"{flag} needs {', '.join(each for each in files if each not in given)} too")
            _check_certificates(files)
        elif given:
            raise BuildError(f"{given[0]} is for --scheduler tls://HOST:PORT")
        elif address is not None and not self.insecure and not _LOOPBACK.fullmatch(address[2]):
            raise BuildError(
                f"{flag}: without TLS, everybody on the way there can run programs as this user; use tls:// with "
                "--tls-ca-file, --tls-cert and --tls-key, or --insecure"
            )


def _check_certificates(files: dict[str, Path | None]) -> None:
    """Raise a BuildError that names the flag and the file which cannot be used."""
    context = ssl.create_default_context()
    for flag, file in files.items():
        try:
            if flag == "--tls-key":
                context.load_cert_chain(str(files["--tls-cert"]), file, password=lambda: "")
            else:
                context.load_verify_locations(file)
        except OSError as reason:
            raise BuildError(f"{flag} {file} cannot be used: {reason.strerror or reason}") from None


@contextmanager
def runner(options: SchedulerOptions) -> Iterator[Run]:
    """Yield a function that does pieces of work in this process, or on the scheduler in `options`.

    Raises a ClusterError if dask is not installed, or if local workers cannot start.
    """
    address = options.scheduler
    if address is None:
        yield in_this_process
        return
    try:
        import dask
        import lz4.frame  # noqa: F401 - only whether it is there
        from distributed import Client, LocalCluster, Security
    except (ImportError, ValueError) as reason:  # ValueError: a damaged file of dask's settings
        why = str(reason).partition("\n")[0]
        raise ClusterError(f"--scheduler needs dask: pip install 'rosbayes[cluster]' ({why})") from None
    # log lines of dask on standard error repeat what is said here
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    if address == "local":
        with TemporaryDirectory(prefix="rosbayes-") as folder, dask.config.set(_LEAN):
            try:
                # with certificates of its own, because other users of this host could connect too
                local = LocalCluster(
                    threads_per_worker=1,
                    security=True,
                    local_directory=folder,
                    dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": False},
                    silence_logs=logging.CRITICAL,
                )
            except (OSError, RuntimeError) as reason:
                raise ClusterError(f"--scheduler local cannot start its workers: {reason}") from None
            with local:
                yield partial(_on_scheduler, address, lambda: Client(local))
        return
    security = Security()
    if address.startswith("tls:"):
        security = Security(
            tls_ca_file=str(options.tls_ca_file),
            tls_client_cert=str(options.tls_cert),
            tls_client_key=str(options.tls_key),
            require_encryption=True,
        )

    def connect() -> Any:
        # first, because the client waits without a limit for the greeting of whatever listens there
        asyncio.run(asyncio.wait_for(_greet(address, security.get_connection_args("client")), _CONNECT_S))
        return Client(address, security=security, timeout=_CONNECT_S)

    yield partial(_on_scheduler, address, connect)


async def _greet(address: str, arguments: dict[str, Any]) -> None:
    """Raise an OSError if no dask scheduler answers at an address."""
    from distributed.core import rpc

    try:
        async with rpc(address, timeout=_CONNECT_S, connection_args=arguments) as there:
            kind = (await there.identity())["type"]
    except Exception as reason:  # whatever dask makes of another protocol
        raise OSError(str(reason)) from None
    if kind != "Scheduler":
        raise OSError("another part of dask")


@cache
def software() -> str:
    """Return a hash of the software on this host that affects results: rosbayes, NumPy, Numba and SciPy."""
    digest = sha256()
    for name in ("numpy", "numba", "scipy"):
        with suppress(metadata.PackageNotFoundError):
            digest.update(f"{name} {metadata.version(name)}\n".encode())
    root = Path(__file__).parent.parent
    for folder in ("machines", "pcie_shim", "toolchain"):
        for path in sorted((root / folder).rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


@lru_cache(8)
def _prepared(pickled: bytes, _thread: int) -> Work:
    """Return the work of a job, which each thread of a worker prepares once, because threads cannot share a kernel."""
    job: Job = pickle.loads(pickled)  # noqa: S301 - dask runs whatever its client sends anyway
    return job.prepare()


def do_batch(pickled: bytes, numbers: Sequence[int], most_s: float, theirs: str) -> tuple[bytes, float]:
    """Compute pieces of a job on a worker for about `most_s` seconds, and at least one piece.

    Return the results and the seconds taken. The results are pickled and compressed, because a posterior is mostly
    zeros, and dask would send the results uncompressed through the scheduler. `theirs` is the client's `software()`.

    Raises:
        ClusterError: This worker has another version of this software than the client.
    """
    if software() != theirs:
        raise ClusterError("it has another version of rosbayes, NumPy or Numba")
    from lz4.frame import compress

    work, results, begun = _prepared(pickled, get_ident()), [], time.perf_counter()
    for number in numbers:
        results.append(work(number))
        if (seconds := time.perf_counter() - begun) > most_s:
            break
    return compress(pickle.dumps(results)), seconds


class _LostError(Exception):
    """The scheduler, or the last worker that had the job, is gone."""


@contextmanager
def _noticing_loss() -> Iterator[None]:
    """Convert what dask's client raises for a lost result, or a lost or closing connection, to a `_LostError`."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, CancelledError):
        raise _LostError from None


def _on_scheduler(
    address: str, connect: Callable[[], Any], job: Job, numbers: Sequence[int], keep: Keep
) -> None:
    """Do the pieces of a job on the workers of a scheduler.

    If the scheduler is lost, the job continues when a scheduler answers at `address` again.

    Raises:
        ClusterError: The workers cannot do the pieces, or for a minute there is no scheduler or no worker.
    """
    left = dict.fromkeys(numbers)  # the numbers without a result, in order
    until = 0.0  # monotonic time until which to wait after a loss; 0 before the first
    while left:
        before, client = len(left), _client(address, connect, until)
        try:
            _do(address, client, pickle.dumps(job), left, keep)
        except _LostError:
            if not until or len(left) < before:
                until = time.monotonic() + _PATIENCE_S
            elif time.monotonic() > until:
                raise ClusterError(
                    f"--scheduler {address} lost this work again and again; read the logs of its workers"
                ) from None
            print(f"{address} lost the work; waiting for it with {len(left)} pieces left", file=sys.stderr)
        finally:
            with suppress(_LostError), _noticing_loss():
                client.close(timeout=_POLL_S)


def _client(address: str, connect: Callable[[], Any], until: float) -> Any:
    """Return a client of a scheduler that has a worker; try again until `until`, a monotonic time."""
    while True:
        client = None
        try:
            client = connect()
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except (OSError, ValueError):
            if client is not None:
                client.close(timeout=_POLL_S)
            if time.monotonic() < until:
                time.sleep(_POLL_S)
                continue
            tls = "wants other certificates" if address.startswith("tls:") else "wants tls://"
            why = f"no scheduler answers there, or it {tls}; start one with 'dask scheduler', or correct the flags"
            if client is not None:
                why = f"it has no worker; start one with 'dask worker {address} --nthreads 1', or read the log of one that has ended"
            raise ClusterError(f"--scheduler {address}: {why}") from None
        else:
            return client


def _do(address: str, client: Any, pickled: bytes, left: dict[int, None], keep: Keep) -> None:
    """Do the pieces of a job on a scheduler's workers; a `_LostError` if the scheduler or all workers are lost."""
    from distributed import wait

    # Numbers that are not under way yet, in order; the numbers of each batch under way; the seconds of a piece in the
    # last batch, at first 0; and when there last was a worker (monotonic).
    waiting, batches, piece_s, served_at = deque(left), dict[Any, list[int]](), 0.0, time.monotonic()
    with _noticing_loss():
        # a copy for each worker, so that the job survives the loss of one; a later worker fetches it from the others
        table = client.scatter(pickled, broadcast=True, hash=False)
    try:
        while waiting or batches:
            with _noticing_loss():
                threads = sum(client.nthreads().values())
            if threads:
                served_at = time.monotonic()
            elif time.monotonic() > served_at + _PATIENCE_S:
                raise _LostError
            while waiting and len(batches) < _AHEAD * max(1, threads):
                size, most_s = len(waiting) / (2 * max(1, threads)), _SMALLEST_S
                if piece_s:
                    size, most_s = min(BATCH_S / piece_s, max(_SMALLEST_S / piece_s, size)), BATCH_S
                numbers = [waiting.popleft() for _ in range(max(1, min(round(size), len(waiting))))]
                with _noticing_loss():
                    batches[client.submit(do_batch, table, numbers, most_s, software(), pure=False)] = numbers
            with _noticing_loss():
                try:
                    done = wait(list(batches), timeout=_POLL_S, return_when="FIRST_COMPLETED").done
                except TimeoutError:
                    if client.status != "running":
                        raise
                    continue
            for batch in done:
                results, seconds = _results(address, batch)
                numbers, piece_s = batches.pop(batch), seconds / len(results)
                waiting.extendleft(reversed(numbers[len(results) :]))
                batch.release()  # or dask would compute it again if its worker died now
                for number, result in zip(numbers, results, strict=False):
                    keep(number, result)
                    del left[number]
    finally:
        with suppress(_LostError), _noticing_loss():
            client.cancel(list(batches))


def _results(address: str, batch: Any) -> tuple[list[Any], float]:
    """Return the results of a batch, and the seconds that the batch took.

    Raises:
        ToolchainError: The batch failed.
        _LostError: The batch is lost.
    """
    from distributed import KilledWorker
    from lz4.frame import decompress

    with _noticing_loss():
        error = batch.exception()
        if error is None:
            packed, seconds = batch.result()
            return pickle.loads(decompress(packed)), seconds  # noqa: S301 - of the worker that runs our job
    worker = f"a worker of {address}"
    if isinstance(error, CancelledError):
        raise _LostError
    if isinstance(error, ClusterError):
        raise ClusterError(f"{worker} cannot do this work: {error}; {_SAME}")
    if isinstance(error, ToolchainError):
        raise error
    if isinstance(error, KilledWorker):
        raise ClusterError(
            f"the workers of {address} died over the same piece of work, probably for want of memory; start fewer on a "
            "host, or with more memory (--memory-limit)"
        )
    if any(isinstance(each, ImportError | AttributeError) for each in (error, error.__cause__)):
        raise ClusterError(f"{worker} has no rosbayes, or another version of it ({error}); {_SAME}")
    raise ClusterError(f"{worker} failed: {type(error).__name__}: {error}")


_SAME: Final = "install the same version there, and start it again"
