"""The predicted share of lost frames is that of the machine, and the advised options save them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from machines.parameters import RngKind, SensorMode
from tests.toolchain.builders import corridor, posts
from tests.toolchain.running import OPTIONS
from toolchain.analysis.accuracy import measure
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.analysis.lost_frames import TOLERATED, _union, lost_frames
from toolchain.analysis.readings import readings_of_lines, sample_readings
from toolchain.building.build import assemble
from toolchain.building.machine import plan_machine
from toolchain.deployment import Scale


def predicted(model, options):
    plan = plan_machine(model, options)
    return lost_frames(plan, assemble(plan).quantised)


def measured(model, options, frames=150):
    plan = plan_machine(model, options)
    machines = [image.machine for image in assemble(plan).images]
    readings = sample_readings(model, frames, seed=7)
    if options.sensor_mode is not SensorMode.COLUMN:
        readings = readings_of_lines(readings, model, machines[0], scale=options.scaling, seed=7)
    boards = EmulatedBoards(
        machines, target_count=plan.target_count, max_cycles=plan.max_cycles, stop=options.stop
    )
    return measure(boards, readings, None, banks=1).without


@pytest.mark.parametrize(
    ("count", "changes"),
    [
        (8, {"max_cycles": 500}),
        (4, {"max_cycles": 50, "shared": False}),
        (5, {"max_cycles": 2**14, "scale": Scale.COLUMN}),
        (12, {"max_cycles": 2**12, "prob_bits": 4}),
        (3, {"max_cycles": 2**12, "sensor_mode": SensorMode.CELL}),
        (5, {"max_cycles": 200, "sensor_mode": SensorMode.THRESHOLD}),
    ],
)
def test_the_machine_loses_as_many(count, changes):
    options = replace(OPTIONS, **changes)
    lost = predicted(posts(count), options)
    assert 0.05 < lost.share < 0.95  # so that a wrong formula would show
    assert measured(posts(count), options) == pytest.approx(lost.share, abs=0.1)


def test_few_lost_frames_need_no_advice():
    lost = predicted(corridor(), OPTIONS)
    assert (lost.share, lost.advice) == (pytest.approx(0, abs=1e-6), "")


@pytest.mark.parametrize(
    ("count", "changes", "ways"),
    [
        (8, {"max_cycles": 1000}, ["--max-cycles 1024000"]),
        (8, {"max_cycles": 2**14, "rng": RngKind.LFSR16}, ["--rng lfsr32"]),
        (6, {"scale": Scale.COLUMN}, ["--scale address"]),
    ],
)
def test_the_advised_options_save_as_many_as_they_say(count, changes, ways):
    model, options = posts(count), replace(OPTIONS, **changes)
    advice = predicted(model, options).advice
    offered = re.findall(r"(--[^(]+) \(then ([\d.]+)%\)", advice)
    assert offered
    assert any(flags.startswith(way) for flags, _ in offered for way in ways), advice
    for flags, percent in offered:
        pairs = [each.split() for each in flags.removeprefix("--").split(" --")]
        words = {key.replace("-", "_"): value for key, value in pairs}
        kinds = {"scale": Scale, "rng": RngKind}
        given = {key: kinds.get(key, int)(value) for key, value in words.items()}
        assert float(percent) / 100 <= TOLERATED
        assert measured(model, replace(options, **given)) <= 2 * TOLERATED


def test_too_many_sensors_are_said_to_be():
    lost = predicted(posts(30), replace(OPTIONS, max_cycles=2**20))
    assert lost.share > 0.8
    count = int(re.search(r"with only the first (\d+) known variables", lost.advice)[1])
    assert 1 < count < 30
    assert "toolchain advise" in lost.advice


def test_a_frame_with_a_code_0_on_every_line_is_impossible():
    random = np.random.default_rng(1)
    assert _union(np.array([[0.5, 0.0], [0.0, 0.5]]), random, shared=True) == 0
    assert _union(np.full((2000, 1), 0.25), random, shared=True) > 0  # although doubles underflow
    # two boxes side by side in one dimension, 0.5 and 0.25 wide: the larger one holds the other
    assert _union(np.array([[0.5, 0.25]]), random, shared=True) == pytest.approx(0.5, abs=0.1)
    assert _union(np.array([[0.5, 0.25]]), random, shared=False) == pytest.approx(1 - 0.5 * 0.75)
