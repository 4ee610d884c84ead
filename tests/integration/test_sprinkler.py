"""The whole chain of the sprinkler, as its demo starts it.

sprinkler-garden -> hub -> master, its processes and two boards -> hub -> sprinkler-viewer -> picture
"""

import re
import sys

import pytest
from matplotlib.image import imread

from casestudies.demo import FIRST_RESULT
from casestudies.sprinkler.model import exact_rain
from tests.integration.conftest import until


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


@pytest.mark.process
async def test_a_demo_outlives_its_boards_and_its_pcie_application(stage, tmp_path):
    """The master of a demo is forked, and starts processes again all the same."""
    demo = stage.start(
        *(sys.executable, "-m", "rosbayes", "demo", "--sprinkler"),
        *("--count", "30", "--seed", "2", "--out", str(tmp_path)),
    )

    def frames():
        return len(re.findall(FIRST_RESULT, demo.out, re.MULTILINE))

    for role in ("pcie-app", "board"):
        seen = frames()
        await until(lambda seen=seen: frames() > seen + 2, lambda: demo.err + demo.out)
        for process in stage.processes()[role]:
            process.kill()
    assert await demo.end() == 0, demo.err + demo.out
    said = (tmp_path / "master.log").read_text()
    assert re.findall(r"\[warning\] (.+) was killed by SIGKILL; restarting it", said) == [
        "pcie-app",
        "the boards' process",
    ]
    await stage.nothing_left()
