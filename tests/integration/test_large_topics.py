"""A camera whose pictures are too large does not stop the results from another topic.

/range (Range, needed), /camera (Image, 640 x 480, may be missing)  ->  hub  ->  subscriber, master  ->  hub
"""

import asyncio
import contextlib
import signal
import time

import numpy as np
import pytest

from bridge.client import connect
from bridge.stamps import header
from posteriors.listening import posteriors
from tests.integration.conftest import build_corridor
from tests.patience import PROCESS_PATIENCE

KNOWN = 'known("near"), known("red", on_missing="missing")'
SOURCES = """
source = [
    {{ uri = "{uri}", topic = "/range", type = "sensor_msgs/Range", variables = {{ near = "range" }} }},
    {{ uri = "{uri}", topic = "/camera", type = "sensor_msgs/Image", variables = {{ red = "data[0]" }}{more} }},
]
"""
PICTURE = np.zeros((480, 640, 3), np.uint8).tobytes()


@contextlib.asynccontextmanager
async def robot(uri):
    async def play():
        async with connect(uri, ros_version="2", max_size=4_000_000) as ros:
            near = await ros.advertise("/range", "sensor_msgs/Range")
            camera = await ros.advertise("/camera", "sensor_msgs/Image")
            while True:
                now = header(time.time_ns(), "robot", 2)
                image = {"header": now, "height": 480, "width": 640, "encoding": "rgb8", "step": 1920}
                await near.publish({"header": now, "range": 4.0})
                await camera.publish(image | {"data": PICTURE})
                await asyncio.sleep(0.1)

    task = asyncio.create_task(play())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@pytest.mark.parametrize(
    ("key", "flags", "environment", "said"),
    [
        pytest.param("topic_bytes = 100000", ("--fused",), {}, "", marks=pytest.mark.process),
        pytest.param(
            "topic_bytes = 3000000", (), {"BM_TOPIC_BYTES": "100000"}, "", marks=pytest.mark.thorough
        ),
        pytest.param(
            "",
            ("--message-bytes", "1000000"),
            {},
            r"/camera is left out: .* bytes",
            marks=pytest.mark.thorough,
        ),
    ],
)
async def test_results_go_on_beside_a_camera_with_large_pictures(stage, key, flags, environment, said):
    hub = stage.start("hub", "--port", "0", "--message-bytes", "4000000")
    uri = (await hub.says(r"ws://\S+"))[0]
    deployment = build_corridor(stage.where, KNOWN, SOURCES.format(uri=uri, more=key and f", {key}"))
    async with robot(uri), connect(uri) as ros, posteriors(ros) as heard:
        command = ("master", "--loop", "-d", str(deployment), *flags)
        master = stage.start(*command, environment=environment | {"BM_RUN_DIRECTORY": str(stage.runs)})
        if said:
            await master.says(said)
        for _ in range(5):
            assert (await heard.next(PROCESS_PATIENCE)).best() == {"s": 2}
        if not said:
            await stage.status("subscriber", lambda status: status["frames"]["lost"].get("too large"))
        master.send(signal.SIGINT)
        assert await master.end() == 130
