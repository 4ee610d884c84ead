"""Endpoints: their text, their programming port, and sockets that only their owner can use."""

import contextlib
import socket

import pytest

from pcie_shim.endpoint import Endpoint, connect, listen, parse_endpoint
from pcie_shim.errors import EndpointError, LinkUnreachableError
from tests.patience import PATIENCE


@pytest.mark.parametrize(
    ("text", "programming"),
    [
        ("unix:/run/bm/board0.sock", "unix:/run/bm/board0.program.sock"),
        ("unix:/run/board", "unix:/run/board.program"),
        ("tcp://127.0.0.1:9000", "tcp://127.0.0.1:9001"),
        ("tcp://board-3.local:65534", "tcp://board-3.local:65535"),
        ("tcp://[::1]:9000", "tcp://[::1]:9001"),
    ],
)
def test_endpoints_are_what_their_text_says(text, programming):
    assert str(parse_endpoint(text)) == text
    assert str(parse_endpoint(text).programming) == programming


@pytest.mark.parametrize(
    "text",
    [
        "", "/run/board0.sock", "unix:board0.sock", "unix:", "tcp://host", "tcp://host:0", "tcp://host:65535",
        "tcp://host:x", "tcp://:9000", "udp://host:9000", "tcp://host:9000/x", "tcp://[::1:9000",
    ],
)  # fmt: skip
def test_other_texts_are_refused(text):
    with pytest.raises(EndpointError):
        parse_endpoint(text)


def test_an_endpoint_with_tls_is_told_what_to_use_instead():
    with pytest.raises(EndpointError, match="hosts.md") as caught:
        parse_endpoint("tls://board-3.local:7000")
    assert caught.value.exit_code == 2


def test_paths_that_no_socket_takes_are_refused():
    assert parse_endpoint("unix:/" + "x" * 98).programming.path
    with pytest.raises(EndpointError):
        parse_endpoint("unix:/" + "x" * 99)


def test_a_dead_processs_socket_is_replaced_and_a_served_one_is_not(folder):
    endpoint = Endpoint(path=str(folder / "a.sock"))
    listen(endpoint).close()
    server = listen(endpoint)
    with pytest.raises(EndpointError):
        listen(endpoint)
    connect(endpoint, timeout=PATIENCE).close()
    server.close()


def test_a_socket_whose_queue_is_full_is_served_and_not_waited_for(folder):
    endpoint = Endpoint(path=str(folder / "a.sock"))
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.socket(socket.AF_UNIX))
        server.bind(endpoint.path)
        server.listen(0)
        stack.enter_context(connect(endpoint, timeout=PATIENCE))
        with pytest.raises(EndpointError):
            listen(endpoint)


def test_a_port_in_use_and_a_missing_folder_are_reported(folder):
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    with server, pytest.raises(EndpointError):
        listen(Endpoint(host="127.0.0.1", port=port))
    with pytest.raises(EndpointError) as caught:
        listen(Endpoint(path=str(folder / "no" / "a.sock")))
    assert f"{folder / 'no'} " in str(caught.value)


def test_an_unused_endpoint_is_reported_in_time(folder):
    with pytest.raises(LinkUnreachableError):
        connect(Endpoint(path=str(folder / "a.sock")), timeout=0.05)
    (folder / "b.sock").touch()
    with pytest.raises(LinkUnreachableError):
        connect(Endpoint(path=str(folder / "b.sock")), timeout=0.05)


def test_small_frames_are_sent_at_once_over_tcp():
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = Endpoint(host="127.0.0.1", port=server.getsockname()[1])
        with connect(endpoint, timeout=PATIENCE) as connection:
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
