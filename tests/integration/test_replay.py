"""A recording has the posteriors that the running stack publishes for the same readings, to the bit.

robot ─20 readings─▶ hub ─▶ master ─▶ four boards ─▶ posteriors ─┐
recording.csv ──────────────▶ toolchain infer ─▶ posteriors ─────┴─▶ equal
"""

import numpy as np
import pytest

from tests.integration.conftest import LOOP, READING, inferred, until_subscribed


@pytest.mark.process
async def test_a_recording_has_the_posteriors_of_the_stack(stage, robot, boat, tmp_path):
    drawn = np.random.default_rng(5).integers(-4, 5, (20, len(READING)))
    rows = [
        [max(0, value + int(by)) for value, by in zip(READING.values(), each, strict=True)] for each in drawn
    ]
    rows[3][0] = rows[11][2] = None  # bad input: they are no frames
    master = stage.start(*LOOP, "-d", boat, "--uri", robot.uri, "--count", "18", "--queue", "all")
    await until_subscribed(robot.uri, "/boat/sensors")
    for row in rows:
        await robot.publish(**dict(zip(READING, row, strict=True)))
    await robot.have(18)
    assert await master.end() == 0, master.err
    assert inferred(boat, rows, tmp_path) == [result["data"] for result in robot.results]
