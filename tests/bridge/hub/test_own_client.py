"""This project's client on this project's hub."""

from contextlib import AsyncExitStack
from typing import Any

import pytest

from bridge.client import connect
from bridge.client.session import State
from bridge.errors import ServiceError
from tests.bridge.hub.sockets import PATIENCE, running_hub


async def test_topics_and_services_pass() -> None:
    async def add(args: Any) -> dict[str, Any]:
        if args["b"] < 0:
            raise ServiceError("only from 0 up")
        return {"sum": args["a"] + args["b"]}

    async with (
        running_hub() as port,
        connect(f"ws://127.0.0.1:{port}") as one,
        connect(f"ws://127.0.0.1:{port}") as other,
    ):
        assert await one.detect_ros_version() == 1
        subscription = other.subscribe("/t", "std_msgs/Float64MultiArray")
        await other.call("/rosapi/get_time")
        publication = await one.advertise("/t", "std_msgs/msg/Float64MultiArray")
        await publication.publish({"data": [1.0, 0.1, 1e-300]})
        assert (await subscription.next(PATIENCE)).msg == {"data": [1.0, 0.1, 1e-300]}
        await one.advertise_service("/add", "a/Add", add)
        await one.call("/rosapi/get_time")
        assert await other.call("/add", {"a": 1, "b": 2}) == {"sum": 3}
        with pytest.raises(ServiceError, match="only from 0 up"):
            await other.call("/add", {"a": 1, "b": -2})


async def test_a_hub_that_comes_back_on_its_port_finds_its_clients_again() -> None:
    async with running_hub() as port:
        pass
    async with AsyncExitStack() as clients:
        for life in range(3):
            async with running_hub(port=port):
                if life == 0:
                    ros = await clients.enter_async_context(connect(f"ws://127.0.0.1:{port}"))
                    subscription = ros.subscribe("/t", "std_msgs/String")
                    publication = await ros.advertise("/t", "std_msgs/String")
                await ros.wait_for_state(State.CONNECTED, PATIENCE)
                await ros.call("/rosapi/get_time")
                await publication.publish({"data": str(life)})
                assert (await subscription.next(PATIENCE)).msg == {"data": str(life)}
            await ros.wait_for_state(State.RECONNECTING, PATIENCE)
