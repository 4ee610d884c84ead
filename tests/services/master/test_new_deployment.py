"""A new deployment before it is in force: its shape, its complete copy, and the previous one next to it."""

import fcntl
import os
import shutil
import subprocess
import sys

import pytest

from pcie_shim.endpoint import Endpoint
from services.boards.deployed import DeployedBoards
from services.errors import NotPreparedError, NotReloadedError, SettingsError, ShapeError
from services.master.new_deployment import forget, keep, read_new
from services.pipeline.generations import Generations
from services.settings import Settings
from services.sockets.records import Hello, NotReloaded, Prepare, Prepared, Switch, Switched
from services.supervision.parent import DIRECTORY_VARIABLE
from terminal.errors import ExitCode, StoppedError
from terminal.private_directory import PrivateDirectory
from tests.patience import PROCESS_PATIENCE
from toolchain.building.regenerate import DeploymentEdits, regenerate_deployment
from toolchain.deployment import load_deployment


@pytest.fixture
def folder(built, tmp_path):
    shutil.copytree(built, tmp_path / "boat")
    return tmp_path / "boat"


@pytest.fixture
def loaded(folder):
    return load_deployment(folder)


def same(deployment):
    return deployment


def edit(folder, **edits):
    regenerate_deployment(folder, DeploymentEdits(**edits))


def test_a_deployment_of_another_shape_is_refused_by_the_fields_name(folder, loaded):
    edit(folder, target_count=99)
    assert read_new(folder, loaded, same).machine.target_count == 99
    edit(folder, uri="ws://elsewhere:9090")
    with pytest.raises(ShapeError) as refused:
        read_new(folder, loaded, same)
    assert "[[source]] 0 uri is " in str(refused.value)
    assert "shape" not in str(refused.value)  # the machine is the same

    def as_used(deployment):
        sources = tuple(each.model_copy(update={"uri": "ws://flag:1"}) for each in deployment.sources)
        return deployment.model_copy(update={"sources": sources})

    # a field that a flag overrides may differ
    assert read_new(folder, loaded, as_used).sources[0].uri == "ws://elsewhere:9090"
    with pytest.raises(SettingsError):
        read_new(folder / ("x" * 300), loaded, same)


def test_a_copy_outlives_its_folder(folder, loaded, tmp_path):
    kept = keep(loaded, tmp_path, 3)
    shutil.rmtree(folder)
    assert load_deployment(kept).hash == loaded.hash
    forget(tmp_path, 3)
    forget(tmp_path, 3)
    assert not kept.exists()


def test_a_copy_that_fails_is_not_the_folders_fault(folder, loaded, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(NotReloadedError):
        keep(loaded, tmp_path / "file", 2)
    edit(folder, target_count=99)
    with pytest.raises(NotReloadedError):
        keep(loaded, tmp_path, 1)


@pytest.mark.parametrize(
    "make",
    [
        lambda _: None,
        os.mkfifo,
        os.mkdir,
        lambda path: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), (1 << 28) + 1),
    ],
    ids=["not there", "pipe", "folder", "huge"],
)
def test_an_image_that_is_not_a_file_is_the_folders_fault(loaded, tmp_path, make):
    image = loaded.image_path(1)
    image.unlink()
    make(image)
    with pytest.raises(SettingsError) as refused:
        keep(loaded, tmp_path, 1)
    assert str(image) in str(refused.value)


# --- in the services -------------------------------------------------------------------------------


def stopped(*_):
    raise StoppedError(ExitCode.TERMINATED, "terminated")


def test_a_signal_ends_a_service_that_reads_or_programs(folder, loaded, monkeypatch):
    held = Generations(loaded, lambda _: None)
    held._derive = stopped
    with pytest.raises(StoppedError):
        held.prepare(Prepare(1, str(folder), loaded.hash))
    boards = DeployedBoards(Settings(), loaded, [Endpoint(path="/nowhere")] * len(loaded.boards))
    monkeypatch.setattr(boards, "_whole_cluster", stopped)
    with pytest.raises(StoppedError):
        boards.switch(Switch(0))


def test_no_canary_is_posted_without_canaries(loaded):
    boards = DeployedBoards(Settings(), loaded, [Endpoint(path="/nowhere")] * len(loaded.boards))
    with pytest.raises(ValueError, match="integrity"):
        boards.post_canary()


def test_a_service_switches_to_a_prepared_deployment(folder, loaded):
    edit(folder, target_count=99)
    held = Generations(loaded, lambda deployment: deployment.machine.target_count)
    held.adopt(Hello("master", "", loaded.hash, 4))
    assert (held.number, held.derived) == (4, 255)
    refusals = [
        held.switch(Switch(5)),
        held.prepare(Prepare(5, str(folder), loaded.hash)),  # of another hash
        held.prepare(Prepare(5, str(folder.parent), loaded.hash)),  # does not exist
    ]
    assert [(type(each), each.generation) for each in refusals] == [(NotReloaded, 5)] * 3
    assert {each.exit_code for each in refusals} == {NotPreparedError.exit_code}
    assert held.prepare(Prepare(5, str(folder), load_deployment(folder).hash)) == Prepared(5)
    assert (held.number, held.derived) == (4, 255)
    assert held.switch(Switch(5)) == Switched(5)
    assert held.derived == 99
    assert held.switch(Switch(4)) == Switched(4)  # there is a way back
    assert (held.deployment.hash, held.derived) == (loaded.hash, 255)


def test_a_damaged_image_concerns_the_service_that_reads_images(folder, loaded):
    path = loaded.image_path(2)
    path.write_bytes(path.read_bytes()[:-1])
    record = Prepare(1, str(folder), loaded.hash)
    assert Generations(loaded, same).prepare(record) == Prepared(1)
    refused = Generations(loaded, same, images=True).prepare(record)
    assert isinstance(refused, NotReloaded)
    assert path.name in refused.sentence
    assert refused.exit_code == ExitCode.USAGE


@pytest.mark.thorough
def test_copies_stay_while_the_master_lives(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def leave(directory):
        code = "from services.supervision.parent import leave_private_directory; leave_private_directory()"
        environment = os.environ | {DIRECTORY_VARIABLE: str(directory)}
        subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=PROCESS_PATIENCE)

    private = PrivateDirectory()
    (private.path / "deployment-0").mkdir()
    leave(private.path)
    assert (private.path / "deployment-0").is_dir()
    fcntl.flock(private._lock, fcntl.LOCK_UN)  # as the kernel does when the master ends
    leave(private.path)
    assert not private.path.exists()
    private.remove()
