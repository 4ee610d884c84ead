"""Sweeps: every point is saved before the next begins, a sweep resumes where it stopped, and the front is right."""

import itertools
import signal
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terminal.pictures import new_figure
from tests.toolchain.builders import corridor, posts
from tests.toolchain.running import assert_refused, done, toolchain
from toolchain.analysis import Sweep
from toolchain.analysis.logic import DEVICES
from toolchain.analysis.readings import sample_readings
from toolchain.analysis.sweep import (
    Point,
    Results,
    SweepJob,
    _name_points,
    draw_sweep,
    pareto,
    run_sweep,
    run_task,
    table,
    tasks,
)
from toolchain.cluster import in_this_process
from toolchain.deployment import Stop
from toolchain.errors import BuildError

D8 = DEVICES["proce-v-d8"]


def sweep(**others):
    settings = {
        "prob_bits": "4,8",
        "targets": "15,63",
        "rngs": "lfsr16",
        "scales": "address",
        "stop": Stop.OWN,
        "max_cycles": 4096,
        "banks": 1,
    }
    return Sweep(**(settings | others))


def point(key, variation=0.1, cycles=100.0, alms=1000.0, without=0.0, **others):
    fields = dict.fromkeys(Point.model_fields, 1) | {
        "key": f"{key:064x}",
        "scale": "address",
        "rng": "lfsr32",
        "total_variation": variation,
        "without": without,
        "cycles_median": cycles,
        "alms": alms,
        "fits": True,
    }
    return Point(**(fields | others))


def run(case, *arguments):
    limits = ("--frames", 5, "--max-cycles", 2000)
    return toolchain("explore", case, "-o", case.parent / "r.jsonl", *limits, *arguments)


def test_keys_name_what_the_figures_depend_on():
    model, columns = corridor(), {"scales": "column"}

    def keys(of=model, seed=1, **others):
        return [task.key for task in tasks(of, sweep(**others), sample_readings(of, 5, seed=seed), D8)]

    first = keys()
    assert first == keys()
    changes = [{"seed": 2}, {"max_cycles": 4097}, {"partitions": 2}, {"banks": 2}, columns]
    others = [keys(corridor(sigma=1.1)), *(keys(**each) for each in changes)]
    assert len({key for each in (first, *others) for key in each}) == 4 * 7
    assert set(first) < set(keys(prob_bits="4,8,12"))


def test_a_machine_that_two_combinations_make_is_one():
    frames = sample_readings(corridor(), 3, seed=1)
    each = tasks(corridor(), sweep(steps="0,8", prob_bits="8", targets="15"), frames, D8)
    assert len(each) == 1
    swept = sweep(steps="0,1", prob_bits="8", targets="15", rngs="table,ideal,lfsr16")
    assert len(tasks(corridor(), swept, frames, D8)) == 4


def test_a_sweep_goes_on_where_it_stopped(tmp_path):
    model, measured = corridor(), []
    readings = sample_readings(model, 5, seed=1)
    found = tasks(model, sweep(), readings, D8)

    job = SweepJob(found, readings, D8, 1)

    def two(job, numbers, keep):
        in_this_process(job, numbers[:2], keep)
        raise KeyboardInterrupt

    def reversed_rest(job, numbers, keep):
        measured.extend(numbers)
        in_this_process(job, numbers[::-1], keep)

    with pytest.raises(KeyboardInterrupt):
        run_sweep(job, two, Results(tmp_path / "r.jsonl"), lambda _: None)
    again = Results(tmp_path / "r.jsonl")
    assert list(again.points) == [task.key for task in found[:2]]
    run_sweep(job, reversed_rest, again, lambda _: None)
    assert measured == [2, 3]
    # the file has the order of the sweep, whatever the order of the work
    assert list(Results(tmp_path / "r.jsonl").points) == [task.key for task in found]


def test_results_are_below_build_unless_a_flag_names_a_file(case, monkeypatch):
    monkeypatch.chdir(case.parent)
    done(
        toolchain("explore", case, "--frames", "2", "--prob-bits", "4", "--targets", "15", "--rngs", "lfsr16")
    )
    assert not (case.parent / "explore.jsonl").exists()
    assert Results(case.parent / "build" / "explore.jsonl").points


def test_a_file_where_the_results_folder_should_be_is_one_sentence(case, monkeypatch):
    monkeypatch.chdir(case.parent)
    Path("build").touch()
    result = toolchain("explore", case, "--frames", "2", "--prob-bits", "4", "--targets", "15")
    assert result.exit_code == 2
    assert "build/explore.jsonl cannot be written: File exists; name another file with -o" in result.output


def test_every_point_of_the_picture_says_which_machine_it_is(tmp_path):
    points = [point(1), point(2).model_copy(update={"prob_bits": 6, "target_count": 63})]
    draw_sweep(tmp_path / "p.svg", "m", points, points[:1])
    picture = (tmp_path / "p.svg").read_text()
    assert f"<!-- {points[0].prob_bits}, {points[0].target_count} -->" in picture
    assert "<!-- 6, 63 -->" in picture


def test_a_torn_last_line_is_measured_again_and_another_file_is_left_alone(tmp_path):
    path = tmp_path / "r.jsonl"
    Results(path).append(point(1))
    with path.open("a") as file:
        file.write('{"key":"00')
    results, other = Results(path), Results(path)  # of two sweeps at the same time
    assert list(results.points) == [point(1).key]
    results.append(point(2))
    other.append(point(3))
    assert list(Results(path).points) == [point(1).key, point(2).key, point(3).key]
    for notes in ("my notes\n", "my notes"):
        path.write_text(notes)
        with pytest.raises(BuildError) as caught:
            Results(path)
        assert path.read_text() == notes
    assert caught.value.exit_code == 2
    with pytest.raises(BuildError):
        Results(tmp_path / "there" / "r.jsonl").append(point(1))


@given(st.lists(st.tuples(*[st.integers(0, 3)] * 3), min_size=1, max_size=12))
def test_what_is_not_on_the_front_is_beaten_by_what_is(figures):
    points = [point(key, variation=a, cycles=b, alms=c) for key, (a, b, c) in enumerate(figures)]
    front = {each.key for each in pareto(points)}
    best = [own for own, each in zip(figures, points, strict=True) if each.key in front]
    for own, each in zip(figures, points, strict=True):
        beaten = any(other != own and all(a <= b for a, b in zip(other, own, strict=True)) for other in best)
        assert beaten == (each.key not in front)


def test_a_machine_that_loses_most_frames_gets_no_star():
    usual, some, most = (
        point(1),
        point(2, 0.5, cycles=50.0, without=0.5),
        point(3, 0.99, 1.0, 1.0, without=0.98),
    )
    assert pareto([usual, some, most]) == [usual, some]


def test_lost_frames_count_in_a_sweep():
    model = posts(20)
    readings = sample_readings(model, 20, seed=1)
    (task,) = tasks(model, sweep(prob_bits="8", targets="15", rngs="lfsr32"), readings, D8)
    found = run_task(task, readings, D8, 1)
    assert found.without > 0.5
    assert found.total_variation >= found.without
    assert found.alone_total_variation < 0.4
    assert found.map_agreement <= 1 - found.without
    assert "\n* address" not in table([found], pareto([found]))


def test_the_command(case):
    lists = ["--prob-bits", "4,8", "--targets", "15", "--rngs", "lfsr8,lfsr16", "--scales", "address"]
    lists += ["--plot", case.parent / "sweep.png"]
    result = done(run(case, *lists))
    # An LFSR of 8 bits is too narrow for codes of 8: three machines are left.
    assert result.stderr.startswith("3 machines of corridor over 5 frames drawn from the model (seed 1)\n")
    assert "3 of 3 machines are in" in result.stderr
    assert (case.parent / "sweep.png").read_bytes().startswith(b"\x89PNG")
    rows = result.stdout.splitlines()
    assert len(rows) == 6
    assert any(row.startswith("* address") for row in rows)
    # the resources of a stored point are estimated again: the estimator may have been calibrated since
    path = case.parent / "r.jsonl"
    kept = Results(path).points.values()
    path.unlink()
    for each in kept:
        Results(path).append(each.model_copy(update={"alms": 1.0, "blocks": 7, "fits": False}))
    again = run(case, *lists)
    assert "; 3 of them are in" in again.stderr
    assert again.stdout == result.stdout


def test_a_recording_is_explored(case):
    recording = case.parent / "r.csv"
    recording.write_text("range,loud\n1.0,0\n2.0,1\n3.0,0\n")
    result = done(run(case, "--readings", str(recording), "--prob-bits", "8", "--targets", "15"))
    assert "over 3 of 3 rows of r.csv" in result.stderr


@pytest.mark.parametrize(
    ("option", "name"), [("-o", "nowhere/r.jsonl"), ("--plot", "nowhere/sweep.png"), ("--plot", "sweep.bmp")]
)
def test_an_unwritable_file_is_refused_before_anything_is_measured(case, option, name):
    result = run(case, "--prob-bits", "4", "--targets", "15", option, case.parent / name)
    assert_refused(result, case.parent / name)
    results = case.parent / "r.jsonl"
    assert not results.exists() or not results.stat().st_size


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--prob-bits", "4;8"], ["--prob-bits 4;8"]),
        (["--rngs", "lfsr31"], ["--rngs lfsr31", "lfsr8, lfsr16"]),
        (["--targets", "0"], ["target count of 0"]),
        (["--prob-bits", "16", "--rngs", "lfsr16"], ["lfsr16"]),
        (["--reading", "a=b"], ["--reading a=b", "--readings FILE"]),
        (["--frames", "0"], ["--frames is 0", "1 to 100000"]),
        (["--partitions", "13"], ["12 lines", "13 boards"]),
        (["--banks", "0"], ["--banks"]),
    ],
)
def test_mistakes(case, arguments, named):
    assert_refused(run(case, *arguments), *named)


def test_ctrl_c_keeps_what_is_done(case, monkeypatch):
    def interrupted(task, *arguments):
        if task.plan.options.target_count == 63:
            signal.raise_signal(signal.SIGINT)
        return run_task(task, *arguments)

    monkeypatch.setattr("toolchain.analysis.sweep.run_task", interrupted)
    ended = run(case, "--prob-bits", "8", "--targets", "15,63", "--rngs", "lfsr16", "--scales", "address")
    assert ended.exit_code == 130, ended.stderr
    assert "1 of 2 machines are in" in ended.stderr
    assert len(Results(case.parent / "r.jsonl").points) == 1
    assert len(ended.stdout.splitlines()) == 4


def test_a_file_of_results_that_does_not_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("toolchain.analysis.sweep.MAX_FILE_BYTES", 1000)
    with pytest.raises(BuildError, match="not a regular file"):
        Results(Path("/dev/zero"))


def test_no_name_of_a_point_covers_another():
    axes = new_figure(7, 5).subplots()
    axes.set(xscale="log", yscale="log")
    places = [(1000, 0.1), (1000, 0.1), (1010, 0.099), (1000, 0.1), (9000, 0.01)]
    axes.scatter(*zip(*places, strict=True))
    _name_points(axes, zip(places, ["8, 63", "8, 63", "6, 63", "4, 63", "8, 255"], strict=True))
    assert [text.get_text() for text in axes.texts] == ["8, 63", "6, 63", "4, 63", "8, 255"]
    points = 72 / axes.figure.dpi
    heights = [axes.transData.transform(text.xy)[1] * points + text.xyann[1] for text in axes.texts]
    assert all(above - below > 9 for above, below in itertools.pairwise(heights))
