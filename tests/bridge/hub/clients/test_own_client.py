"""This project's client on this project's hub."""

from contextlib import AsyncExitStack

from bridge.client import connect
from bridge.client.session import State
from tests.bridge.hub.sockets import running_hub
from tests.patience import PATIENCE


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
