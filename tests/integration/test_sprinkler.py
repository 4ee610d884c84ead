"""The whole chain of the sprinkler, as its demo starts it.

sprinkler-garden -> hub -> master, its processes and two boards -> hub -> sprinkler-viewer -> picture
"""

import re
import sys

import pytest
from matplotlib.image import imread

from casestudies.sprinkler.model import exact_rain


@pytest.mark.process
async def test_the_demo_answers_within_its_own_error(stage, tmp_path):
    demo = stage.start(
        *(sys.executable, "-m", "rosbayes", "demo", "--sprinkler"),
        *("--count", "12", "--seed", "2", "--out", str(tmp_path)),
    )
    assert await demo.end() == 0, demo.err + demo.out
    frames = re.findall(r"^ +(\d+) +(dry|wet) +([\d.]+) +([\d.]+) +([\d.]+) +(\d+)$", demo.out, re.MULTILINE)
    assert len(frames) == 12
    for _, grass, share, error, exact, effective in frames:
        assert float(exact) == round(exact_rain(int(grass == "wet")), 4)
        assert abs(float(share) - float(exact)) <= 4.5 * float(error)
        # with wet grass the chain rarely moves between rain and sprinkler
        assert 500 < float(effective) < 2_000 if grass == "wet" else float(effective) > 50_000
    estimates = re.findall(r"G = (\d)\) is ([\d.]+) \+- ([\d.]+) in", demo.out)
    assert [grass for grass, _, _ in estimates] == ["0", "1"]
    for grass, mean, error in estimates:
        assert abs(float(mean) - exact_rain(int(grass))) <= 4 * float(error)
        assert float(error) < 0.02
    (picture,) = re.findall(r"^wrote (.*)$", demo.out, re.MULTILINE)
    assert picture == str(tmp_path / "sprinkler.png")
    assert imread(picture).shape[1] > 800
    await stage.nothing_left()
