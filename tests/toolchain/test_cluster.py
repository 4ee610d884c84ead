"""Analyses on a dask scheduler: the same bytes as in one process, whatever is killed on the way.

toolchain (a process) ──▶ dask scheduler (a process) ──▶ two dask workers (processes)
"""

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from zlib import crc32

import numpy as np
import pytest

from tests.patience import PROCESS_PATIENCE
from tests.toolchain.builders import corridor
from tests.toolchain.running import build_model, done, toolchain
from toolchain import cluster as clusters
from toolchain.analysis.replay import record_layout
from toolchain.cluster import ClusterError, SchedulerOptions, in_this_process, runner
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
GATE = "tests.toolchain.gated_worker"
FILES = {"tls_ca_file": Path("ca.pem"), "tls_cert": Path("own.pem"), "tls_key": Path("key.pem")}


def wait_until(true, why):
    deadline = time.monotonic() + PROCESS_PATIENCE
    while not true():
        assert time.monotonic() < deadline, why()
        time.sleep(0.05)


class Cluster:
    """A scheduler and workers, each of which can be killed and started again."""

    def __init__(self, folder):
        self.folder = folder
        self.running = []
        self.scheduler, self.port = None, 0

    def start(self, *command, path=ROOT):
        """Start a command whose modules come from a folder; its output goes to a file."""
        with (self.folder / f"{len(self.running)}.log").open("wb") as log:
            process = subprocess.Popen(
                [str(BIN / command[0]), *map(str, command[1:])],
                env=dict(os.environ, PYTHONPATH=str(path), DASK_TEMPORARY_DIRECTORY=str(self.folder)),
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        self.running.append(process)
        return process

    def log(self, process):
        return (self.folder / f"{self.running.index(process)}.log").read_text()

    def start_scheduler(self):
        """Start one; a second has the address of the first."""
        file = self.folder / "scheduler.json"
        file.unlink(missing_ok=True)
        options = (
            "--host",
            "127.0.0.1",
            "--port",
            self.port,
            "--scheduler-file",
            file,
            "--no-show",
            "--no-dashboard",
        )
        process = self.scheduler = self.start("dask", "scheduler", *options)

        def is_there():
            assert process.poll() is None, self.log(process)
            return file.exists() and file.read_text().endswith("}")

        wait_until(is_there, lambda: self.log(process))
        self.address = json.loads(file.read_text())["address"]
        self.port = self.address.rpartition(":")[2]

    def start_worker(self, path=ROOT, preload=None):
        """Start a worker that imports a module first, and wait until the scheduler knows it."""
        options = [
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            *(("--preload", preload) if preload else ()),
        ]
        worker = self.start("dask", "worker", self.address, *options, path=path)
        wait_until(lambda: "Registered to" in self.log(worker), lambda: self.log(worker))
        return worker

    def end(self, process):
        """Wait for the end of a command; return its exit code and its output."""
        wait_until(lambda: process.poll() is not None, lambda: self.log(process))
        return process.returncode, self.log(process)

    def toolchain(self, *arguments):
        return self.end(self.start("toolchain", *arguments))


@pytest.fixture
def cluster(tmp_path):
    folder = tmp_path / "processes"
    folder.mkdir()
    found = Cluster(folder)
    found.start_scheduler()
    yield found
    for process in found.running:
        process.kill()
        process.wait()


@pytest.fixture
def deployment(tmp_path):
    build_model(corridor(), tmp_path / "corridor", partitions=2)
    return tmp_path / "corridor"


@pytest.fixture
def recording(tmp_path):
    """Readings of a corridor; some rows do not fit."""
    rows = [f"{at % 11},{at % 2}" if at % 7 else f"{at},no" for at in range(60)]
    (tmp_path / "recording.csv").write_text("\n".join(["range,loud", *rows]) + "\n")
    return tmp_path / "recording.csv"


@pytest.mark.process
def test_every_analysis_has_the_bytes_of_the_serial_run(cluster, deployment, recording, case, tmp_path):
    for _ in range(2):
        cluster.start_worker()
    found = {}
    for name, where in (
        ("serial", ()),
        ("cluster", ("--scheduler", cluster.address)),
        ("local", ("--scheduler", "local")),
    ):
        folder = tmp_path / name
        folder.mkdir()
        infer = cluster.toolchain(
            "infer", recording, "-d", deployment, "-o", folder / "posteriors.npz", *where
        )
        assert infer[0] == 0, infer[1]
        assert "9 rows have no posterior because they do not fit: row 0: " in infer[1]
        found[name] = [(folder / "posteriors.npz").read_bytes()]
        if name == "local":
            continue
        options = (
            "--frames",
            4,
            "--prob-bits",
            "4,6,8",
            "--targets",
            "15,31",
            "--rngs",
            "lfsr16",
            "--max-cycles",
            500,
        )
        explore = cluster.toolchain("explore", case, "-o", folder / "points.jsonl", *options, *where)
        assert explore[0] == 0, explore[1]
        code, inspected = cluster.toolchain("inspect", deployment, "--json", *where)
        assert code == 0, inspected
        found[name] += [(folder / "points.jsonl").read_bytes(), inspected]
    assert found["cluster"] == found["serial"]
    assert found["local"] == found["serial"][:1]


def kept_frames(file, deployment):
    """The rows that have a record in the file of a run that goes on."""
    _, _, records = file.read_bytes().partition(b"\n") if file.exists() else (b"", b"", b"")
    layout = record_layout(load_deployment(deployment))
    found = np.frombuffer(records[: len(records) // layout.itemsize * layout.itemsize], layout)
    return [row for row, each in enumerate(found) if crc32(each.tobytes()[8:]) == each["crc"]]


def kept_points(file, whole):
    """The machines that have a line in the file of a sweep; `whole` has all in order."""
    lines = file.read_text().splitlines() if file.exists() else []
    return [number for number, line in enumerate(whole.read_text().splitlines()) if line in lines]


@pytest.mark.process
@pytest.mark.parametrize(
    ("command", "killed"),
    [("infer", "worker"), ("infer", "scheduler"), ("infer", "client"), ("explore", "client")],
)
def test_what_was_kept_is_not_done_twice(cluster, deployment, recording, case, tmp_path, command, killed):
    whole, output = tmp_path / "whole.npz", tmp_path / "output.npz"
    if command == "infer":
        arguments = ("infer", recording, "-d", deployment)
    else:
        sizes = ("--prob-bits", "4,6,8", "--targets", "15,31", "--rngs", "lfsr16,lfsr32")
        arguments = ("explore", case, "--frames", 4, *sizes, "--max-cycles", 500)
    done(toolchain(*arguments, "-o", whole))
    pieces = 60 if command == "infer" else len(whole.read_text().splitlines())

    def kept():
        if command == "infer":
            return kept_frames(output.with_name("output.npz.frames"), deployment)
        return kept_points(output, whole)

    def waiting():
        assert client.poll() is None, cluster.log(client)
        return [each for each in workers if (cluster.folder / f"waiting.{each.pid}").exists()]

    workers = [cluster.start_worker(preload=GATE) for _ in range(2)]
    command_line = ("toolchain", *arguments, "-o", output, "--scheduler", cluster.address)
    client = cluster.start(*command_line)
    wait_until(lambda: waiting() and kept(), lambda: cluster.log(client))
    victim = {"worker": waiting()[0], "scheduler": cluster.scheduler, "client": client}[killed]
    victim.kill()
    victim.wait()
    before = kept()
    if killed == "scheduler":
        cluster.start_scheduler()
        cluster.start_worker(preload=GATE)
    elif killed == "client":
        client = cluster.start(*command_line)
    (cluster.folder / "go").touch()
    code, said = cluster.end(client)
    assert code == 0, said
    assert output.read_bytes() == whole.read_bytes()
    computed = [int(line) for line in (cluster.folder / "computed").read_text().splitlines()]
    assert set(computed) == set(range(pieces))
    # dask also does again what a dead worker was not yet told to forget
    assert killed == "worker" or [computed.count(number) for number in before] == [1] * len(before)


@pytest.mark.process
def test_a_worker_with_another_version_is_one_sentence(cluster, deployment, recording, tmp_path):
    other = tmp_path / "other"
    for room in ("machines", "pcie_shim", "terminal", "toolchain"):
        shutil.copytree(ROOT / room, other / room)
    (other / "machines" / "__init__.py").write_text('"""Another version."""\n')
    output = tmp_path / "posteriors.npz"
    infer = ("infer", recording, "-d", deployment, "-o", output, "--scheduler", cluster.address)
    worker = cluster.start_worker(path=other)
    code, said = cluster.toolchain(*infer)
    assert code == 2, said
    assert said.splitlines()[-1].startswith(
        f"error: a worker of {cluster.address} cannot do this work: it has another version"
    )
    worker.kill()
    cluster.scheduler.kill()
    cluster.scheduler.wait()
    code, said = cluster.toolchain(*infer)
    assert code == 2, said
    assert said.splitlines()[-1].startswith(
        f"error: --scheduler {cluster.address}: no scheduler answers there"
    )
    assert not output.exists()


def test_whatever_else_listens_there_is_one_sentence():
    """An SSH server: dask takes its first bytes for the length of a message."""

    def greet(listener):
        with listener.accept()[0] as connection:
            connection.sendall(b"SSH-2.0-OpenSSH_9.2\r\n")
            while connection.recv(4096):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = threading.Thread(target=greet, args=(listener,), daemon=True)
        server.start()
        options = SchedulerOptions(scheduler=f"tcp://127.0.0.1:{listener.getsockname()[1]}")
        with (
            pytest.raises(ClusterError, match="no scheduler answers there, or it wants tls://"),
            runner(options) as run,
        ):
            run(SimpleNamespace(), [1], lambda *_: None)
        server.join(PROCESS_PATIENCE)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"scheduler": "10.0.0.1:8786"}, "expected tcp://HOST:PORT"),
        ({"scheduler": "tcp://10.0.0.1"}, "expected tcp://HOST:PORT"),
        ({"scheduler": "tcp://[::1"}, "expected tcp://HOST:PORT"),
        ({"scheduler": "tcp://10.0.0.1:8786"}, "or --insecure"),
        ({"scheduler": "tcp://127.0.0.1:8786", **FILES}, "--tls-ca-file is for --scheduler tls://"),
        (
            {"scheduler": "tls://10.0.0.1:8786", "tls_cert": Path("own.pem")},
            "needs --tls-ca-file, --tls-key too",
        ),
        ({"scheduler": "tls://10.0.0.1:8786", **FILES}, "^--tls-ca-file ca.pem cannot be used: No such file"),
        ({"scheduler": "local", "tls_key": Path("key.pem")}, "--tls-key is for --scheduler tls://HOST:PORT"),
        ({"tls_key": Path("key.pem")}, "--tls-key is for --scheduler tls://HOST:PORT"),
    ],
)
def test_wrong_flags_of_a_scheduler(options, sentence):
    with pytest.raises(BuildError, match=sentence):
        SchedulerOptions(**options)


@pytest.mark.parametrize(
    ("flag", "content", "sentence"),
    [
        ("tls_ca_file", "garbage", "--tls-ca-file {} cannot be used: "),
        ("tls_cert", "garbage", "--tls-cert {} cannot be used: "),
        ("tls_key", "garbage", "--tls-key {} cannot be used: "),
        ("tls_key", None, "--tls-key {} cannot be used: No such file"),
        ("tls_key", "another", "--tls-key {} cannot be used: "),
    ],
)
def test_the_file_of_tls_that_is_wrong_is_named(tmp_path, flag, content, sentence):
    from distributed import Security

    made, another = Security.temporary(), Security.temporary().tls_client_key
    contents = {
        "tls_ca_file": made.tls_ca_file,
        "tls_cert": made.tls_client_cert,
        "tls_key": made.tls_client_key,
    }
    files = {key: tmp_path / f"{key}.pem" for key in contents}
    for key, text in contents.items():
        files[key].write_text(text)
    SchedulerOptions(scheduler="tls://10.0.0.1:8786", **files)
    if content is None:
        files[flag].unlink()
    else:
        files[flag].write_text(another if content == "another" else content)
    with pytest.raises(BuildError) as caught:
        SchedulerOptions(scheduler="tls://10.0.0.1:8786", **files)
    assert str(caught.value).startswith(sentence.format(files[flag]))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"scheduler": "local"},
        {"scheduler": "tcp://localhost:8786"},
        {"scheduler": "tcp://[::1]:8786"},
        {"scheduler": "tcp://10.0.0.1:8786", "insecure": True},
    ],
)
def test_flags_of_a_scheduler(options):
    SchedulerOptions(**options)


class Squares:
    """A job without tables."""

    def prepare(self):
        return lambda number: number * number


@pytest.mark.process
def test_pieces_left_at_the_end_of_a_batch_are_done_later(cluster, monkeypatch):
    rounds, found, do = [], [], clusters._do
    monkeypatch.setattr(clusters, "_SMALLEST_S", 0.0)  # so the first batches end after one piece each
    monkeypatch.setattr(clusters, "_do", lambda *given: rounds.append(do(*given)))
    cluster.start_worker()
    with runner(SchedulerOptions(scheduler=cluster.address)) as run:
        run(Squares(), range(300), lambda *each: found.append(each))
    assert len(rounds) == 1
    assert sorted(found) == [(number, number * number) for number in range(300)]


def test_work_in_this_process_is_in_order():
    found = []
    job = SimpleNamespace(prepare=lambda: lambda number: number * number)
    in_this_process(job, [30, 2], lambda *each: found.append(each))
    assert found == [(30, 900), (2, 4)]
