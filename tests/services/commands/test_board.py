"""The commands that listen for others on the network: what they refuse."""

import pytest

from services.commands.board import app as board
from services.commands.pcie_app import app as pcie_app
from services.commands.publisher import app as publisher
from services.commands.subscriber import app as subscriber
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
        (["--listen", "tls://127.0.0.1:7000"], "--tls-cert"),
        (["--listen", "tcp://127.0.0.1:7000", "--tls-key", "key.pem"], "--tls-cert"),
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
