"""The whole chain of binocular disparity, as its demo starts it; a robot without any code of ours listens.

disparity-cameras -> hub -> disparity-matcher -> hub -> master, its processes and a board of 160 machines -> hub ->
disparity-matcher -> hub -> robot
"""

import base64
import re
import sys

import numpy as np
import pytest
from matplotlib.image import imread

from casestudies.disparity.matching import FILTERS
from machines.posterior import posterior
from pcie_shim.programming_file import read_image
from tests.integration.conftest import Robot, stamp_of, until
from toolchain.deployment import load_deployment
from toolchain.deployment.address_array import to_addresses

TOPICS = {
    "/disparity/likelihoods": "disparity_msgs/Likelihoods",
    "/stereo/disparity": "stereo_msgs/DisparityImage",
}


@pytest.mark.process
async def test_the_demo_turns_images_into_the_disparities_of_its_machines(stage, tmp_path):
    demo = stage.start(
        *(sys.executable, "-m", "rosbayes", "demo", "--disparity"),
        *("--count", "2", "--seed", "7", "--out", str(tmp_path)),
    )
    listening = await until(
        lambda: re.search(r"listening to (ws://\S+)\n", demo.out), lambda: demo.err + demo.out
    )
    async with Robot(listening[1], TOPICS) as robot:
        assert await demo.end() == 0, demo.err + demo.out
        await robot.lost()
    # what it printed: 160 x 120 pixels are 120 tiles
    lines = re.findall(
        r"^ +\d +[\d.]+ +[\d.]+ +[\d.]+ +(\d+) +([\d.]+)% +([\d.]+)% +([\d.]+)%", demo.out, re.MULTILINE
    )
    assert len(lines) == 2
    for cycles, exact, machines, agreement in lines:
        assert 120 * 255 <= int(cycles) <= 120 * 8192
        assert abs(float(exact) - float(machines)) < 0.5
        assert float(machines) < 10
        assert float(agreement) > 95
    assert imread(tmp_path / "disparity.png").shape[1] == 800

    # each tile's posteriors are those of the machines alone, to the bit
    deployment = load_deployment(tmp_path / "deployment")
    machine = read_image(tmp_path / "deployment" / "boards" / "board0.bm").machine
    tiles = {stamp_of(tile): tile for tile in robot.heard["/disparity/likelihoods"]}
    reports = {stamp_of(report): (report, result) for report, result in robot.paired}
    newest = sorted(tiles)[-120:]
    sensors = [variable for variable in deployment.variables if variable.kind == "sensor"]
    for stamp in newest[::17]:
        report, result = reports[stamp]
        number = next(int(pair["value"]) for pair in report["status"][0]["values"] if pair["key"] == "number")
        columns = [to_addresses(deployment, variable, tiles[stamp][variable.name]) for variable in sensors]
        inputs = np.array(columns).reshape(len(FILTERS), 160, 16).transpose(1, 0, 2)
        wanted = posterior(machine, inputs, max_cycles=8192, bank=number % machine.parameters.rng_banks)
        assert np.array(result["data"]).reshape(160, 16) == pytest.approx(wanted, abs=1e-12)

    # and the disparity image consists of the most probable ones
    image = robot.heard["/stereo/disparity"][-1]
    pixels = np.frombuffer(base64.b64decode(image["image"]["data"]), "<f4")
    results = np.concatenate([np.reshape(reports[stamp][1]["data"], (160, 16)) for stamp in newest])
    assert (pixels == results.argmax(axis=1)).all()
    assert (image["image"]["width"], image["image"]["height"], image["f"]) == (160, 120, 160)
    await stage.nothing_left()
