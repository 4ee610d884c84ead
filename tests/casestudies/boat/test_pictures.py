"""The pictures are written, and show what they should."""

import numpy as np
import pytest
from matplotlib.image import imread

from casestudies.boat import pictures
from casestudies.topics import Instance, Truth
from posteriors.frame_report import FrameReport, StageTimes
from posteriors.posterior import Posterior
from terminal.errors import OutputError

VIRIDIS_LOW, VIRIDIS_HIGH = (0.267, 0.005, 0.329), (0.993, 0.906, 0.144)
TRUTH_COLOUR = (1.0, 0.302, 0.302)


def instance(number, x=0.0, y=0.0, *, cell=None, truth=True, width=32, height=32, moved=(), **stages):
    values = [0.0] * (width * height)
    if cell is not None:
        values[cell] = 1.0
    else:
        values = [1 / len(values)] * len(values)
    cycles, size, transfers = moved or (None, None, None)
    report = FrameReport(
        stamp_ns=number,
        heard_ns=number,
        outcome="",
        number=number,
        sent_ns=0,
        stages=StageTimes(**stages),
        cycles=cycles,
        link_bytes=size,
        link_transfers=transfers,
    )
    posterior = Posterior(
        probabilities=tuple(values), labels=("y", "x"), sizes=(height, width), heard_ns=500_000, report=report
    )
    return Instance(heard=posterior, truth=Truth(stamp_ns=number, x=x, y=y) if truth else None)


def pixels_of(path, colour):
    picture = imread(path)[..., :3]
    return np.argwhere(np.abs(picture - colour).max(axis=2) < 0.02)


def test_the_probable_cell_and_the_true_position_are_in_one_place(tmp_path):
    """A certain posterior in the cell of the truth: in panel b both marks are at the same pixels."""
    path = tmp_path / "new" / "figure-4.4.png"
    pictures.draw_positions(path, [instance(1, 25, 25, cell=24 * 32 + 24)])
    assert imread(path).shape[:2] > (300, 500)
    low, high = pixels_of(path, VIRIDIS_LOW), pixels_of(path, VIRIDIS_HIGH)
    columns = np.flatnonzero(np.bincount(low[:, 1]) > 150)  # the panel's, but not the colour bar's
    left, right, top = columns[0], columns[-1], low[:, 0].min()

    def in_panel(pixels):
        return pixels[(pixels[:, 1] > left) & (pixels[:, 1] < right) & (pixels[:, 0] < top + right - left)]

    cell, marks = in_panel(high), in_panel(pixels_of(path, TRUTH_COLOUR))
    assert len(cell) > 5
    assert len(marks) > 20
    assert np.abs(marks.mean(axis=0) - cell.mean(axis=0)).max() < 8
    span = right - left
    # x = y = 25 is three quarters of the way to the right and a quarter of the way down
    assert (marks[:, 1].mean() - left) / span == pytest.approx(0.75, abs=0.04)
    assert (marks[:, 0].mean() - top) / span == pytest.approx(0.25, abs=0.04)


def test_any_number_and_any_grid_with_and_without_a_truth(tmp_path):
    instances = [instance(n, n, n, cell=0, width=8, height=6) for n in range(5)]
    pictures.draw_positions(tmp_path / "x.png", instances, route=[i.truth for i in instances])
    assert len(pixels_of(tmp_path / "x.png", VIRIDIS_LOW)) > 5000
    pictures.draw_positions(tmp_path / "x.png", [instance(1, truth=False)])
    assert not len(pixels_of(tmp_path / "x.png", TRUTH_COLOUR))


def test_pictures_that_cannot_be_drawn(tmp_path):
    with pytest.raises(OutputError):
        pictures.posterior_grid(Posterior(probabilities=(0.5, 0.5), labels=("x",), sizes=(2,), heard_ns=0))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        pictures.draw_positions(tmp_path / "file" / "x.png", [instance(1)])


def chosen(instances):
    return [each.report.number for each in pictures.far_apart(instances)]


def test_the_corners_are_chosen_in_the_order_of_time():
    middle = [instance(n, n / 10, 0) for n in range(10)]
    corners = [instance(20, 40, 40), instance(21, -40, 40), instance(22, 40, -40)]
    assert chosen([*middle, *corners]) == [0, 20, 21, 22]
    assert len(set(chosen([instance(n) for n in range(6)]))) == 4


def test_frames_without_a_truth_are_spread_over_time_and_those_without_a_posterior_not_chosen():
    blind = [instance(n, truth=False) for n in range(10)]
    assert chosen([*blind, instance(10)]) == [10]
    assert chosen(blind)[::3] == [0, 9]
    assert pictures.far_apart([Instance(heard=FrameReport(stamp_ns=1, heard_ns=1, outcome=""))]) == ()


STAGES = {"rosbridge_in": 100, "local_hops": 200, "register_writes": 50, "reads": 50}
STAGES |= {"compute": 700, "boards_compute": 600}


def test_means_and_shares():
    double = {name: 2 * time for name, time in STAGES.items()}
    shares = pictures.stage_shares([instance(1, **STAGES), instance(2, **double)])
    assert [stage.name for stage in shares] == [
        *("rosbridge in", "local hops", "register writes", "computing", "start and answer"),
        *("register reads", "rosbridge out"),
    ]
    assert [stage.mean_us for stage in shares] == [150, 300, 75, 900, 150, 75, 500]
    assert sum(stage.share for stage in shares) == pytest.approx(1)
    assert shares[3].part is pictures.StageKind.COMPUTING
    assert shares[3].share == pytest.approx(900 / 2150)
    some = pictures.stage_shares([instance(1, compute=500), instance(2)])  # the others were not told
    assert [stage.mean_us for stage in some] == [500, 0, 500]
    assert pictures.stage_shares([]) == ()


def test_the_projected_boards_compute_at_their_clock_and_move_what_has_moved():
    instances = [instance(1, moved=(2000, 5200, 8), **STAGES), instance(2, moved=(4000, 5200, 8), **STAGES)]
    shares = pictures.projected_shares(instances, 50e6)
    assert [(stage.part, stage.mean_us) for stage in shares] == [
        (pictures.StageKind.ROSBRIDGE, 100),
        (pictures.StageKind.HOST, 200),
        (pictures.StageKind.REGISTERS, pytest.approx(2 + 8 * 0.5)),
        (pictures.StageKind.COMPUTING, pytest.approx(60)),
        (pictures.StageKind.ROSBRIDGE, 500),
    ]
    assert pictures.mean_link_us(instances, "jtag") == pytest.approx(5200 * 8 / 24 + 8 * 125)
    assert pictures.projected_shares([instance(1, **STAGES)], 50e6) == ()


def test_the_bars_are_as_long_as_the_times(tmp_path):
    path = tmp_path / "figure-4.5.png"
    pictures.draw_shares(path, pictures.stage_shares([instance(1, **STAGES)]), frames=1)
    height = imread(path).shape[0]

    def bar(colour):
        found = pixels_of(path, colour)
        found = found[found[:, 0] < 0.75 * height]  # above the legend
        return np.bincount(found[:, 0]).max()  # pixels in the fullest row

    host, computing = bar((0.733, 0.733, 0.733)), bar((0.933, 0.4, 0.467))
    assert computing / host == pytest.approx(3, rel=0.05)
