"""The guide's examples are programs: each is run as it stands, but for the server's address."""

import asyncio
import re
import sys
from pathlib import Path

import pytest

from bridge import handles, json_codec, protocol, session, websocket
from tests.fake_rosbridge import FakeRosbridge

GUIDE = Path(__file__).parents[2] / "docs" / "bridge.md"
EXAMPLES = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(), re.MULTILINE | re.DOTALL)


async def run(example: str, fake: FakeRosbridge) -> str:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        example.replace("ws://127.0.0.1:9090", fake.uri),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=GUIDE.parents[1],
    )

    async def play_the_boat() -> None:
        await fake.wait_for_op("subscribe", topic="/boat/sensors", timeout=60)
        await fake.publish("/boat/sensors", {"D1": 5})
        await fake.publish("/boat/sensors", {"D1": 6, "last": True})

    boat = asyncio.create_task(play_the_boat())
    try:
        out, errors = await asyncio.wait_for(process.communicate(), 60)
    finally:
        boat.cancel()
        if process.returncode is None:
            process.kill()
    assert process.returncode == 0, errors.decode()
    return out.decode()


@pytest.mark.asyncio(loop_factories=["asyncio"])
@pytest.mark.parametrize(
    ("number", "printed"),
    [
        (0, "'D1': 6"),
        (1, ""),
        (2, "{'sum': 3}\nservice /add at ws://"),
        (3, "D1 (True, 7)\ny (True, 2.5)\npose.position.x (True, 1.5)\nranges[1] (True, 0.5)\n"),
    ],
)
async def test_an_example_runs(number, printed):
    async with FakeRosbridge() as fake:
        assert printed in await run(EXAMPLES[number], fake)
        if number == 1:
            assert [op["msg"]["point"]["x"] for op in fake.ops("publish")] == [
                0.1 * step for step in range(10)
            ]


def test_no_example_is_left_out():
    assert len(EXAMPLES) == 4


@pytest.mark.parametrize(
    ("row", "size"),
    [
        ("messages that wait in a subscription", str(handles.QUEUE_SIZE)),
        ("publications of a topic that wait", str(handles.PUBLISH_QUEUE_SIZE)),
        ("bytes that wait in the socket", f"{websocket.WRITE_LIMIT >> 10} KiB"),
        ("a message, both ways", f"{json_codec.MAX_SIZE >> 20} MiB"),
        ("objects and arrays within each other", str(json_codec.MAX_DEPTH)),
        ("calls that wait for answers", str(protocol.MAX_CALLS)),
        ("requests to services of this client", str(protocol.MAX_REQUESTS)),
        ("the closing handshake", f"{websocket.CLOSE_TIMEOUT:g} s"),
        ("status messages kept", str(session.KEPT_STATUSES)),
    ],
)
def test_the_table_of_limits_is_true(row, size):
    (found,) = re.findall(rf"^\| {row}[^|]*\| ([^|]+) \|", GUIDE.read_text(), re.MULTILINE)
    assert found == size
