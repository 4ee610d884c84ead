"""Commands of boards: the networks that listeners refuse, the boards of a deployment, and their programming."""

import shutil

import pytest

from pcie_shim import register_map as rm
from pcie_shim.errors import LinkError
from services.boards.processes import blank_board
from services.commands.board import app as board
from services.commands.loader import app as loader
from services.commands.master import app as master
from services.commands.pcie_app import app as pcie_app
from services.commands.publisher import app as publisher
from services.commands.subscriber import app as subscriber
from services.errors import SettingsError
from services.settings import Settings
from services.sockets.serving import board_endpoints
from tests.command_runner import invoke

EVERYWHERE = "tcp://0.0.0.0:7000"


@pytest.fixture
def key(tmp_path):
    path = tmp_path / "key"
    path.write_text("correct-horse-battery-staple\n")
    path.chmod(0o644)
    return path


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--listen", EVERYWHERE], "--key-file"),
        (["--listen", "tcp://board.example:7000"], "--key-file"),
        (["--listen", "tls://127.0.0.1:7000"], "hosts.md"),
        (["--listen", EVERYWHERE, "--key-file", "{key}"], "chmod 600"),
        (["--boards", "2", "--directory", "{open}"], "chmod 700"),
    ],
)
def test_a_board_keeps_its_doors_shut(tmp_path, key, arguments, named):
    (tmp_path / "open").mkdir(mode=0o755)
    (tmp_path / "open").chmod(0o755)
    ended = invoke(board, [each.format(key=key, open=tmp_path / "open") for each in arguments])
    assert ended.exit_code == 2
    assert named in ended.stderr


@pytest.mark.parametrize("service", [subscriber, publisher, pcie_app])
def test_a_service_serves_no_master_on_the_network(service, boat):
    boards = ["--boards", ",".join(f"unix:/nowhere/{at}" for at in range(len(boat.boards)))]
    arguments = ["-d", boat.directory, "--listen", EVERYWHERE, *(boards if service is pcie_app else [])]
    ended = invoke(service, arguments)
    assert ended.exit_code == 2
    assert "--insecure" in ended.stderr


def test_as_many_boards_as_the_deployment_has(boat, tmp_path, monkeypatch):
    class Counted:
        def __init__(self, directory, count, _restarts, settings, hardware):
            assert directory == tmp_path / "boards"
            counted.append(count)
            sending.append(blank_board(0, settings, hardware).read(rm.CAP_LINK, 1)[0])

        def run(self):
            raise SettingsError("counted")

    counted, sending = [], []
    monkeypatch.setattr("services.commands.board.BoardProcesses", Counted)
    ended = invoke(board, ["-d", boat.directory, "--directory", tmp_path / "boards"])
    assert (ended.exit_code, counted) == (2, [len(boat.boards)])
    monkeypatch.setenv("BM_DEPLOYMENT", str(boat.directory))
    invoke(board, ["--boards", "2", "--directory", tmp_path / "boards", "--read-results"])
    assert counted.pop() == 2, "a number that is given counts"
    assert sending == [1, 0]


def test_a_folder_stands_for_all_boards_in_it(boat):
    endpoints = board_endpoints(Settings(boards=("unix:/run/boards/",)), boat)
    assert [each.path for each in endpoints] == [f"/run/boards/board{at}.sock" for at in range(4)]
    with pytest.raises(SettingsError):
        board_endpoints(Settings(boards=("unix:/run/boards",)), boat)


def test_a_master_checks_before_it_starts_anything(built, tmp_path):
    folder = tmp_path / "deployment"
    shutil.copytree(built, folder)
    assert invoke(master, ["--check", "-d", folder]).exit_code == 0
    assert invoke(master, ["--check", "-d", folder, "--boards", "unix:/run/boards/"]).exit_code == 0
    assert invoke(master, ["--check", "-d", folder, "--boards", "tcp://far:7000"]).exit_code == 2
    (folder / "boards" / "board0.bm").write_bytes(b"")
    damaged = invoke(master, ["--check", "-d", folder])
    assert damaged.exit_code == 2
    assert str(folder) in damaged.stderr


# --- loader ---


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


def test_boards_beside_one_that_is_not_there_are_programmed_and_named(boat, programmed, monkeypatch):
    def program(endpoint, image, *, timeout):
        if image.name in {"board1.bm", "board2.bm"}:
            raise LinkError("held")
        programmed.append(str(endpoint))
        return "ab" * 32

    monkeypatch.setattr("services.commands.loader.program", program)
    ended = invoke(loader, ["-d", boat.directory, "--boards", "unix:/nowhere/"])
    assert (ended.exit_code, programmed) == (5, [f"unix:/nowhere/board{at}.sock" for at in (0, 3)])
    lines = ended.stderr.splitlines()
    assert [f"board{at}.sock" in line for at, line in enumerate(lines[:4])] == [True] * 4
    assert ["not programmed" in line for line in lines[:4]] == [False, True, True, False]
    assert lines[4].endswith("2 of 4 boards are not programmed: board 1, board 2")


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
