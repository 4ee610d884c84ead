"""Private directories: their owner, and the removal of those of killed masters only."""

import socket
import sys

import pytest

from terminal.private_directory import PrivateDirectory, make_private_directory


@pytest.mark.parametrize("runtime", ["", ".", "relative", "/nonexistent", sys.executable, "/" + "x" * 60])
def test_a_runtime_directory_that_is_none_is_passed_over(tmp_path, monkeypatch, runtime):
    (tmp_path / "relative").mkdir()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "other"))
    made = make_private_directory()
    assert (made.parent, made.stat().st_mode & 0o777) == (tmp_path / "other", 0o700)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The directory of all run directories in this test."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def left_by_a_killed_master(place, name, *, mode=0o700):
    """Create a directory as left after a SIGKILL, with a dead socket."""
    directory = place / name
    directory.mkdir()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(directory / "b.sock"))
    directory.chmod(mode)
    return directory


def test_what_killed_masters_left_goes_with_the_next_start(place):
    empty = make_private_directory()
    full = left_by_a_killed_master(place, "rosbayes-abcdefg1")
    made = PrivateDirectory()
    assert [each.name for each in place.iterdir()] == [made.path.name]
    assert not empty.exists()
    assert not full.exists()
    made.remove()
    assert not list(place.iterdir())


def test_what_no_killed_master_left_stays(place):
    alive = PrivateDirectory()
    others = [
        left_by_a_killed_master(place, "rosbayes-open0000", mode=0o755),
        left_by_a_killed_master(place, "rosbayes-of-mine"),
        left_by_a_killed_master(place, "elsewhere"),
    ]
    work = left_by_a_killed_master(place, "rosbayes-mywork00")
    (work / "thesis.md").write_text("three years")
    linked = left_by_a_killed_master(place, "rosbayes-linking0")
    (linked / "b7.sock").symlink_to(others[2])
    (place / "rosbayes-alink000").symlink_to(others[2])
    (place / "rosbayes-file0000").write_text("no folder")
    before = {each: sorted(each.rglob("*")) for each in place.iterdir()}
    made = PrivateDirectory()
    made.remove()
    assert {each: sorted(each.rglob("*")) for each in place.iterdir()} == before
    alive.remove()


def test_a_directory_that_is_taken_for_an_abandoned_one_while_it_is_made_is_made_again(place, monkeypatch):
    made = []

    def make():
        made.append(make_private_directory())
        if len(made) < 3:  # another master starts before this one has its lock
            made[-1].rmdir()
        return made[-1]

    monkeypatch.setattr("terminal.private_directory.make_private_directory", make)
    private = PrivateDirectory()
    assert private.path == made[-1]
    assert len(made) == 3
    assert private.path.is_dir()
    private.remove()
