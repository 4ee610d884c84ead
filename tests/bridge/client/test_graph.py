"""Questions about topics, services and types, in the forms of ROS 1 and ROS 2."""

import pytest

from bridge.client import connect
from bridge.codecs.message_check import FieldType
from tests.bridge.hub.sockets import running_hub

DOCK = "/dock"


@pytest.fixture(params=[1, 2])
async def ros(request):
    async with running_hub(ros_version=request.param) as port, connect(f"ws://127.0.0.1:{port}") as ros:
        yield ros


async def test_without_rosapi(fake):
    async with connect(fake.uri) as ros:
        assert await ros.topics() is None
        assert await ros.publishers("/a") is None
        assert await ros.topic_type("/a") is None
        assert await ros.message_details("std_msgs/String") == {}


async def test_topics_services_and_types(ros):
    async def serve(args):
        return args

    await ros.advertise("/out", "std_msgs/String")
    await ros.advertise_service(DOCK, "std_srvs/SetBool", serve)
    assert await ros.topic_type("/out") in {"std_msgs/String", "std_msgs/msg/String"}
    assert await ros.topic_type("/nothing") == ""
    assert "/out" in await ros.topics()
    assert len(await ros.publishers("/out")) == 1
    assert await ros.publishers("/nothing") == []
    assert DOCK in await ros.services()
    assert await ros.service_type(DOCK) in {"std_srvs/SetBool", "std_srvs/srv/SetBool"}
    assert (await ros.message_details("nav_msgs/msg/Odometry"))["geometry_msgs/PoseWithCovariance"][
        "covariance"
    ] == FieldType("float64", 36)
