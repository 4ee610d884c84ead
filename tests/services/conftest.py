"""The deployment that the services' tests share, which no test changes, and their wait."""

import asyncio

import pytest

from tests.integration.conftest import the_boat
from tests.patience import PATIENCE
from toolchain.deployment import load_deployment


async def until(true):
    async with asyncio.timeout(PATIENCE):
        while not true():
            await asyncio.sleep(0.001)


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    return the_boat(tmp_path_factory)


@pytest.fixture(scope="session")
def boat(built):
    """The boat's deployment on 8 x 8 cells and four boards."""
    return load_deployment(built)
