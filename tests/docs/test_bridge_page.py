"""The examples of the client's pages: each runs against a hub, with only addresses and files replaced."""

import asyncio
import contextlib
import io
import json
import re
import ssl
import sys
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import connect as plain_connect

from bridge.client import actions, connect, handles, session, websocket
from bridge.client.protocol.actions import MAX_GOALS, MAX_SERVED_GOALS
from bridge.client.protocol.services import MAX_CALLS, MAX_REQUESTS
from bridge.codecs import fragments, json_codec
from bridge.hub.access import AccessPolicy
from tests.bridge.hub.sockets import running_hub
from tests.certificates import issue
from tests.patience import PATIENCE, PROCESS_PATIENCE

FOLDER = Path(__file__).parents[2] / "docs/how-to"
GUIDE = "\n".join(path.read_text() for path in sorted(FOLDER.glob("bridge*.md")))
EXAMPLES = dict(
    re.findall(r"^###? ([^\n]+)\n(?:(?!^##).)*?^```python\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
)
STARTS = re.findall(r"(?:^    |with\s`)hub(?: --ros-version (\d))?(?:`|$)", GUIDE, re.MULTILINE)
"""ROS versions of the hubs that the pages start for their examples."""
(ROS_VERSION,) = {int(number) for number in STARTS}
TOKEN = "guide-test-token-0123456789"

Company = Callable[[str], Awaitable[None]]


async def run(example: str, uri: str, company: Company | None = None) -> str:
    """Return the output of an example, run in a thread while `company` acts as the robot."""
    program = compile(example.replace("ws://127.0.0.1:9090", uri), "example.py", "exec")
    said = io.StringIO()

    def play() -> None:
        with contextlib.redirect_stdout(said):
            exec(program, {"__name__": "__main__"})  # noqa: S102  # the pages of this repository

    robot = asyncio.create_task(company(uri)) if company is not None else None
    with ThreadPoolExecutor(1) as thread:
        try:
            await asyncio.get_running_loop().run_in_executor(thread, play)
        finally:
            if robot is not None:
                robot.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await robot
    return said.getvalue()


def publishes(topic: str, type_name: str, *messages: dict[str, Any]) -> Company:
    """Publishes these again and again, until the example has had enough."""

    async def play(uri: str) -> None:
        async with connect(uri) as ros:
            publication = await ros.advertise(topic, type_name)
            while True:
                for message in messages:
                    await publication.publish(message)
                    await asyncio.sleep(0.05)

    return play


async def works_on_goals(uri: str) -> None:
    async with plain_connect(uri) as socket:

        async def say(**operation: Any) -> None:
            await socket.send(json.dumps(operation))

        await say(op="advertise_action", action="/fibonacci", type="example_interfaces/action/Fibonacci")
        async for text in socket:
            asked = json.loads(text)
            if asked["op"] == "send_action_goal":
                common = {"id": asked["id"], "action": "/fibonacci"}
                await say(op="action_feedback", values={"sequence": [0, 1]}, **common)
                await say(op="action_result", values={"sequence": [0, 1, 1]}, status=4, result=True, **common)


poses = publishes("/pose", "geometry_msgs/PointStamped", {"point": {"x": 0.8}}, {"point": {"x": 0.9}})

#: What is printed for a message that does not fit its type.
MISSPELT = "".join(
    line.removeprefix("    ") + "\n" for line in GUIDE.splitlines() if line.startswith("    a message of ")
)
#: By heading: who plays the robot, and what is printed.
PLAYED: dict[str, tuple[Company | None, str]] = {
    "Subscribe": (poses, "/pose {'x': 0.9,"),
    "Publish": (None, ""),
    "A misspelt field": (None, MISSPELT),
    "Long arrays": (None, "0.5 float64"),
    "Large messages": (None, "{'data': 'short'} discarded: 1\na message of /notes cannot be published"),
    "Serialised messages": (None, "laser [0.5 1.5]"),
    "Services": (None, "{'sum': 3}\nservice /add at ws://"),
    "Serve an action": (None, "SUCCEEDED {'sequence': [0, 1, 1, 2, 3, 5]}"),
    "Parameters, topics and nodes": (None, "15 1.0\nparameter /camera:gain at ws://"),
    "Threads": (None, "{'data': 'from a thread'}"),
    "Transforms between frames": (None, "[2. 1. 0.] [1.5 1.  0. ] (4, 4)\nframe gripper is not known"),
    "Find a variable in messages": (
        None,
        "D1 (True, 7)\ny (True, 2.5)\npose.position.x (True, 1.5)\nranges[1] (True, 0.5)\ndata[2] (True, 3)\n",
    ),
    "Several robots": (poses, "two {'x': 0.9,"),
    "Quality of service (ROS 2)": (None, "{'data': 'here be dragons'}"),
}
ELSEWHERE = {"Actions", "TLS, tokens, proxies", "roslibpy"}


@pytest.mark.parametrize("heading", PLAYED)
async def test_an_example_runs(heading):
    company, printed = PLAYED[heading]
    async with running_hub(ros_version=ROS_VERSION) as port:
        assert printed in await run(EXAMPLES[heading], f"ws://127.0.0.1:{port}", company)


@pytest.mark.thorough  # the loop of roslibpy can be started only once in a process
async def test_the_example_of_roslibpy():
    async with running_hub(ros_version=ROS_VERSION) as port:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", EXAMPLES["roslibpy"].replace("9090", str(port))),
            stdout=asyncio.subprocess.PIPE,
        )
        async with asyncio.timeout(PROCESS_PATIENCE):
            assert await process.communicate() == (b"hello\n", None)


async def test_what_is_published_is_heard():
    async with running_hub(ros_version=ROS_VERSION) as port, connect(f"ws://127.0.0.1:{port}") as ros:
        poses = ros.subscribe("/pose", "geometry_msgs/PointStamped")
        await ros.call("/rosapi/get_time", timeout=PATIENCE)
        await run(EXAMPLES["Publish"], ros.uri)
        heard = [(await poses.next(PATIENCE)).msg["point"]["x"] for _ in range(10)]
        assert heard == [0.1 * step for step in range(10)]


@pytest.mark.parametrize("served", [True, False])
async def test_the_goal_of_the_guide(served):
    async with running_hub(ros_version=ROS_VERSION) as port:
        uri = f"ws://127.0.0.1:{port}"
        if not served:
            assert "no result: action /fibonacci" in await run(EXAMPLES["Actions"], uri)
            return
        async with connect(uri) as ros:
            worker = asyncio.create_task(works_on_goals(uri))
            async with asyncio.timeout(PATIENCE):
                while "/fibonacci" not in (await ros.call("/rosapi/action_servers"))["action_servers"]:
                    await asyncio.sleep(0.05)
            out = await run(EXAMPLES["Actions"], uri)
            worker.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await worker
        assert "so far: {'sequence': [0, 1]}" in out
        assert "SUCCEEDED {'sequence': [0, 1, 1]}" in out


@pytest.mark.thorough
async def test_the_door_of_the_guide(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOT_TOKEN", TOKEN)
    certificate, key = issue(tmp_path, "server")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    example = EXAMPLES["TLS, tokens, proxies"].replace('"ca.pem"', repr(str(certificate)))
    async with running_hub(access=AccessPolicy(tokens=(TOKEN,), tls=context)) as port:
        out = await run(example.replace("localhost:9443", f"localhost:{port}"), "-")
    assert f"wss://localhost:{port} " in out
    assert TOKEN not in out


def test_no_example_is_left_out():
    assert set(EXAMPLES) == set(PLAYED) | ELSEWHERE
    assert len(EXAMPLES) == GUIDE.count("```python")


@pytest.mark.parametrize(
    ("row", "size"),
    [
        ("messages that wait in a subscription", str(handles.QUEUE_SIZE)),
        ("publications of a topic that wait", str(handles.PUBLISH_QUEUE_SIZE)),
        ("bytes that wait in the socket", f"{websocket.WRITE_LIMIT >> 10} KiB"),
        ("a message, both ways", f"{json_codec.MAX_SIZE >> 20} MiB"),
        ("nesting of objects and arrays", str(json_codec.MAX_DEPTH)),
        ("incomplete fragmented messages", str(fragments.MAX_SETS)),
        ("fragments of one message", str(fragments.MAX_FRAGMENTS)),
        ("waiting for the next fragment", f"{fragments.MAX_AGE:g} s"),
        ("calls that wait for answers", str(MAX_CALLS)),
        ("active goals", str(MAX_GOALS)),
        ("goals that this client executes", str(MAX_SERVED_GOALS)),
        ("feedback that waits in a goal", str(actions.FEEDBACK_QUEUE_SIZE)),
        ("concurrent requests to services of this client", str(MAX_REQUESTS)),
        ("the closing handshake", f"{websocket.CLOSE_TIMEOUT:g} s"),
        ("status messages kept", str(session.KEPT_STATUSES)),
    ],
)
def test_the_table_of_limits_is_true(row, size):
    (found,) = re.findall(rf"^\| {row}[^|]*\| ([^|]+) \|", GUIDE, re.MULTILINE)
    assert found == size
