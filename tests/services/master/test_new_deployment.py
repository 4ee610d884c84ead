"""A deployment on its way into force: of the same shape, copied whole, held beside the one before."""

import fcntl
import os
import shutil
import subprocess
import sys

import pytest

from pcie_shim.endpoint import Endpoint
from services.errors import NotReloadedError, SettingsError, ShapeError
from services.master.new_deployment import forget, keep, read_new
from services.pipeline.deployed_boards import DeployedBoards
from services.pipeline.generations import Generations
from services.settings import Settings
from services.sockets.records import Hello, NotReloaded, Prepare, Prepared, Switch, Switched
from services.supervision.parent import DIRECTORY_VARIABLE
from services.supervision.private_directory import PrivateDirectory
from terminal.errors import StoppedError
from tests.integration.conftest import build_boat
from toolchain.building.edits import DeploymentEdits
from toolchain.building.regenerate import regenerate_deployment
from toolchain.deployment import load_deployment


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build_boat(tmp_path_factory.mktemp("boat") / "deployment")


@pytest.fixture
def boat(built, tmp_path):
    shutil.copytree(built, tmp_path / "boat")
    return tmp_path / "boat"


def same(deployment):
    return deployment


def edited(boat, **edits):
    before = load_deployment(boat)
    regenerate_deployment(boat, DeploymentEdits(**edits))
    return before


def test_another_target_is_taken(boat):
    before = edited(boat, target_count=99)
    assert read_new(boat, before, same).machine.target_count == 99


def test_another_topic_is_refused_by_name(boat):
    before = edited(boat, topic="/elsewhere")
    with pytest.raises(
        ShapeError, match=r"\[\[source\]\] 0 topic is /boat/sensors in the run and /elsewhere"
    ) as refused:
        read_new(boat, before, same)
    assert refused.value.exit_code == 2


def test_what_flags_override_need_not_be_the_same(boat):
    before = edited(boat, uri="ws://elsewhere:9090")
    with pytest.raises(ShapeError, match="0 uri is"):
        read_new(boat, before, same)

    def as_used(deployment):
        sources = tuple(each.model_copy(update={"uri": "ws://flag:1"}) for each in deployment.sources)
        return deployment.model_copy(update={"sources": sources})

    assert read_new(boat, before, as_used).sources[0].uri == "ws://elsewhere:9090"


def test_a_folder_that_cannot_be(boat):
    with pytest.raises(SettingsError, match="can't be read: File name too long"):
        read_new(boat / ("x" * 300), load_deployment(boat), same)


def test_a_copy_outlives_its_folder(boat, tmp_path):
    loaded = load_deployment(boat)
    kept = keep(loaded, tmp_path, 3)
    shutil.rmtree(boat)
    assert load_deployment(kept).hash == loaded.hash
    forget(tmp_path, 3)
    forget(tmp_path, 3)
    assert not kept.exists()


def test_a_copy_of_what_has_changed_is_refused(boat, tmp_path):
    loaded = edited(boat, target_count=99)
    with pytest.raises(NotReloadedError, match="was changed while it was read"):
        keep(loaded, tmp_path, 1)
    loaded = load_deployment(boat)
    (tmp_path / "file").touch()
    with pytest.raises(NotReloadedError, match=r"deployment\.toml can't be copied .*Not a directory"):
        keep(loaded, tmp_path / "file", 2)


def test_a_signal_that_comes_while_a_service_reads_ends_it(boat):
    loaded = load_deployment(boat)
    held = Generations(loaded, lambda _: None)

    def stopped(_):
        raise StoppedError(143, "terminated")

    held._derive = stopped
    with pytest.raises(StoppedError):
        held.prepare(Prepare(1, str(boat), loaded.hash))


def test_a_signal_that_comes_while_boards_are_programmed_ends_their_process(boat, monkeypatch):
    loaded = load_deployment(boat)
    boards = DeployedBoards(Settings(), loaded, [Endpoint(path="/nowhere")] * len(loaded.boards))

    def stopped():
        raise StoppedError(143, "terminated")

    monkeypatch.setattr(boards, "_whole_cluster", stopped)
    with pytest.raises(StoppedError):
        boards.switch(Switch(0))


def test_a_service_switches_to_what_it_has_prepared(boat):
    before = edited(boat, target_count=99)
    held = Generations(before, lambda deployment: deployment.machine.target_count)
    held.adopt(Hello("master", "", before.hash, 4))
    assert (held.number, held.derived) == (4, 255)
    refused = held.switch(Switch(5))
    assert isinstance(refused, NotReloaded)
    assert refused.sentence == "generation 5 was not prepared here"
    other = held.prepare(Prepare(5, str(boat), before.hash))
    assert isinstance(other, NotReloaded)
    assert "do both see the same folder?" in other.sentence
    missing = held.prepare(Prepare(5, str(boat.parent), before.hash))
    assert isinstance(missing, NotReloaded)
    assert (missing.exit_code, held.number) == (2, 4)
    assert held.prepare(Prepare(5, str(boat), load_deployment(boat).hash)) == Prepared(5)
    assert held.derived == 255
    assert held.switch(Switch(5)) == Switched(5)
    assert held.derived == 99
    assert held.switch(Switch(4)) == Switched(4)  # there is a way back
    assert (held.deployment.hash, held.derived) == (before.hash, 255)


def test_a_damaged_image_is_for_those_who_read_images(boat):
    loaded = load_deployment(boat)
    path = loaded.image_path(2)
    path.write_bytes(path.read_bytes()[:-1])
    record = Prepare(1, str(boat), loaded.hash)
    assert Generations(loaded, same).prepare(record) == Prepared(1)
    refused = Generations(loaded, same, images=True).prepare(record)
    assert isinstance(refused, NotReloaded)
    assert "board2.bm" in refused.sentence
    assert refused.exit_code == 2


def leave(directory):
    code = "from services.supervision.parent import leave_private_directory; leave_private_directory()"
    subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {DIRECTORY_VARIABLE: str(directory)},
        check=True,
        timeout=30,
    )


def test_copies_stay_while_the_master_lives(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", None)
    private = PrivateDirectory()
    (private.path / "deployment-0").mkdir()
    leave(private.path)
    assert (private.path / "deployment-0").is_dir()
    fcntl.flock(private._lock, fcntl.LOCK_UN)  # as the kernel does when the master ends
    leave(private.path)
    assert not private.path.exists()
    private.remove()


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (None, "No such file"),
        (os.mkfifo, "is no file of at most"),
        (os.mkdir, "is no file of at most"),
        (lambda path: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), (1 << 28) + 1), "at most 256 MiB"),
    ],
    ids=["not there", "pipe", "folder", "huge"],
)
def test_an_image_that_is_none_is_the_folders_fault(boat, tmp_path, made, said):
    loaded = load_deployment(boat)
    image = loaded.image_path(1)
    image.unlink()
    if made is not None:
        made(image)
    with pytest.raises(SettingsError, match=said) as refused:
        keep(loaded, tmp_path, 1)
    assert str(image) in str(refused.value)
    assert refused.value.exit_code == 2
