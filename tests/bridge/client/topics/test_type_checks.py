"""A message that does not fit its type is refused before it is sent, if the type is known."""

import time

import pytest

from bridge.client import connect
from bridge.codecs.message_check import CLOSELY, SAMPLE
from bridge.errors import MessageTypeError
from tests.bridge.hub.sockets import running_hub

TWIST = "geometry_msgs/Twist"
WRONG = {"lineer": {"x": 1.0}}
TYPEDEF = {
    "type": TWIST,
    "fieldnames": ["linear"],
    "fieldtypes": ["geometry_msgs/Vector3"],
    "fieldarraylen": [-1],
}
VECTOR = {
    "type": "geometry_msgs/Vector3",
    "fieldnames": ["x"],
    "fieldtypes": ["float64"],
    "fieldarraylen": [-1],
}


@pytest.mark.parametrize("version", [1, 2])
async def test_the_hub_knows_the_standard_types(version):
    async with running_hub(ros_version=version) as port, connect(f"ws://127.0.0.1:{port}") as ros:
        heard = ros.subscribe("/cmd_vel", TWIST)
        publication = await ros.advertise("/cmd_vel", TWIST)
        for send in (publication.publish, _nowait(publication)):
            with pytest.raises(MessageTypeError):
                await send(WRONG)
            await send({"linear": {"x": 1.0}})
            assert (await heard.next(30)).msg["linear"]["x"] == 1.0
        unknown = await ros.advertise("/boat", "boat_msgs/Sensors")
        await unknown.publish(WRONG)


def _nowait(publication):
    async def send(msg):
        publication.publish_nowait(msg)

    return send


async def test_the_server_is_asked_once_for_a_type(fake, ros):
    fake.serve("/rosapi/message_details", lambda _args: {"typedefs": [TYPEDEF]})
    publications = [
        await ros.advertise(topic, type_)
        for topic, type_ in (("/a", TWIST), ("/b", "geometry_msgs/msg/Twist"))
    ]
    for publication in publications:
        with pytest.raises(MessageTypeError):
            await publication.publish(WRONG)
    assert len(fake.ops("call_service", service="/rosapi/message_details")) == 1


@pytest.mark.parametrize(
    ("ros", "refused"),
    [({"ros_version": "2"}, True), ({}, False), ({"ros_version": "2", "check_types": False}, False)],
    indirect=["ros"],
)
async def test_without_rosapi_standard_types_are_known_if_the_ros_version_is(ros, refused):
    publication = await ros.advertise("/cmd_vel", TWIST)
    if refused:
        with pytest.raises(MessageTypeError):
            await publication.publish(WRONG)
    else:
        await publication.publish(WRONG)


@pytest.mark.parametrize("fake", [{"silent": True}], indirect=True)
async def test_a_silent_server_is_waited_for_once(ros):
    begun = time.monotonic()
    for n in range(5):
        await ros.advertise(f"/t{n}", f"p/T{n}")
    assert time.monotonic() - begun < 4


async def test_a_publisher_of_many_right_messages_is_watched_less_closely(fake, ros):
    fake.serve("/rosapi/message_details", lambda _args: {"typedefs": [TYPEDEF, VECTOR]})
    publication = await ros.advertise("/cmd_vel", TWIST)
    for _ in range(2 * CLOSELY):
        publication.publish_nowait({"linear": {"x": 1.0}})
    with pytest.raises(MessageTypeError):
        publication.publish_nowait(WRONG)
    for _ in range(2 * CLOSELY):
        publication.publish_nowait({"linear": {"x": 1.0}})
    refused = 0
    for _ in range(SAMPLE):
        try:
            publication.publish_nowait({"linear": {"u": 1.0}})
        except MessageTypeError:
            refused += 1
    assert refused >= 1
