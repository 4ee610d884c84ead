"""Transforms from `/tf` and `/tf_static`, through the hub."""

import asyncio

import numpy as np
import pytest

from bridge.client import connect
from bridge.errors import FrameUnknownError
from tests.bridge.test_transforms import SECOND, message, turned
from tests.patience import PATIENCE


@pytest.mark.parametrize("hub", [{"ros_version": 1}, {"ros_version": 2}], indirect=True)
async def test_a_lookup_waits_for_both_topics(hub):
    async with connect(hub) as ros:
        static = await ros.advertise("/tf_static", "tf2_msgs/TFMessage", latch=True)
        await static.publish(message("base", "laser", turned(0.5, 0, SECOND)))
        async with ros.transforms() as transforms:
            with pytest.raises(FrameUnknownError):
                await transforms.lookup("map", "laser", timeout=0.05)
            waiting = asyncio.create_task(transforms.lookup("map", "laser", 3 * SECOND, PATIENCE))
            moving = await ros.advertise("/tf", "tf2_msgs/TFMessage")
            for second in (2, 4):
                await moving.publish(message("map", "base", turned(second, 0, second * SECOND)))
            assert np.allclose((await waiting).apply([0, 0, 0]), [3.5, 0, 0])
        await transforms.close()
