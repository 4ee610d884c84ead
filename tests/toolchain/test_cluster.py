"""Analyses on a dask scheduler: the same bytes as in one process, whatever is killed on the way.

toolchain or cluster_client (a process) ──▶ dask scheduler (a process) ──▶ two dask workers (processes)
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE
from tests.toolchain import cluster_client
from tests.toolchain.builders import corridor
from tests.toolchain.running import build_model
from toolchain.cluster import SchedulerOptions, in_this_process
from toolchain.errors import BuildError

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
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

    def start_worker(self, path=ROOT):
        """Start a worker, and wait until the scheduler knows it."""
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard")
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


@pytest.mark.process
@pytest.mark.parametrize("killed", ["worker", "scheduler", "client"])
def test_nothing_is_lost_and_nothing_done_twice(cluster, tmp_path, killed):
    worker, _ = cluster.start_worker(), cluster.start_worker()
    command = ("python", "-m", "tests.toolchain.cluster_client", cluster.address, tmp_path)
    client = cluster.start(*command)

    def is_in_the_middle():
        assert client.poll() is None, cluster.log(client)
        return cluster_client.kept(tmp_path)

    wait_until(is_in_the_middle, lambda: cluster.log(client))
    {"worker": worker, "scheduler": cluster.scheduler, "client": client}[killed].kill()
    if killed == "scheduler":
        cluster.scheduler.wait()
        cluster.start_scheduler()
        cluster.start_worker()
    elif killed == "client":
        assert client.wait() == -signal.SIGKILL
        client = cluster.start(*command)
    (tmp_path / "go").touch()
    code, said = cluster.end(client)
    assert code == 0, said
    assert sorted(cluster_client.kept(tmp_path)) == list(range(cluster_client.NUMBERS))
    # a killed worker may have been the only one with the job
    assert "lost the work" in said or killed != "scheduler"


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


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"scheduler": "10.0.0.1:8786"}, "expected tcp://HOST:PORT"),
        ({"scheduler": "tcp://10.0.0.1"}, "expected tcp://HOST:PORT"),
        ({"scheduler": "tcp://[::1"}, "expected tcp://HOST:PORT"),
        ({"scheduler": "tcp://10.0.0.1:8786"}, "or --insecure"),
        ({"scheduler": "tcp://127.0.0.1:8786", **FILES}, "write tls:// instead"),
        (
            {"scheduler": "tls://10.0.0.1:8786", "tls_cert": Path("own.pem")},
            "needs --tls-ca-file, --tls-key too",
        ),
        (
            {"scheduler": "tls://10.0.0.1:8786", **FILES},
            "one of ca.pem, own.pem, key.pem cannot be used: No such file",
        ),
        ({"scheduler": "local", "tls_key": Path("key.pem")}, "--tls-key is for --scheduler tls://HOST:PORT"),
        ({"tls_key": Path("key.pem")}, "--tls-key is for --scheduler tls://HOST:PORT"),
    ],
)
def test_wrong_flags_of_a_scheduler(options, sentence):
    with pytest.raises(BuildError, match=sentence):
        SchedulerOptions(**options)


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


def test_work_in_this_process_is_in_order(tmp_path):
    (tmp_path / "go").touch()
    found = []
    in_this_process(cluster_client.Squares(tmp_path), [30, 2], lambda *each: found.append(each))
    assert found == [(30, 900), (2, 4)]
