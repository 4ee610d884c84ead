"""The end of a wait for messages, without its time."""

import asyncio

from tests.patience import PATIENCE


def give_up(subscription):
    """End the present wait as at its deadline."""
    subscription._deadline = 0.0
    subscription._ring()


async def until(condition):
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.01)
