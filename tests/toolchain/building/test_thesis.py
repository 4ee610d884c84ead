"""The preset `--thesis`: its options, what check and report say about it, and the cycles of its boat.

The cycles come from a model of the machine apart from the product: five frames on four
boards, whose generators go on from frame to frame.
"""

import shlex
from functools import partial

import numpy as np
import pytest

from machines import make_kernel
from machines.bm1 import Start, StopReason
from pcie_shim.programming_file import read_image
from tests.machines.bm2_of_the_page import lfsr_seed
from tests.toolchain.running import TARGET, assert_refused, done, toolchain
from toolchain.analysis import Sweep
from toolchain.deployment import load_deployment

build = partial(toolchain, "build")
THESIS = {"stop": "own", "rng_reset": "free", "steps_per_clock": 1, "interface": "20x1200"}


def machine_of(folder):
    return load_deployment(folder, images=False).machine.model_dump()


@pytest.fixture(scope="module")
def boat(tmp_path_factory):
    folder = tmp_path_factory.mktemp("thesis") / "boat"
    return folder, done(build("boat", "-o", folder, *TARGET, "--thesis")).stdout


def test_it_is_a_set_of_options_that_check_does_not_mention(boat, tmp_path):
    folder, report = boat
    deployment = load_deployment(folder)
    assert THESIS.items() <= deployment.machine.model_dump().items()
    assert [board.lines for board in deployment.boards] == [256] * 4
    assert "the variance of counts is up to 2.6 times as large" in report
    for checked in ((folder,), ("boat", "--thesis")):
        assert done(toolchain("check", *checked)).stdout == ""
    assert "steps_per_clock = 1" in done(toolchain("check", "boat", "--steps-per-clock", "1")).stdout
    # the same options without the preset are the same deployment
    flags = shlex.split("--stop own --rng-reset free --steps-per-clock 1 --interface 20x1200 --partitions 4")
    done(build("boat", "-o", tmp_path / "flags", *TARGET, *flags))
    assert (tmp_path / "flags/deployment.toml").read_bytes() == (folder / "deployment.toml").read_bytes()


@pytest.mark.parametrize("before", [True, False])
def test_a_flag_beside_it_wins_even_if_it_has_the_usual_value(case, before):
    flags = ["--stop", "slices", "--partitions", "1", "--interface", "3x12"]
    flags = ["--thesis", *flags] if before else [*flags, "--thesis"]
    out = case.parent / "out"
    done(build(case, "-o", out, *TARGET, *flags))
    deployment = load_deployment(out)
    changed = {"stop": "slices", "interface": "3x12"}
    assert (THESIS | changed).items() <= deployment.machine.model_dump().items()
    assert len(deployment.boards) == 1


def test_a_bm2(tmp_path):
    given = ("build", "sprinkler", "--machine", "bm2", "--thesis", *TARGET)
    report = done(toolchain(*given, "-o", tmp_path / "own")).stdout
    assert "this biases all samples" in report
    own = machine_of(tmp_path / "own")
    assert (own["literal"], own["sequencer"], own["rng_reset"]) == (True, "linear", "free")
    assert (own["steps_per_clock"], own["interface"]) == (1, "20x1200")
    assert len(load_deployment(tmp_path / "own").boards) == 4
    checked = done(toolchain("check", "sprinkler", "--machine", "bm2", "--thesis")).stdout
    assert "clipped" in checked
    assert "steps_per_clock" not in checked
    done(toolchain(*given, "-o", tmp_path / "coloured", "--sequencer", "coloured", "--no-literal"))
    assert machine_of(tmp_path / "coloured")["sequencer"] == "coloured"
    # the preset has flags of both machines, but a flag of the other one is refused as always
    assert_refused(toolchain(*given, "-o", tmp_path / "no", "--counter-bits", "9"), "--counter-bits", "BM1")


def test_a_sweep_starts_from_it(case, tmp_path):
    lists = shlex.split(
        "--prob-bits 8 --targets 255 --rngs lfsr32 --scales address --frames 1 --partitions 2"
    )
    found = done(toolchain("explore", case, "--thesis", *lists, "-o", tmp_path / "points.jsonl"))
    row = found.stdout.splitlines()[1].split()
    assert row[1:4] == ["address", "lfsr32", "1"]
    (options,) = Sweep(thesis=True, prob_bits="8", targets="255", rngs="lfsr32", scales="address").options()
    assert options.rng_reset == "free"


# --- the cycles ----------------------------------------------------------------------------------------------

MOST_CYCLES, TARGET_COUNT = 2**17, 255


def numbers(columns, count):
    """The low 8 bits of the states of some columns of bank 0: uint8[columns, count]."""
    found = np.zeros((columns, count), np.uint8)
    for column in range(columns):
        state, row = lfsr_seed("lfsr32", column), bytearray(count)
        for cycle in range(count):
            row[cycle] = state & 0xFF
            state = (state << 1 | (state >> 31 ^ state >> 21 ^ state >> 1 ^ state) & 1) & 0xFFFFFFFF
        found[column] = np.frombuffer(row, np.uint8)
    return found


def cycles_of(codes, random):
    """The cycles until a counter of 256 lines overflows, with their codes, uint16[columns, lines]."""
    codes = codes[:, codes.all(axis=0)]  # a line with a code of 0 never counts
    if not codes.shape[1]:
        return 0
    counts = np.zeros(codes.shape[1], int)
    for begin in range(0, MOST_CYCLES, 1024):
        bits = np.ones((1024, codes.shape[1]), bool)
        for code, row in zip(codes, random[:, begin : begin + 1024], strict=True):
            bits &= (row[:, None] < code) | (code == 255)
        sums = counts + bits.cumsum(axis=0)
        if (over := (sums == TARGET_COUNT).any(axis=1)).any():
            return begin + int(over.argmax()) + 1
        counts = sums[-1]
    return MOST_CYCLES


FRAMES = {  # the addresses of D1, D2, D3, B1, B2 and B3, and the cycles of the boards
    (71, 50, 50, 45, 0, 90): (131072, 257, 267, 131072),
    (100, 94, 77, 35, 9, 56): (131072, 1972, 321, 667),
    (79, 55, 57, 46, 7, 86): (131072, 614, 271, 19661),
    (89, 96, 41, 8, 337, 18): (273, 2858, 131072, 0),
    (94, 49, 92, 72, 54, 103): (0, 0, 5485, 255),
}


def test_the_boat_takes_these_cycles(boat):
    folder, _ = boat
    machines = [read_image(load_deployment(folder).image_path(at)).machine for at in range(4)]
    kernels = [make_kernel(each) for each in machines]
    random, at = numbers(7, len(FRAMES) * MOST_CYCLES), [0] * 4
    for frame, (addresses, pinned) in enumerate(FRAMES.items()):
        found = []
        for board, machine in enumerate(machines):
            codes = np.stack(
                [machine.prior[0], *(t[a] for t, a in zip(machine.tables, addresses, strict=True))]
            )
            took = cycles_of(codes, random[:, at[board] :])
            at[board] += took
            found.append(took)
        start = Start(addresses=addresses, target_count=TARGET_COUNT, max_cycles=MOST_CYCLES, bank=frame)
        reasons = [kernel.start(start) for kernel in kernels]
        assert [kernel.cycles for kernel in kernels] == found
        assert tuple(found) == pinned
        limits = {0: StopReason.IMPOSSIBLE, MOST_CYCLES: StopReason.MAX_CYCLES}
        assert reasons == [limits.get(each, StopReason.OVERFLOW) for each in found]
