"""A message that does not fit its type is refused before it is sent, if the type is known."""

import asyncio

import pytest

from bridge.client import State, connect, type_checks
from bridge.errors import MessageTypeError, ServiceError
from tests.patience import PATIENCE

TWIST = "geometry_msgs/Twist"
WRONG = {"lineer": {"x": 1.0}}
TYPEDEF = {
    "type": TWIST,
    "fieldnames": ["linear"],
    "fieldtypes": ["geometry_msgs/Vector3"],
    "fieldarraylen": [-1],
}
BOTH = pytest.mark.parametrize("hub", [{"ros_version": 1}, {"ros_version": 2}], indirect=True)


@BOTH
async def test_the_first_message_of_each_publication_is_checked(hub):
    async with connect(hub) as ros:
        heard = ros.subscribe("/cmd_vel", TWIST)
        for _ in range(2):
            publication = await ros.advertise("/cmd_vel", TWIST)
            with pytest.raises(MessageTypeError):
                await publication.publish(WRONG)
            with pytest.raises(MessageTypeError):  # a refused message is not the first one
                publication.publish_nowait(WRONG)
            await publication.publish({"linear": {"x": 1.0}})
            assert (await heard.next(PATIENCE)).msg["linear"]["x"] == 1.0
        unknown = await ros.advertise("/boat", "boat_msgs/Sensors")
        await unknown.publish(WRONG)


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
async def test_a_silent_server_is_waited_for_once(fake, ros, monkeypatch):
    monkeypatch.setattr(type_checks, "_ROSAPI_TIMEOUT", 0.1)
    for n in range(5):
        await ros.advertise(f"/t{n}", f"p/T{n}")
    await fake.wait_for_op("advertise", count=5)
    assert len(fake.ops("call_service", service="/rosapi/message_details")) == 1


@BOTH
async def test_a_request_and_an_answer_are_checked_like_messages(hub):
    async with connect(hub) as server, connect(hub) as ros, connect(hub, check_types=False) as unchecked:
        asked = []

        async def switch(args):
            asked.append(args)
            return {"success": True} if args["data"] else {"sucess": False}

        await server.advertise_service("/switch", "std_srvs/SetBool", switch)
        assert (await ros.call("/switch", {"data": True}))["success"] is True
        for wrong in ({"dta": True}, {"data": [True]}):
            with pytest.raises(MessageTypeError, match="/switch"):
                await ros.call("/switch", wrong)
        assert asked == [{"data": True}]
        with pytest.raises(ServiceError, match="sucess"):
            await ros.call("/switch", {"data": False})
        await unchecked.call("/switch", {"data": True, "dta": True})
        assert asked[-1]["dta"] is True


@pytest.mark.parametrize("type_name", ["example_interfaces/action/Fibonacci", "example_interfaces/Fibonacci"])
async def test_a_goal_is_checked(hub, type_name):
    async with connect(hub) as server, connect(hub) as ros:

        async def count(goal):
            return {"sequence": list(range(goal.values["order"]))}

        async with await server.advertise_action("/count", type_name, count):
            await server.call("/rosapi/get_time")
            for wrong in ({"odrer": 3}, {"order": [3]}):
                with pytest.raises(MessageTypeError):
                    await ros.send_goal("/count", type_name, wrong)
            async with await ros.send_goal("/count", type_name, {"order": 3}, timeout=PATIENCE) as goal:
                assert (await goal.result(PATIENCE)).values["sequence"] == [0, 1, 2]


async def test_the_type_of_a_service_is_asked_once_for_each_connection(fake, ros):
    fake.serve("/add", lambda args: args)
    fake.serve("/rosapi/service_type", lambda _args: {"type": "p/Add"})
    typedef = {"type": "p/AddRequest", "fieldnames": ["a"], "fieldtypes": ["int64"], "fieldarraylen": [-1]}
    fake.serve("/rosapi/service_request_details", lambda _args: {"typedefs": [typedef]})
    for connection, (right, wrong) in enumerate((("a", "b"), ("b", "a"))):
        typedef["fieldnames"] = [right]
        requests = [{right: n} for n in range(3)]
        assert await asyncio.gather(*(ros.call("/add", request) for request in requests)) == requests
        with pytest.raises(MessageTypeError):
            await ros.call("add", {wrong: 1})
        for question in ("service_type", "service_request_details"):
            assert len(fake.ops("call_service", service=f"/rosapi/{question}")) == connection + 1
        await fake.cut()
        await fake.wait_for_connections(connection + 2)
        await ros.wait_for_state(State.CONNECTED, PATIENCE)
