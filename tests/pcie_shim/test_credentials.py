"""Boards over TCP: a shared key, and connections without it."""

import socket
import threading
from dataclasses import replace

import pytest

from pcie_shim import framing
from pcie_shim import register_map as rm
from pcie_shim.credentials import read_key
from pcie_shim.endpoint import parse_endpoint
from pcie_shim.errors import CredentialsError, KeyRefusedError, SequenceError
from pcie_shim.host.loader import program
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.host.socket_link import SocketLink
from tests.patience import PATIENCE
from tests.pcie_shim.boards import board_fails, image, machine, tcp_endpoint

KEY = b"sixteen-letters-at-least"
OTHER = b"sixteen-letters-and-others"


def with_key(text, key):
    return replace(parse_endpoint(text), key=key)


def identity(endpoint):
    with SocketLink.open(endpoint, timeout=PATIENCE) as link:
        return link.read32(rm.ID)


def test_a_host_with_the_key_uses_and_programs_the_board(start_board):
    endpoint = with_key(tcp_endpoint(), KEY)
    start_board(endpoint)
    expected = image(machine(1))
    assert program(endpoint, expected, timeout=PATIENCE) == expected.image_hash
    with SocketLink.open(endpoint, timeout=PATIENCE) as link:
        assert link.read32(rm.ID) == rm.ID_VALUE
        assert link.greeting.image_hash == expected.image_hash


@pytest.mark.parametrize(("board", "host"), [(KEY, OTHER), (KEY, b""), (b"", KEY)])
def test_without_the_same_key_there_is_no_link(start_board, board, host):
    text = tcp_endpoint()
    start_board(with_key(text, board))
    with pytest.raises(KeyRefusedError):
        identity(with_key(text, host))
    with pytest.raises(KeyRefusedError):
        program(with_key(text, host), image(machine(1)), timeout=PATIENCE)
    with board_fails(KeyRefusedError) as refused:
        MiniCluster.open([with_key(text, host)], [image(machine(1))], timeout=PATIENCE, slack=PATIENCE)
    assert refused.value.exit_code == KeyRefusedError.exit_code == 2
    assert identity(with_key(text, board)) == rm.ID_VALUE


def test_a_proof_does_not_fit_another_challenge(start_board):
    """A recorded answer is worth nothing, and a request without a proof ends the connection."""
    endpoint = with_key(tcp_endpoint(), KEY)
    start_board(endpoint)
    answers = []

    class Recording(SocketLink):
        def request(self, operation, flags, address, count, payload=b""):
            answers.append(framing.encode(operation, flags, 1, address, count, payload))
            return super().request(operation, flags, address, count, payload)

    with Recording.open(endpoint, timeout=PATIENCE):
        pass
    for data in (answers[0], framing.encode(framing.READ, 0, 1, rm.ID, 1)):
        for port in (endpoint.port, endpoint.programming.port):
            with socket.create_connection((endpoint.host, port), timeout=PATIENCE) as connection:
                connection.sendall(data)
                received = bytearray()
                while piece := connection.recv(4096):
                    received += piece
            assert bytes(answers[0][20:]) not in received
            assert received[3] in {framing.AUTHENTICATE, 0}
            assert b"ROSBAYES" not in received  # the greeting


def test_a_board_that_answers_another_request_is_named_once():
    frames = [(0, 0), (framing.REPLY, 9)]  # the challenge, and the answer to no request
    sent = b"".join(framing.encode(framing.AUTHENTICATE, *each, 0, 8, bytes(32)) for each in frames)
    with socket.create_server(("127.0.0.1", 0)) as server:
        peers, where = [], f"tcp://127.0.0.1:{server.getsockname()[1]}"
        threading.Thread(target=lambda: peers.append(server.accept()[0]) or peers[0].sendall(sent)).start()
        with pytest.raises(SequenceError) as caught:
            SocketLink.open(with_key(where, KEY), timeout=PATIENCE)
        peers[0].close()
    assert str(caught.value).count(where) == 1


@pytest.mark.parametrize("content", [b"", b"short", b"has spaces in it, sixteen", b"x" * 2000, None])
def test_a_file_that_is_not_a_key(tmp_path, content):
    path = tmp_path / "key"
    if content is not None:
        path.write_bytes(content)
        path.chmod(0o600)
    with pytest.raises(CredentialsError, match=str(path)):
        read_key(path)


def test_a_key_is_private(tmp_path):
    path = tmp_path / "key"
    path.write_bytes(KEY + b"\n")
    path.chmod(0o640)
    with pytest.raises(CredentialsError, match="chmod"):
        read_key(path)
    path.chmod(0o600)
    assert read_key(path) == KEY
    assert "letters" not in repr(with_key("tcp://localhost:7", KEY))
