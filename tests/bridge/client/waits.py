"""The end of a wait for messages, without its time."""

import asyncio
from collections.abc import Callable

from bridge.client.handles import Subscription
from tests.patience import PATIENCE


def give_up(subscription: Subscription) -> None:
    """End the present wait as at its deadline."""
    subscription._deadline = 0.0
    subscription._ring()


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.01)
