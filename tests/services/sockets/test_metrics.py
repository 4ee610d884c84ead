"""Metrics of a process: scraper ──▶ start_http_server of prometheus_client ──▶ the status in the event loop."""

import asyncio
import socket
import struct
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from services.errors import SettingsError
from services.settings import load_settings
from services.sockets import status
from services.sockets.reporting import check_metrics, serve_status, serve_status_in_thread, shifted
from terminal.health import status_socket
from tests.patience import PATIENCE

STATUS = status.ProcessStatus(
    ready=True,
    why="results flow",
    deployment="ab" * 32,
    connections=[status.ConnectionStatus('ws://robot"\n:9090', "connected", 2)],
    frames=status.FrameCounts(
        received=120,
        completed=100,
        lost={"passed over": 19},
        last_number=100,
        last_age_s=0.2,
        without={"/t": 1},
    ),
    boards=[status.BoardStatus(index=1, endpoint="unix:/b", state="gone", restarts=3)],
    peers=[status.PeerStatus(name="pcie-app", endpoint="unix:/p", pid=1, restarts=4, ready=True)],
    hub=status.HubStatus(3, 5, 7),
)
STAGE = status.StageLatency(
    stage="frame",
    p50_ms=1.5,
    p99_ms=9,
    frames=3,
    sum_s=0.5,
    buckets=[1, *[0] * (len(status.BUCKETS_S) - 1), 2],
)


@pytest.fixture
def port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def scraped(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE) as answer:
        return answer.read().decode()


def samples(text):
    """The samples by name and labels, without the label of the process."""
    return {
        (
            sample.name,
            *(value for key, value in sorted(sample.labels.items()) if key != "process"),
        ): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_a_scraper_gets_every_number_of_the_status(tmp_path, port):
    with serve_status_in_thread(
        tmp_path, "master", lambda: STATUS, metrics=str(port), stages=lambda: [STAGE]
    ):
        found = samples(scraped(port))
    assert found["rosbayes_ready",] == 1
    assert found["rosbayes_frames_received_total",] == 120
    assert found["rosbayes_frames_completed_total",] == 100
    assert found["rosbayes_frames_lost_total", "passed over"] == 19
    assert found["rosbayes_frames_without_topic_total", "/t"] == 1
    assert found["rosbayes_last_frame_age_seconds",] == 0.2
    assert found["rosbayes_rosbridge_connected", 'ws://robot"\n:9090'] == 1
    assert found["rosbayes_rosbridge_reconnections_total", 'ws://robot"\n:9090'] == 2
    assert found["rosbayes_child_restarts_total", "pcie-app"] == 4
    assert found["rosbayes_child_ready", "pcie-app"] == 1
    assert (found["rosbayes_board_usable", "1"], found["rosbayes_board_restarts_total", "1"]) == (0, 3)
    assert found["rosbayes_hub", "topics"] == 5
    assert found["rosbayes_cpu_seconds_total",] > 0
    assert found["rosbayes_memory_bytes",] > 1e6
    assert found["rosbayes_stage_seconds_bucket", "1e-05", "frame"] == 1
    assert found["rosbayes_stage_seconds_bucket", "2", "frame"] == 1
    assert found["rosbayes_stage_seconds_bucket", "+Inf", "frame"] == 3
    assert found["rosbayes_stage_seconds_count", "frame"] == 3
    assert found["rosbayes_stage_seconds_sum", "frame"] == 0.5


async def test_a_running_loop_is_scraped_and_a_client_that_resets_prints_nothing(port, capfd):
    async with serve_status(None, "hub", lambda: STATUS, metrics=f"127.0.0.1:{port}"):
        with socket.create_connection(("127.0.0.1", port)) as rude:
            rude.sendall(b"GET /metrics")
            rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert samples(await asyncio.to_thread(scraped, port))["rosbayes_hub", "clients"] == 3
    assert capfd.readouterr().err == ""


async def test_an_occupied_port_does_not_end_the_run(tmp_path, port, capsys):
    with socket.create_server(("127.0.0.1", port)):
        async with serve_status(tmp_path, "hub", lambda: STATUS, metrics=str(port)):
            assert (await status.read_process_status(status_socket(tmp_path, "hub"), PATIENCE)).ready
    assert capsys.readouterr().err.count("warning") == 1


def test_an_address_without_a_host_is_on_loopback_and_another_one_must_be_intended():
    for harmless in ("", "9400", "127.0.0.1:9400", "[::1]:9400", "localhost:9400"):
        check_metrics(harmless, insecure=False)
    check_metrics("0.0.0.0:9400", insecure=True)
    with pytest.raises(SettingsError):
        check_metrics("0.0.0.0:9400", insecure=False)
    assert [shifted(each, 3) for each in ("", "9400", "[::1]:9400")] == ["", "127.0.0.1:9403", "[::1]:9403"]
    for wrong in ("x", "0", "99999", "tcp://127.0.0.1:9400", "127.0.0.1:", ":9400"):
        with pytest.raises(SettingsError, match=r"\[HOST:\]PORT"):
            load_settings(metrics=wrong)
