"""Parameters, and questions about topics, services and nodes, in the forms of ROS 1 and ROS 2."""

import numpy as np
import pytest

from bridge.client import connect
from bridge.client.rosapi import NodeDetails
from bridge.codecs.message_check import FieldType
from bridge.errors import EncodeError, ParamError, ServiceError
from tests.bridge.hub.sockets import running_hub

DOCK = "/dock"


@pytest.fixture(params=[1, 2])
async def ros(request):
    async with running_hub(ros_version=request.param) as port, connect(f"ws://127.0.0.1:{port}") as ros:
        yield ros


async def test_a_parameter_is_set_read_and_deleted(ros):
    params = ros.params
    for value in (1.5, "text", "15", False, [1, 2], {"a": {"b": 1}}, np.arange(2)):
        await params.set("/node:param", value)
        found = await params.get("/node:param")
        assert (found, type(found)) == (
            (value.tolist(), list) if isinstance(value, np.ndarray) else (value, type(value))
        )
    assert await params.has("/node:param")
    assert "/node:param" in await params.names()
    await params.delete("/node:param")
    assert not await params.has("/node:param")
    assert await params.get("/node:param", default=None) is None
    with pytest.raises(ParamError):
        await params.get("/node:param")


async def test_a_parameter_that_is_refused(ros):
    with pytest.raises((ParamError, ServiceError)):
        await ros.params.set("x" * 1000, 1)
    with pytest.raises(EncodeError):
        await ros.params.set("/a", float("nan"))


@pytest.mark.parametrize(
    ("text", "value"), [("", "d"), ("null", "d"), ("plain text", "plain text"), ("3", 3)]
)
async def test_the_forms_of_other_servers(fake, text, value):
    fake.serve("/rosapi/get_param", lambda _args: {"value": text})
    async with connect(fake.uri) as ros:
        assert await ros.params.get("/a", default="d") == value


async def test_without_rosapi(fake):
    async with connect(fake.uri) as ros:
        with pytest.raises(ServiceError):
            await ros.params.names()
        assert await ros.subscribers("/a") is None
        assert await ros.node_details("/a") is None
        assert await ros.service_type("/a") is None
        assert await ros.message_details("std_msgs/String") == {}


async def test_topics_services_and_nodes(ros):
    async def serve(args):
        return args

    ros.subscribe("/in", "std_msgs/String")
    await ros.advertise("/out", "std_msgs/String")
    await ros.advertise_service(DOCK, "std_srvs/SetBool", serve)
    (node,) = await ros.subscribers("/in")
    assert await ros.publishers("/out") == [node]
    assert await ros.node_details(node) == NodeDetails(["/in"], ["/out"], [DOCK])
    assert await ros.node_details("/nobody") == NodeDetails([], [], [])
    assert set(await ros.topics_for_type("std_msgs/msg/String")) == {"/in", "/out"}
    assert await ros.service_type(DOCK) == (
        "std_srvs/srv/SetBool" if ros.ros_version == 2 else "std_srvs/SetBool"
    )
    assert await ros.service_node(DOCK) == node
    assert await ros.service_providers("std_srvs/SetBool") == [node]
    assert (await ros.message_details("nav_msgs/msg/Odometry"))["geometry_msgs/PoseWithCovariance"][
        "covariance"
    ] == FieldType("float64", 36)
