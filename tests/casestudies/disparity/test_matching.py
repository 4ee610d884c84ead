"""The host's part of binocular disparity against loops over pixels, and a tile on the machine against the reference."""

import base64
import dataclasses

import numpy as np
import pytest

from casestudies.disparity import matching
from casestudies.disparity.matcher import tiles_of
from casestudies.disparity.scene import Scene
from machines import make_kernel
from machines.bm1 import Start
from machines.kernel import BM1Kernel
from machines.reference import ReferenceBM1
from pcie_shim.programming_file import read_image
from tests.toolchain.running import done, toolchain
from toolchain.deployment import load_deployment
from toolchain.deployment.address_array import to_addresses


def image(seed, height=9, width=11):
    return np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)


def mean_around(values, y, x, reach):
    """The mean over the part of a window that is inside the image."""
    return values[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1].mean()


def test_filters_are_those_of_loops():
    picture = image(1)
    outputs = matching.filtered(picture)
    assert outputs.shape == (len(matching.FILTERS), *picture.shape)
    height, width = picture.shape
    grey = picture.astype(float)

    def at(y, x):
        return grey[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]

    for y in range(height):
        for x in range(width):
            across = sum(w * (at(y + s, x + 1) - at(y + s, x - 1)) for s, w in ((-1, 1), (0, 2), (1, 1))) / 4
            down = sum(w * (at(y + 1, x + s) - at(y - 1, x + s)) for s, w in ((-1, 1), (0, 2), (1, 1))) / 4
            surround = mean_around(grey, y, x, 1) - mean_around(grey, y, x, 4)
            assert outputs[:, y, x] == pytest.approx([across, down, surround], abs=1e-3)


def test_costs_are_those_of_a_loop_and_none_beyond_the_border():
    left, right = image(2), image(3)
    costs = matching.matching_costs(left, right, 14)  # more disparities than the 11 columns
    ours, theirs = matching.filtered(left), matching.filtered(right)
    for d in range(14):
        assert np.isnan(costs[:, d, :, :d]).all()
        for number in range(len(matching.FILTERS)):
            # the columns for which there is a match
            difference = np.abs(ours[number][:, d:] - theirs[number][:, : max(11 - d, 0)])
            for y, x in np.ndindex(difference.shape):
                assert costs[number, d, y, d + x] == pytest.approx(
                    mean_around(difference, y, x, matching.WINDOW), abs=1e-3
                )


def test_likelihoods_fall_with_the_cost_to_that_of_an_outlier():
    costs = np.array([0, 2, 1e6], np.float32).reshape(1, 3, 1, 1).repeat(3, axis=0)
    likely = matching.likelihoods(costs)[..., 0, 0]
    for row, scale in zip(likely, matching.SCALES, strict=True):
        assert row == pytest.approx(
            [1, (1 - matching.OUTLIER) * np.exp(-2 / scale) + matching.OUTLIER, matching.OUTLIER]
        )


def test_a_disparity_beyond_the_border_is_neither_preferred_nor_excluded():
    likely = matching.likelihoods(matching.matching_costs(image(4), image(5), 8))
    assert np.isfinite(likely).all()
    for x in range(8):
        assert likely[:, x + 1 :, :, x] == pytest.approx(
            np.broadcast_to(
                likely[:, : x + 1, :, x].mean(axis=1, keepdims=True), likely[:, x + 1 :, :, x].shape
            )
        )
    # nothing is known but the prior
    assert matching.fused(likely)[:, :, 0] == pytest.approx(1 / 8)


def test_a_shift_is_found_and_bytes_hardly_change_it():
    right = Scene(5).pair(0, 64, 32).left
    left = np.roll(right, 3, axis=1)
    likely = matching.likelihoods(matching.matching_costs(left, right, 8))
    codes = matching.as_bytes(likely)
    assert (codes.max(axis=1) == 255).all()
    exact, rounded = matching.fused(likely), matching.fused(codes)
    assert exact.sum(axis=0) == pytest.approx(1)
    assert np.abs(exact - rounded).sum(axis=0).max() / 2 < 0.01
    assert (exact.argmax(axis=0)[:, 12:] == 3).all()


def test_a_tile_on_the_machine_counts_as_the_reference_does(tmp_path):
    """A real tile, as the subscriber converts it; pixels of the first, the middle and the padding."""
    done(
        toolchain(
            *("build", "casestudies/disparity", "-o", tmp_path, "--sensor-mode", "threshold"),
            *("--replicas", "40", "--max-cycles", "3000", "--uri", "ws://robot:9090"),
            *("--topic", "/disparity/likelihoods", "--type", "disparity_msgs/Likelihoods"),
        )
    )
    deployment = load_deployment(tmp_path)
    machine = read_image(tmp_path / "boards" / "board0.bm").machine
    pair = Scene(3).pair(0, 30, 10)
    codes = matching.as_bytes(matching.likelihoods(matching.matching_costs(pair.left, pair.right, 16)))
    tiles = tiles_of(codes, 40)
    assert tiles.shape == (8, 3, 40, 16)  # 300 pixels
    assert (tiles[2, :, 5] == codes[:, :, 2, 25]).all()
    assert (tiles[7, :, 20:] == 255).all()
    variables = [each for each in deployment.variables if each.kind == "sensor"]
    assert [each.name for each in variables] == list(matching.FILTERS)
    columns = [
        to_addresses(deployment, variable, base64.b64encode(each.tobytes()).decode())
        for variable, each in zip(variables, tiles[7], strict=True)
    ]
    inputs = np.array(columns).reshape(3, 40, 16).transpose(1, 0, 2)
    settings = {"target_count": 255, "max_cycles": 3000, "bank": 5}
    kernel: BM1Kernel = make_kernel(machine)
    kernel.start(Start(addresses=inputs, **settings))
    alone = dataclasses.replace(machine, parameters=dataclasses.replace(machine.parameters, replicas=1))
    for pixel in (0, 11, 19, 39):
        reference = ReferenceBM1(alone)
        reference.start(Start(addresses=inputs[pixel], **settings))
        assert kernel.counts[pixel].tolist() == reference.counts.tolist()
        assert kernel.replica_cycles[pixel] == reference.cycles
    assert kernel.counts[39].tolist() == [255] * 16
