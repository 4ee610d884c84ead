"""Independent pieces of work, in this process or on the workers of a dask scheduler (the extra `cluster`).

    this process                          scheduler           workers
    job, once ────────────────────────────────┼─────────────▶ prepare(): tables and kernels, once for each
    batches of numbers, half a second each ───┼─────────────▶ work(number) for each number
    keep(number, result) ◀────────────────────┴────────────── as batches are done, in any order

A piece is a number, so that only the job has tables. Results depend on job and number alone, not on the place or the
order. Whoever keeps results on disk can begin again with the numbers that are missing.
"""

import asyncio
import logging
import pickle
import ssl
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from hashlib import sha256
from importlib import metadata
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import get_ident
from typing import Annotated, Any, Final, Protocol, TypeAlias
from urllib.parse import urlsplit

import typer

from toolchain.errors import BuildError, ToolchainError

Work: TypeAlias = Callable[[int], Any]
Keep: TypeAlias = Callable[[int, Any], None]

BATCH_S: Final = 2.0
"""Maximum number of seconds of work in a batch, so that dask's share of about 15 ms of CPU time for each is small."""
_SMALLEST_S: Final = BATCH_S / 20
"""The same at the end, so that the workers finish at about the same time, and until their speed is known."""
_FIRST: Final = 100
"""Maximum number of pieces in a batch until their speed is known."""
_AHEAD: Final = 3
"""Batches on their way for each worker: one that is computed, one that waits there, and one at the scheduler."""
_LATELY: Final = 4
"""Batches whose speed decides on the number of pieces in the next."""
_PATIENCE_S: Final = 60.0
"""Seconds in which a scheduler must come back, or get a worker again."""
_CONNECT_S: Final = 10.0
_POLL_S: Final = 1.0
_COUNT_S: Final = 5.0
"""Seconds between two counts of the workers."""
_LEAN: Final = {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "1s"}
"""Settings of our own scheduler and workers: by dask's, each spends 3 to 5 % of a core on watching itself."""
_JOBS: Final = 8
"""Jobs that a worker keeps prepared, for each of its threads."""


class Job(Protocol):
    """Pieces of work with the same tables. A job is pickled, and so is every result."""

    def prepare(self) -> Work:
        """Return the function that does the piece of a number."""


class Run(Protocol):
    """A way to do the pieces of a job."""

    def __call__(self, job: Job, numbers: Sequence[int], keep: Keep) -> None:
        """Do the pieces of these numbers, and call `keep` with each result as soon as it is there."""


def in_this_process(job: Job, numbers: Sequence[int], keep: Keep) -> None:
    """Do the pieces in this process, in order."""
    work = job.prepare() if numbers else None
    for number in numbers:
        keep(number, work(number) if work else None)


class ClusterError(ToolchainError):
    """A scheduler that cannot be used, or workers that cannot do the work."""


@dataclass(frozen=True, kw_only=True)
class SchedulerOptions:
    """The place where independent pieces of work are done: this process or a cluster."""

    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Do the work on the workers of a dask scheduler; local: one worker for each core of this host.",
            metavar="tcp://HOST:PORT|tls://HOST:PORT|local",
            show_default="in this process",
        ),
    ] = None
    tls_ca_file: Annotated[
        Path | None,
        typer.Option(help="Of tls://: certificates (PEM) that sign the scheduler's.", metavar="FILE"),
    ] = None
    tls_cert: Annotated[
        Path | None, typer.Option(help="Of tls://: our certificate (PEM).", metavar="FILE")
    ] = None
    tls_key: Annotated[Path | None, typer.Option(help="Of tls://: its key (PEM).", metavar="FILE")] = None
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Permit tcp:// to a scheduler on another host.")
    ] = False

    def __post_init__(self) -> None:
        """Refuse flags that contradict each other."""
        files = {"--tls-ca-file": self.tls_ca_file, "--tls-cert": self.tls_cert, "--tls-key": self.tls_key}
        if self.scheduler in (None, "local"):
            given = [flag for flag, file in files.items() if file is not None]
            if given:
                raise BuildError(f"{given[0]} is for --scheduler tls://HOST:PORT")
            return
        try:
            parts = urlsplit(self.scheduler)
            ok = parts.scheme in ("tcp", "tls") and bool(parts.hostname) and parts.port is not None
        except ValueError:
            ok = False
        if not ok:
            raise BuildError(
                f"--scheduler {self.scheduler}: expected tcp://HOST:PORT or tls://HOST:PORT, as the scheduler prints it, or "
                "local"
            )
        missing = [flag for flag, file in files.items() if file is None]
        if parts.scheme == "tls" and missing:
            raise BuildError(f"--scheduler {self.scheduler} needs {', '.join(missing)} too")
        if parts.scheme == "tls":
            _check_certificates(files)
        if parts.scheme == "tcp" and len(missing) < len(files):
            raise BuildError(f"--scheduler {self.scheduler} does not use TLS: write tls:// instead of tcp://")
        if parts.scheme == "tcp" and not self.insecure and not _is_loopback(parts.hostname or ""):
            raise BuildError(
                f"--scheduler {self.scheduler}: without TLS, everybody on the way there can run programs as this user; use "
                "tls:// with --tls-ca-file, --tls-cert and --tls-key, or --insecure"
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
            if isinstance(reason, ssl.SSLError) and reason.reason == "KEY_VALUES_MISMATCH":
                raise BuildError(
                    f"{flag} {file} is not the key of --tls-cert {files['--tls-cert']}"
                ) from None
            raise BuildError(f"{flag} {file} cannot be used: {reason.strerror or reason}") from None


def _is_loopback(host: str) -> bool:
    with suppress(ValueError):
        return ip_address(host).is_loopback
    return host == "localhost"


@contextmanager
def runner(options: SchedulerOptions) -> Iterator[Run]:
    """Yield the way to do work that the options ask for, or raise a ClusterError."""
    if options.scheduler is None:
        yield in_this_process
        return
    try:
        import dask
        import lz4.frame  # noqa: F401 - only whether it is there
        from distributed import Client, LocalCluster, Security
    except ImportError:
        raise ClusterError("--scheduler needs dask: pip install 'rosbayes[cluster]'") from None
    except ValueError as reason:
        raise ClusterError(
            f"dask cannot be used: {str(reason).splitlines()[0]}"
        ) from None  # a damaged file of its settings
    # log lines of dask on standard error repeat what is said here
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    if options.scheduler == "local":
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
                yield _OnScheduler("local", lambda: Client(local))
        return
    address, security = options.scheduler, Security()
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

    yield _OnScheduler(address, connect)


async def _greet(address: str, arguments: dict[str, Any]) -> None:
    """Raise an OSError if no scheduler answers at an address."""
    from distributed.comm import connect

    try:
        comm = await connect(address, timeout=_CONNECT_S, **arguments)
        try:
            await comm.write({"op": "identity"})
            is_scheduler = (await comm.read()).get("type") == "Scheduler"
        finally:
            comm.abort()
    except Exception as reason:  # whatever dask makes of another protocol
        raise OSError(str(reason)) from None
    if not is_scheduler:
        raise OSError("another part of dask")


@cache
def software() -> str:
    """Return a hash of everything here on which results depend: our modules, NumPy and Numba."""
    digest = sha256()
    for name in ("numpy", "numba", "scipy"):
        with suppress(metadata.PackageNotFoundError):
            digest.update(f"{name} {metadata.version(name)}\n".encode())
    root = Path(__file__).parent.parent
    for folder in ("machines", "pcie_shim", "toolchain"):
        for path in sorted((root / folder).rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


@lru_cache(_JOBS)
def _prepared(pickled: bytes, _thread: int) -> Work:
    """Return the work of a job, which each thread of a worker prepares once: two cannot share a kernel."""
    job: Job = pickle.loads(pickled)  # noqa: S301 - dask runs whatever its client sends anyway
    return job.prepare()


def do_batch(pickled: bytes, numbers: Sequence[int], most_s: float, theirs: str) -> tuple[bytes, float]:
    """Do pieces on a worker for `most_s` seconds, but at least one; return their results and the seconds.

    The results are pickled and compressed: a posterior is mostly zeros, and would pass through the scheduler as it is.

    Raises:
        ClusterError: This worker has another version of our software than the client.
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
    """Convert what dask's client raises when its connection is lost or being closed, and for results that are lost."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, CancelledError):
        raise _LostError from None


class _OnScheduler:
    """Work on the workers of a scheduler; what was not done when it disappeared is given to the next one."""

    def __init__(self, address: str, connect: Callable[[], Any]) -> None:
        self._address = address
        self._connect = connect

    def __call__(self, job: Job, numbers: Sequence[int], keep: Keep) -> None:
        """Do the pieces on the workers; a ClusterError if they cannot, or if they stay away for a minute."""
        left = dict.fromkeys(numbers)  # in order; those without a result

        def keep_once(number: int, result: Any) -> None:
            keep(number, result)
            del left[number]

        pickled = pickle.dumps(job)
        # Until when (monotonic) a scheduler may take to answer, 0 for the first time; and when a piece was last done.
        until, progress_at = 0.0, time.monotonic()
        while left:
            before, client = len(left), self._client(until)
            try:
                _do(self._address, client, pickled, left, keep_once)
            except _LostError:
                until = time.monotonic() + _PATIENCE_S
                if len(left) < before:
                    progress_at = time.monotonic()
                if time.monotonic() > progress_at + _PATIENCE_S:
                    raise ClusterError(
                        f"--scheduler {self._address} lost this work again and again; read the logs of its workers"
                    ) from None
                print(
                    f"{self._address} lost the work; waiting for it with {len(left)} pieces left",
                    file=sys.stderr,
                )
            finally:
                with suppress(_LostError), _noticing_loss():
                    client.close(timeout=_POLL_S)

    def _client(self, until: float = 0.0) -> Any:
        """Return a client of a scheduler that has a worker; try until a monotonic time."""
        while True:
            client = None
            try:
                client = self._connect()
                client.wait_for_workers(1, timeout=_CONNECT_S)
            except (OSError, ValueError):
                if client is not None:
                    client.close(timeout=_POLL_S)
                if time.monotonic() < until:
                    time.sleep(_POLL_S)
                    continue
                if client is None:
                    tls = "wants other certificates" if self._address.startswith("tls:") else "wants tls://"
                    why = f"no scheduler answers there, or it {tls}; start one with 'dask scheduler', or correct the flags"
                else:
                    why = (
                        f"it has no worker; start one with 'dask worker {self._address} --nthreads 1', or read the log of one "
                        "that has ended"
                    )
                raise ClusterError(f"--scheduler {self._address}: {why}") from None
            else:
                return client


def _do(address: str, client: Any, pickled: bytes, left: Iterable[int], keep: Keep) -> None:
    """Do the pieces of a job on the workers of one scheduler; a `_LostError` if that cannot go on here."""
    from distributed import wait

    # Numbers that are not on their way yet, in order; and the numbers of each batch that is.
    waiting, batches = deque(left), dict[Any, list[int]]()
    # Pieces and seconds of the last batches; a worker's first pieces are slow, so larger batches count for more.
    done_lately = deque[tuple[int, float]](maxlen=_LATELY)
    # Pieces that are done at the same time, and when that was counted; and when there was a worker (monotonic).
    threads, counted_at, served_at = 0, 0.0, time.monotonic()
    with _noticing_loss():
        # a copy for each worker, so that the job outlives each of them; one that comes later fetches it from these
        table = client.scatter(pickled, broadcast=True, hash=False)
    try:
        while waiting or batches:
            now = time.monotonic()
            if not threads or now > counted_at + _COUNT_S:
                with _noticing_loss():
                    threads, counted_at = sum(client.nthreads().values()), now
            if threads:
                served_at = now
            elif now > served_at + _PATIENCE_S:
                raise _LostError
            while waiting and len(batches) < _AHEAD * max(1, threads):
                share, most_s = len(waiting) / (2 * max(1, threads)), _SMALLEST_S
                size = min(_FIRST, share)
                if done_lately:
                    piece_s = sum(s for _, s in done_lately) / sum(pieces for pieces, _ in done_lately)
                    size, most_s = min(BATCH_S / piece_s, max(_SMALLEST_S / piece_s, share)), BATCH_S
                numbers = [waiting.popleft() for _ in range(max(1, min(round(size), len(waiting))))]
                with _noticing_loss():
                    batch = client.submit(do_batch, table, numbers, most_s, software(), pure=False)
                    batches[batch] = numbers
            with _noticing_loss():
                try:
                    done = wait(list(batches), timeout=_POLL_S, return_when="FIRST_COMPLETED").done
                except TimeoutError:
                    if client.status != "running":
                        raise
                    continue
            for batch in done:
                results, seconds = _results(address, batch)
                numbers = batches.pop(batch)
                done_lately.append((len(results), seconds))
                waiting.extendleft(reversed(numbers[len(results) :]))
                batch.release()  # or dask would compute it again if its worker died now
                for number, result in zip(numbers, results, strict=False):
                    keep(number, result)
    finally:
        with suppress(_LostError), _noticing_loss():
            client.cancel(list(batches))


def _results(address: str, batch: Any) -> tuple[list[Any], float]:
    """Return the results of a batch; a ToolchainError if it failed, a `_LostError` if it is gone."""
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
