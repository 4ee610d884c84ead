"""The command that programs boards: one, or all of a deployment."""

import pytest

from services.commands.loader import app as loader
from services.settings import Settings
from tests.command_runner import invoke


@pytest.fixture
def programmed(monkeypatch):
    """The endpoints and the images that would be programmed."""
    calls = []

    def program(endpoint, image, *, timeout):
        calls.append((str(endpoint), image.name))
        assert timeout == Settings().peer_timeout
        return "ab" * 32

    monkeypatch.setattr("services.commands.loader.program", program)
    return calls


def test_all_boards_of_a_deployment_get_their_images(boat, programmed):
    ended = invoke(loader, ["-d", boat.directory, "--boards", "unix:/nowhere/"])
    assert ended.exit_code == 0
    assert programmed == [(f"unix:/nowhere/board{at}.sock", f"board{at}.bm") for at in range(4)]


def test_one_board_gets_its_image(boat, programmed):
    ended = invoke(loader, [boat.image_path(2), "unix:/nowhere/board"])
    assert (ended.exit_code, programmed) == (0, [("unix:/nowhere/board", "board2.bm")])


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["{image}"], "endpoint"),
        ([], "--deployment"),
        (["{image}", "unix:/x", "-d", "{folder}"], "-d and --boards"),
        (["{image}", "unix:/x", "--boards", "unix:/x"], "-d and --boards"),
        (["-d", "{folder}"], "--boards"),
        (["-d", "{folder}", "--boards", "unix:/0,unix:/1"], "--boards"),
        (["-d", "{folder}", "--boards", "unix:/0,unix:/1,unix:/2,unix:/1"], "unix:/1"),
    ],
)
def test_what_to_program_must_be_clear(boat, programmed, arguments, named):
    places = {"image": boat.image_path(0), "folder": boat.directory}
    ended = invoke(loader, [each.format(**places) for each in arguments])
    assert (ended.exit_code, ended.stderr.count("\n"), programmed) == (2, 1, [])
    assert named in ended.stderr
