"""The subscriber without a master says what it waits for: a server, and a topic that nobody publishes."""

import asyncio
import contextlib
import json
import socket

import pytest

from bridge.client import connect
from bridge.errors import FieldMissingError
from services.pipeline.connections import NotReceivableError
from services.pipes.subscriber import print_addresses, print_variables
from services.settings import Settings
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE
from toolchain.deployment import Source


def first_reading(fake, deployment):
    """Print the first reading of the boat; without a deployment, its message."""
    settings = Settings(uri=fake.uri, first_data_timeout=100 * PATIENCE)
    if deployment is not None:
        return print_addresses(settings, deployment, 1)
    source = Source(uri=fake.uri, topic="/boat/sensors", type="boat_msgs/Sensors")
    return print_variables(settings, source, [], 1)


@pytest.mark.parametrize("of_deployment", [False, True])
async def test_a_mistyped_topic_is_named_with_similar_ones(boat, capsys, monkeypatch, of_deployment):
    monkeypatch.setattr("services.pipeline.connections.AFTER", 0.05)
    async with FakeRosbridge(rosapi=True) as fake:
        fake.know("/boat/sensors2", "boat_msgs/Sensors")
        printing = asyncio.ensure_future(first_reading(fake, boat if of_deployment else None))
        said = ""
        async with asyncio.timeout(PATIENCE):
            while "/boat/sensors2" not in said:
                said += capsys.readouterr().err
                await asyncio.sleep(0.01)
        printing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await printing
    (warning,) = (line for line in said.splitlines() if "/boat/sensors2" in line)
    assert warning.startswith("warning: ")


@pytest.mark.parametrize("of_deployment", [False, True])
async def test_a_topic_of_another_type_is_named_at_once(boat, of_deployment):
    async with FakeRosbridge(rosapi=True) as fake, connect(fake.uri) as robot:
        await robot.advertise("/boat/sensors", "std_msgs/String")
        with pytest.raises(NotReceivableError, match=r"is std_msgs/String at .*, not boat_msgs/Sensors; use"):
            await first_reading(fake, boat if of_deployment else None)


async def test_all_variables_that_are_not_found_are_named(capsys):
    async with FakeRosbridge() as fake:
        source, names = Source(uri=fake.uri, topic="/t", type="p/T"), ["D7", "pose.x", "B9"]
        printing = asyncio.create_task(print_variables(Settings(), source, names, 1))
        await fake.wait_for_op("subscribe", topic="/t")
        await fake.publish("/t", {"pose": {"x": 1}})
        with pytest.raises(FieldMissingError, match=r"no fields 'D7', 'B9'; it has pose\.x"):
            await printing
    assert capsys.readouterr().out == ""


async def test_a_server_that_comes_later_is_waited_for_aloud(capsys):
    with socket.socket() as place:
        place.bind(("127.0.0.1", 0))
        port = place.getsockname()[1]
    source = Source(uri=f"ws://127.0.0.1:{port}", topic="/t", type="p/T")
    printing = asyncio.create_task(print_variables(Settings(connect_timeout=PATIENCE), source, [], 1))
    said = ""
    async with asyncio.timeout(PATIENCE):
        while source.uri not in said:
            await asyncio.sleep(0.01)
            said += capsys.readouterr().err
        async with FakeRosbridge(port=port) as fake:
            await fake.wait_for_op("subscribe", topic="/t")
            await fake.publish("/t", {"x": 1})
            await printing
    assert json.loads(capsys.readouterr().out) == {"x": 1}
