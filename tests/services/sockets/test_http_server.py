"""State of a process over HTTP: what a scraper gets, and what hostile clients get.

client ──▶ NAME.http.sock or TCP ──▶ serve_http ──▶ Report.respond
"""

import asyncio
import contextlib
import http.client
import json
import socket
import stat
from http import HTTPStatus

import pytest
from prometheus_client.parser import text_string_to_metric_families

from pcie_shim.endpoint import Endpoint, listen
from services.errors import SettingsError
from services.sockets import http_server
from services.sockets.http_client import get
from services.sockets.http_server import Response, refused, serve_http
from services.sockets.reporting import (
    check_metrics,
    http_socket,
    serve_status,
    serve_status_in_thread,
    shifted,
)
from services.sockets.status import (
    BUCKETS_S,
    BoardStatus,
    ConnectionStatus,
    FrameCounts,
    HubStatus,
    PeerStatus,
    ProcessStatus,
    StageLatency,
)
from tests.patience import PATIENCE

STATUS = ProcessStatus(
    ready=True,
    why="results flow",
    deployment="ab" * 32,
    connections=[ConnectionStatus('ws://robot"\n:9090', "connected", 2)],
    frames=FrameCounts(
        received=120,
        completed=100,
        lost={"passed over": 19},
        last_number=100,
        last_age_s=0.2,
        without={"/t": 1},
    ),
    boards=[BoardStatus(index=1, endpoint="unix:/b", state="gone", restarts=3)],
    peers=[PeerStatus(name="pcie-app", endpoint="unix:/p", pid=1, restarts=4, ready=True)],
    hub=HubStatus(3, 5, 7),
)

STAGE = StageLatency(
    stage="frame", p50_ms=1.5, p99_ms=9, frames=3, sum_s=0.5, buckets=[1, *[0] * (len(BUCKETS_S) - 1), 2]
)


class Connection(http.client.HTTPConnection):
    """A connection of http.client over a Unix socket."""

    def __init__(self, path):
        super().__init__("localhost", timeout=PATIENCE)
        self._path = path

    def connect(self):
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(PATIENCE)
        self.sock.connect(str(self._path))


def asked(connection, target, method="GET", **headers):
    with contextlib.closing(connection):
        connection.request(method, target, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read()


def samples(text):
    """The samples by name and labels, without the label of the process."""
    return {
        (
            sample.name,
            *(value for key, value in sorted(sample.labels.items()) if key != "process"),
        ): sample.value
        for family in text_string_to_metric_families(text.decode())
        for sample in family.samples
    }


@pytest.fixture
def port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@pytest.mark.parametrize("over", ["unix", "tcp"])
def test_a_scraper_gets_every_number_of_the_status(tmp_path, port, over):
    told = {"metrics": f"tcp://127.0.0.1:{port}", "stages": lambda: [STAGE]}
    with serve_status_in_thread(tmp_path, "master", lambda: STATUS, **told):
        path = http_socket(tmp_path, "master")
        assert stat.S_IMODE(path.stat().st_mode) == 0o600

        def connection():
            return Connection(path) if over == "unix" else http.client.HTTPConnection("127.0.0.1", port)

        status, text = asked(connection(), "/metrics")
        assert status == 200
        found = samples(text)
        assert asked(connection(), "/readyz") == (200, b"results flow\n")
        assert asked(connection(), "/healthz") == (200, b"alive\n")
        assert asked(connection(), "/")[0] == 404
        assert asked(connection(), "/frames/1")[0] == 404  # this process has none
    assert found["rosbayes_frames_received_total",] == 120
    assert found["rosbayes_frames_completed_total",] == 100
    assert found["rosbayes_frames_lost_total", "passed over"] == 19
    assert found["rosbayes_frames_without_topic_total", "/t"] == 1
    assert found["rosbayes_rosbridge_connected", 'ws://robot"\n:9090'] == 1
    assert found["rosbayes_rosbridge_reconnections_total", 'ws://robot"\n:9090'] == 2
    assert found["rosbayes_child_restarts_total", "pcie-app"] == 4
    assert (found["rosbayes_board_usable", "1"], found["rosbayes_board_restarts_total", "1"]) == (0, 3)
    assert found["rosbayes_hub", "topics"] == 5
    assert found["rosbayes_cpu_seconds_total",] > 0
    assert found["rosbayes_memory_bytes",] > 1e6
    assert found["rosbayes_stage_seconds_bucket", "1e-05", "frame"] == 1
    assert found["rosbayes_stage_seconds_bucket", "2", "frame"] == 1
    assert found["rosbayes_stage_seconds_bucket", "+Inf", "frame"] == 3
    assert found["rosbayes_stage_seconds_count", "frame"] == 3
    assert found["rosbayes_stage_seconds_sum", "frame"] == 0.5
    assert not list(tmp_path.iterdir())


async def test_not_ready_and_stuck_are_503(tmp_path):
    status = ProcessStatus(ready=False, why="waiting for the robot")
    async with serve_status(tmp_path, "hub", lambda: status, is_alive=lambda: False):
        path = http_socket(tmp_path, "hub")
        assert await get(path, "/readyz", timeout=PATIENCE) == (503, b"waiting for the robot\n")
        assert (await get(path, "/healthz", timeout=PATIENCE))[0] == 503


async def test_a_frame_is_json_and_an_unknown_one_a_sentence(tmp_path):
    def frame(number):
        return HubStatus(number, 0, 0) if number == 7 else "not known"

    async with serve_status(tmp_path, "master", lambda: STATUS, frame=frame):
        path = http_socket(tmp_path, "master")
        status, body = await get(path, "/frames/7", timeout=PATIENCE)
        assert (status, json.loads(body)["clients"]) == (200, 7)
        assert await get(path, "/frames/8", timeout=PATIENCE) == (404, b"not known")
        for bad in ("", "x", "-1", "7" * 20, "7/..", "%37"):
            assert (await get(path, f"/frames/{bad}", timeout=PATIENCE))[0] == 404


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:9"}, 200),
        ({"Host": "127.8.9.1"}, 200),
        ({"Host": "[::1]:4"}, 200),
        ({"Host": "rebound.example"}, 403),
        ({"Host": "127.0.0.1.example"}, 403),
        ({"Host": ""}, 403),
        ({"Host": "[::1"}, 403),
        ({"Origin": "http://localhost:8000"}, 200),
        ({"Origin": "https://evil.example"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
def test_a_web_page_of_another_machine_reads_nothing(tmp_path, port, headers, status):
    with serve_status_in_thread(None, "hub", lambda: STATUS, metrics=f"tcp://127.0.0.1:{port}"):
        assert asked(http.client.HTTPConnection("127.0.0.1", port), "/readyz", **headers)[0] == status


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET /readyz HTTP/1.1\r\n\r\n", b"403"),  # no host
        (b"GET /readyz HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n", b"403"),
        (b"POST /readyz HTTP/1.1\r\nHost: localhost\r\n\r\n", b"405"),
        (b"GET http://a/ HTTP/1.1\r\nHost: localhost\r\n\r\n", b"400"),
        (b"GET /readyz\r\n\r\n", b"400"),
        (b"\r\n\r\n", b"400"),
        (b"\xff\xfe\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nnonsense\r\n\r\n", b"400"),
        (b"GET /" + b"a" * 20_000, b"431"),
    ],
    ids=str,
)
def test_a_malformed_request_is_refused(tmp_path, port, request_, status):
    with (
        serve_status_in_thread(None, "hub", lambda: STATUS, metrics=f"tcp://127.0.0.1:{port}"),
        socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as client,
    ):
        client.sendall(request_)
        assert client.recv(1 << 16).split(b" ")[1] == status


async def test_the_oldest_silent_clients_make_room(tmp_path, monkeypatch):
    monkeypatch.setattr(http_server, "REQUEST_TIME", 3600.0)
    async with serve_status(tmp_path, "hub", lambda: STATUS):
        path = http_socket(tmp_path, "hub")
        silent = [await asyncio.open_unix_connection(path) for _ in range(2 * http_server.CLIENTS)]
        for reader, _ in silent[: http_server.CLIENTS]:
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.wait_for(reader.read(), PATIENCE) == b""
        assert (await get(path, "/readyz", timeout=PATIENCE))[0] == 200
        for _, writer in silent:
            writer.close()


async def test_a_client_that_sends_for_ever_is_read_slowly_and_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(http_server, "REQUEST_TIME", 1.0)
    taken = 0

    def flood(path):
        nonlocal taken
        with socket.socket(socket.AF_UNIX) as client, contextlib.suppress(OSError):
            client.connect(str(path))
            client.sendall(b"GET /readyz HTTP/1.1\r\n\r\n")
            while True:
                taken += client.send(bytes(1 << 20))

    async with serve_status(tmp_path, "hub", lambda: STATUS):
        flooding = asyncio.to_thread(flood, http_socket(tmp_path, "hub"))
        await asyncio.wait_for(flooding, PATIENCE)
    assert taken < 1 << 22


async def test_silent_clients_keep_nobody_out_and_are_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(http_server, "REQUEST_TIME", 1.0)
    async with serve_status(tmp_path, "hub", lambda: STATUS):
        path = http_socket(tmp_path, "hub")
        silent = [await asyncio.open_unix_connection(path) for _ in range(3 * http_server.CLIENTS)]
        assert (await get(path, "/readyz", timeout=PATIENCE))[0] == 200
        for reader, writer in silent:
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.wait_for(reader.read(), PATIENCE) == b""
            writer.close()


async def test_requests_in_a_loop_do_not_render_again(tmp_path):
    asked_for = 0

    def stages():
        nonlocal asked_for
        asked_for += 1
        return [STAGE]

    async with serve_status(tmp_path, "master", lambda: STATUS, stages=stages):
        path = http_socket(tmp_path, "master")
        for _ in range(10):
            assert (await get(path, "/metrics", timeout=PATIENCE))[0] == 200
    assert asked_for <= 3


def test_beyond_loopback_it_must_be_intended():
    check_metrics("", insecure=False)
    check_metrics("tcp://127.0.0.1:9400", insecure=False)
    check_metrics("tcp://0.0.0.0:9400", insecure=True)
    with pytest.raises(SettingsError):
        check_metrics("tcp://0.0.0.0:9400", insecure=False)
    assert shifted("tcp://[::1]:9400", 3) == "tcp://[::1]:9403"


async def test_a_taken_port_does_not_end_the_run(tmp_path, port, capsys):
    with socket.create_server(("127.0.0.1", port)):
        async with serve_status(tmp_path, "hub", lambda: STATUS, metrics=f"tcp://127.0.0.1:{port}"):
            path = http_socket(tmp_path, "hub")
            assert (await get(path, "/readyz", timeout=PATIENCE))[0] == 200
    assert capsys.readouterr().err.count("warning") == 1


async def test_an_answer_that_is_not_http_is_refused(tmp_path):
    async def nonsense(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"hello")
        writer.close()

    async with await asyncio.start_unix_server(nonsense, tmp_path / "x.sock"):
        with pytest.raises(ValueError, match="HTTP"):
            await get(tmp_path / "x.sock", "/", timeout=PATIENCE)


async def test_a_connection_that_arrives_while_serving_is_cancelled(tmp_path, caplog):
    """Both are handled in one turn of the loop, as at the end of a run that somebody queries."""
    endpoint = Endpoint(path=str(tmp_path / "a.sock"))

    async def answer(_path: str) -> Response:
        return refused(HTTPStatus.NOT_FOUND)

    with contextlib.closing(listen(endpoint)) as listener, socket.socket(socket.AF_UNIX) as client:
        serving = asyncio.ensure_future(serve_http(listener, answer, local_only=True))
        await asyncio.sleep(0.01)
        client.connect(endpoint.path)
        asyncio.get_running_loop().call_soon(serving.cancel)
        with pytest.raises(asyncio.CancelledError):
            await serving
        await asyncio.sleep(0)
    assert not caplog.records
