"""Work on a dask scheduler, compared with this work in one process: a sweep of designs, and a recording.

alone      ─▶ work(in_this_process)
at once    ─▶ work(in_this_process) in a process on each core: what the machine can do
            this process ─▶ scheduler ─▶ a worker on each core                efficiency = alone / (cores * seconds)
hosts 1-4  ─▶ scheduler ─▶ a worker in each of several network namespaces     bytes on the wire

A round measures each setting once, one after the other. The tables show the medians of the rounds.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from casestudies.boat.model import model as boat
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from terminal.ending import outcome
from terminal.errors import ProcessError
from toolchain.analysis import Sweep
from toolchain.analysis.logic import device_named
from toolchain.analysis.readings import Frames, sample_readings
from toolchain.analysis.replay import replay
from toolchain.analysis.sweep import Results, SweepJob, run_sweep, tasks
from toolchain.building.build import build_deployment
from toolchain.building.machine import plan_machine
from toolchain.building.options import BuildOptions
from toolchain.cluster import Run, SchedulerOptions, in_this_process, runner
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError

AIM: Final = 0.95
"""Efficiency that `--check` requires of two workers on two cores, against two processes without dask."""
NETWORK: Final = "10.213.7"
"""First three parts of the namespaces' IPv4 addresses; the scheduler's host has the last part 1."""
TASKS: Final = 2000
"""Number of empty tasks with which the scheduler is measured."""
START_S: Final = 60.0
LEAN: Final = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
}
"""Settings of dask that docs/how-to/cluster.md recommends."""


class Designs:
    """A sweep over some machines for the boat. The sweep's file of results must not exist yet."""

    def __init__(self, folder: Path, designs: int, frames: int) -> None:
        model, device = boat().model(), device_named("proce-v-d8")
        sweep = Sweep(
            prob_bits="4,5,6,7,8",
            targets="15,31,63,127,255,511",
            rngs="lfsr8,lfsr16,lfsr24,lfsr32",
            scales="address,column",
        )
        readings = sample_readings(model, frames, seed=1)
        self._job = SweepJob(tasks(model, sweep, readings, device)[:designs], readings, device, sweep.banks)
        self.output = folder / "points.jsonl"

    def __call__(self, run: Run) -> None:
        """Measure all designs."""
        run_sweep(self._job, run, Results(self.output), lambda _: None)


class Recording:
    """A recording of the boat, from its frames to the file of posteriors."""

    def __init__(self, folder: Path, frames: int) -> None:
        model = boat().model()
        options = BuildOptions(
            uri="ws://robot:9090", topic="/boat/sensors", type="boat_msgs/Sensors", partitions=4
        )
        build_deployment(plan_machine(model, options), folder)
        self._deployment, self.output = load_deployment(folder), folder / "posteriors.npz"
        self._frames = Frames(
            sample_readings(model, frames, seed=1), np.ones(frames, bool), np.arange(frames)
        )

    def __call__(self, run: Run) -> None:
        """Compute all frames, and write their posteriors."""
        replay(self._deployment, self._frames, self.output, run)


class Hosts:
    """A scheduler and workers of one core each, all on this host, or each in its own network namespace."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[subprocess.Popen[bytes]] = []
        self.address = ""

    def _start(self, *command: str) -> None:
        settings = os.environ | LEAN
        with (self._folder / f"{len(self._running)}.log").open("wb") as log:
            started = subprocess.Popen(command, stdout=log, stderr=log, cwd=self._folder, env=settings)
            self._running.append(started)

    @contextmanager
    def serving(self, workers: int, *, namespaces: bool) -> Iterator[str]:
        """Within the context, run a dask scheduler and workers. Yield the address of the scheduler.

        With `namespaces`, each worker runs in a network namespace of its own. Worker n has the address
        NETWORK.(n + 2).
        """
        dask = str(Path(sys.executable).with_name("dask"))
        host, names = "127.0.0.1", [f"rosbayes{at}" for at in range(workers)] if namespaces else []
        try:
            if namespaces:
                host = f"{NETWORK}.1"
                _ip("link", "add", "rosbayes", "type", "bridge")
                _ip("address", "add", f"{host}/24", "dev", "rosbayes")
                _ip("link", "set", "rosbayes", "up")
            for at, name in enumerate(names):
                _ip("netns", "add", name)
                _ip("link", "add", name, "type", "veth", "peer", "name", "eth0", "netns", name)
                _ip("link", "set", name, "master", "rosbayes", "up")
                _ip("-n", name, "address", "add", f"{NETWORK}.{at + 2}/24", "dev", "eth0")
                _ip("-n", name, "link", "set", "eth0", "up")
                _ip("-n", name, "link", "set", "lo", "up")
            file = self._folder / "scheduler.json"
            file.unlink(missing_ok=True)  # of the scheduler before
            self._start(
                dask,
                "scheduler",
                "--host",
                host,
                "--port",
                "0",
                "--scheduler-file",
                str(file),
                "--no-dashboard",
                "--no-show",
            )
            address = _address_in(file)
            cores = sorted(os.sched_getaffinity(0))
            for at in range(workers):
                inside = ("ip", "netns", "exec", names[at]) if namespaces else ()
                pinned = ("taskset", "-c", str(cores[at % len(cores)]))
                self._start(
                    *inside,
                    *pinned,
                    dask,
                    "worker",
                    address,
                    "--nthreads",
                    "1",
                    "--no-nanny",
                    "--no-dashboard",
                    "--memory-limit",
                    "0",
                )
            yield address
        finally:
            for process in self._running:
                process.kill()
            for process in self._running:
                process.wait()
            self._running.clear()
            for name in names:
                with suppress(ProcessError):
                    _ip("link", "delete", name)  # at once, while a namespace ends its own some time later
                with suppress(ProcessError):
                    _ip("netns", "delete", name)
            if namespaces:
                with suppress(ProcessError):
                    _ip("link", "delete", "rosbayes")


def _ip(*arguments: str) -> None:
    ran = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if ran.returncode:
        raise ProcessError(f"ip {' '.join(arguments)}: {ran.stderr.strip()}")


def _address_in(file: Path) -> str:
    until = time.monotonic() + START_S
    while time.monotonic() < until:
        with suppress(OSError, ValueError):
            return str(json.loads(file.read_text())["address"])
        time.sleep(0.05)
    raise ProcessError(f"the scheduler did not write {file}")


def seconds_of(work: Designs | Recording, run: Run) -> float:
    """Return the time of some work, after removing its output: ext4 takes 0.2 s longer to replace a large file."""
    work.output.unlink(missing_ok=True)
    begun = time.perf_counter()
    work(run)
    return time.perf_counter() - begun


def seconds_at_once(kind: Callable[[Path], Designs | Recording], folder: Path, cores: Sequence[int]) -> float:
    """Return the time in which a process on each core does the whole work, all at the same time."""
    context = multiprocessing.get_context("fork")
    together, found = context.Barrier(len(cores)), context.SimpleQueue()

    def do(core: int) -> None:
        os.sched_setaffinity(0, {core})
        own = folder / f"core{core}"
        own.mkdir(exist_ok=True)
        work = kind(own)
        together.wait()
        found.put(seconds_of(work, in_this_process))

    processes = [context.Process(target=do, args=(core,)) for core in cores]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        if process.exitcode:
            raise ProcessError("a process without dask failed")
    return max(float(found.get()) for _ in cores)


def load_kernels(designs: int) -> None:
    """Do a little of the work that is measured, so that this process has compiled or loaded all kernels."""
    with tempfile.TemporaryDirectory(prefix="bench-cluster-") as name:
        for work in (Designs(Path(name), designs, 1), Recording(Path(name), 1)):
            work(in_this_process)


def tasks_per_second(address: str, workers: int, designs: int) -> float:
    """Load the kernels on all workers; return how many empty tasks a scheduler does in a second."""
    from distributed import Client

    with Client(address) as client:
        client.wait_for_workers(workers, timeout=START_S)
        client.run(load_kernels, designs)
        client.gather(client.map(int, range(100), pure=False))
        begun = time.perf_counter()
        client.gather(client.map(int, range(TASKS), pure=False))
        return TASKS / (time.perf_counter() - begun)


def _sent(name: str) -> int:
    """Return the bytes that have passed a network interface, in both directions."""
    folder = Path("/sys/class/net", name, "statistics")
    return sum(int((folder / f"{way}_bytes").read_text()) for way in ("rx", "tx"))


def measure(arguments: argparse.Namespace, folder: Path) -> float:
    """Measure everything, and return the lowest efficiency of two workers on this host."""
    kinds: dict[str, Callable[[Path], Designs | Recording]] = {
        f"{arguments.designs} designs": lambda own: Designs(own, arguments.designs, arguments.sweep_frames),
        f"{arguments.frames:,} frames": lambda own: Recording(own / "boat", arguments.frames),
    }
    load_kernels(arguments.designs)
    cores = sorted(os.sched_getaffinity(0))
    works = {name: kind(folder) for name, kind in kinds.items()}
    rows = list[list[str]]()
    columns = ["work", "workers", "hosts", "alone", "at once", "seconds"]
    columns += ["to one alone", "to all at once", "bytes a batch"]
    lowest, rate = 2.0, 0.0
    for workers, namespaces in ((2, False), (1, True), (2, True), (4, True)):
        used, hosts = min(workers, len(cores)), str(workers) if namespaces else "this one"
        try:
            with (
                Hosts(folder).serving(workers, namespaces=namespaces) as address,
                runner(SchedulerOptions(scheduler=address, insecure=True)) as run,
            ):
                done = tasks_per_second(address, workers, arguments.designs)
                rate = rate or done
                Recording(folder / "first", 1)(run)  # the scheduler loads our modules, once in its life
                for name, work in works.items():
                    rounds, sent, batches = list[tuple[float, ...]](), 0, 0
                    for _ in range(1 if namespaces else arguments.rounds):
                        # one after the other, because the speed of a core changes; with others in use, too
                        alone = seconds_at_once(kinds[name], folder, cores[:1])
                        together = seconds_at_once(kinds[name], folder, cores[:used]) if used > 1 else alone
                        before = sum(_sent(f"rosbayes{at}") for at in range(workers)) if namespaces else 0
                        with counted_batches() as submitted:
                            took = seconds_of(work, run)
                        if namespaces:
                            sent += sum(_sent(f"rosbayes{at}") for at in range(workers)) - before
                            batches += len(submitted)
                        rounds.append(
                            (alone, together, took, alone / (used * took), together / (used * took))
                        )
                    *seconds, serial, busy = np.median(rounds, axis=0).tolist()
                    lowest = lowest if namespaces else min(lowest, busy)
                    cells = [f"{each:.1f}" for each in seconds]
                    cells += [f"{serial:.0%}", f"{busy:.0%}", f"{sent / batches:,.0f}" if sent else "-"]
                    rows.append([name, str(workers), hosts, *cells])
        except ProcessError as reason:
            if not namespaces:
                raise
            print(f"no network namespaces here: {reason}")
            break
    print_table("efficiency: seconds in one process / (cores x seconds)", columns, rows)
    print(f"The scheduler does {rate:,.0f} empty tasks/s.")
    return lowest


@contextmanager
def counted_batches() -> Iterator[list[int]]:
    """Yield a list to which each batch submitted to the scheduler adds an element."""
    from distributed import Client

    submit, found = Client.submit, list[int]()

    def counting(self: Any, *given: Any, **options: Any) -> Any:
        found.append(1)
        return submit(self, *given, **options)

    Client.submit = counting
    try:
        yield found
    finally:
        Client.submit = submit


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench cluster",
        description="Print the efficiency of a sweep and a recording on dask workers, against one process.",
    )
    parser.add_argument("--designs", type=int, default=200, help="number of designs of the boat")
    parser.add_argument("--sweep-frames", type=int, default=20, help="number of frames of each design")
    parser.add_argument("--frames", type=int, default=20_000, help="number of frames of the recording")
    parser.add_argument("--rounds", type=int, default=3, help="rounds on this host; one on namespaces")
    parser.add_argument(
        "--check", action="store_true", help=f"fail below {AIM:.0%} on two cores of this host"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-cluster-") as name:
        lowest = measure(arguments, Path(name))
    if arguments.check and lowest < AIM:
        raise BuildError(f"the efficiency is {lowest:.1%}, expected {AIM:.0%} or more")
    return 0


if __name__ == "__main__":
    sys.exit(outcome(main))
