"""Learning: parameters are recovered from a recording, counts are Dirichlet's, and a fit survives its file.

model ──▶ simulated readings with ground truth ──▶ fit ──▶ file ──▶ the model that made them
"""

import json
import math
import re
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.toolchain.builders import interval, normal, wrapped_normal
from tests.toolchain.running import done, toolchain
from toolchain.deployment.filter import Transition
from toolchain.errors import ModelError
from toolchain.learning import FitMethod, FitOptions, FitPrior
from toolchain.learning.fit import LEAST_READINGS, fit_model, locate, mixture
from toolchain.learning.fitted import Fit, apply_fit, cell_spread, mean_slopes, read_fit, with_fit, write_fit
from toolchain.models.case_study import load_model
from toolchain.models.model import Known, Model, cell_centres, dimension

TURN = 2 * np.pi

CASE = """
import numpy as np
from pathlib import Path
from toolchain.learning.fitted import with_fit
from toolchain.models import *

def model(fit: Path | None = None):
    place = Symbol("x", IntervalType(0.0, 10.0, 100))
    wall, back = (Symbol(name, IntegerType(0, 100, scale=0.1), on_range="clamp", on_missing="missing")
                  for name in ("wall", "back"))
    door = Symbol("door", LabelType("shut", "open"), on_missing="missing")
    near = np.where(place.values() < 5, 0.8, 0.2)
    joint = JointDistribution("corridor", (
        uniform(place),
        conditional_normal(wall, [place], mean=lambda x: 10.0 - x, sigma=1.0),
        conditional_normal(back, [place], mean=lambda x: x, sigma=1.0),
        table(door, [1 - near, near], given=[place]),
    ))
    return with_fit(joint.ask(searched=[place], known=[wall, back, door]).model(), fit)
"""


def room(cells=16):
    y, x = interval("y", 0, 8, cells=cells), interval("x", 0, 8, cells=cells)
    ys, xs = cell_centres(y, x)
    distance, angle = np.hypot(xs + 2, ys + 1), np.arctan2(ys + 1, xs - 3)
    known = (
        normal("range", mean=distance, sigma=1.0, values=150, step=0.1),
        wrapped_normal("bearing", mean=angle, sigma=0.5, values=180, step=TURN / 180, offset=-np.pi),
    )
    return Model(name="room", searched=(y, x), known=known)


def simulated(rows, *, sigma=0.2, bias=0.0, outliers=0.2, seed=1):
    """Truth and readings of the room, as columns."""
    random = np.random.default_rng(seed)
    y, x = random.uniform(0, 8, (2, rows))
    distance = np.hypot(x + 2, y + 1) + bias + random.normal(0, sigma, rows)
    turns = TURN * random.integers(-1, 2, rows)
    bearing = np.arctan2(y + 1, x - 3) + random.normal(0, sigma / 4, rows) + turns
    wild = random.random(rows) < outliers
    distance[wild] = random.uniform(0, 15, wild.sum())
    bearing[wild] = random.uniform(-np.pi, np.pi, wild.sum())
    return {"y": y.tolist(), "x": x.tolist()}, {"range": distance.tolist(), "bearing": bearing.tolist()}


def learn(model, truth, readings, **options):
    rows = len(next(iter(truth.values())))
    located = locate(model, truth, rows)
    return fit_model(model, located, readings, [], FitOptions(truth=[], **options))


def test_normals_are_found_again():
    truth, readings = simulated(3000, sigma=0.2, bias=0.3, outliers=0.2)
    fit, supports = learn(room(), truth, readings, bias=True)
    distance, bearing = fit.file.variables
    # in a cell the mean is taken as linear, which adds a little to sigma
    assert distance.sigma == pytest.approx(0.2, rel=0.1)
    assert distance.bias == pytest.approx(0.3, abs=0.02)
    assert distance.outliers == pytest.approx(0.2, abs=0.03)
    assert bearing.sigma == pytest.approx(0.05, rel=0.15)
    assert bearing.bias == pytest.approx(0, abs=0.01)
    assert [support.readings for support in supports] == [3000, 3000]
    assert supports[0].cells == 256
    unbiased, _ = learn(room(), truth, readings)
    assert [variable.bias for variable in unbiased.file.variables] == [0, 0]


@given(st.floats(0.01, 2), st.floats(0.0, 0.6), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_the_mixture_finds_sigma_and_share(sigma, share, seed):
    random = np.random.default_rng(seed)
    residuals = random.normal(0, sigma, 3000)
    wild = random.random(3000) < share
    residuals[wild] = random.uniform(-15, 15, wild.sum())
    _, found, (outliers,) = mixture([residuals], [30.0], bias=False, least_sigma=1e-3)
    assert found == pytest.approx(sigma, rel=0.15)
    assert outliers == pytest.approx(share, abs=0.06)


def test_a_pool_shares_sigma_and_each_keeps_its_share_and_exact_readings_have_a_sigma():
    random = np.random.default_rng(2)
    few, many = random.normal(0, 0.1, 20), random.normal(0, 0.1, 2000)
    broken = random.uniform(-5, 5, 200)
    _, sigma, shares = mixture([few, many, broken], [10.0] * 3, bias=False, least_sigma=1e-3)
    assert sigma == pytest.approx(0.1, rel=0.1)
    few_wild, many_wild, broken_wild = shares
    assert few_wild < 0.15
    assert many_wild < 0.02
    assert broken_wild > 0.9
    share = pytest.approx(1 / 52, abs=3e-3)
    assert mixture([np.zeros(50)], [1.0], bias=True, least_sigma=0.005) == (0.0, 0.005, [share])


def test_the_spread_inside_a_cell_is_part_of_the_fitted_table():
    model = room(cells=4)
    ranged = model.known[0]
    ys, xs = cell_centres(*model.searched)
    away = np.hypot(xs + 2, ys + 1)
    slopes = mean_slopes(model, ranged)
    assert slopes[0] == pytest.approx(2 * (ys + 1) / away, abs=0.35)  # cells of 2 m
    assert cell_spread(model, ranged) == pytest.approx(np.full(16, 2 / math.sqrt(12)), rel=0.2)
    truth, readings = simulated(2000)
    fit, _ = learn(model, truth, readings)
    fitted = apply_fit(model, fit)
    assert np.all(fitted.known[0].normal.sigma > 0.9 * 2 / math.sqrt(12))
    bearing = wrapped_normal("b", mean=np.array([3.0, 3.1, -3.1, -3.0]), sigma=1, values=60, step=TURN / 60)
    line = Model(name="m", searched=(interval("x", -1, 1, cells=4),), known=(bearing,))
    over_the_gap = (0.1 + TURN - 6.2) / 2  # the short way round
    assert mean_slopes(line, bearing)[0] == pytest.approx([0.1, over_the_gap, over_the_gap, 0.1])


def test_rows_without_a_truth_are_left_out():
    truth = {"y": [1.0, None, 9.0, math.nan, -0.01, 8.0, "north"], "x": [1.0] * 7}
    located = locate(room(), truth, 7)
    assert (located.rows.tolist(), located.outside, located.lines.tolist()) == ([0], 6, [2 * 16 + 2])
    assert located.within[:, 0] == pytest.approx([-0.5, -0.5])


def door(cells=4):
    table = np.array([[0.9, 0.5, 0.5, 0.2], [0.1, 0.5, 0.5, 0.8]])
    return Model(
        name="door",
        searched=(dimension("x", size=cells, states=("a", "b", "c", "d")),),
        known=(Known(name="door", table=table, states=("shut", "open")),),
    )


@pytest.mark.parametrize("prior", list(FitPrior))
def test_counts_are_dirichlets(prior):
    truth = {"x": ["a", "a", "a", "d", "c", 1]}
    readings = {"door": ["shut", "open", 1, 0, None, "ajar"]}
    fit, (support,) = learn(door(), truth, readings, method=FitMethod.COUNTS, pseudo_count=2.0, prior=prior)
    base = door().known[0].table if prior is FitPrior.MODEL else np.full((2, 4), 0.5)
    counts = np.array([[1, 0, 0, 1], [2, 0, 0, 0]])
    assert fit.tables["door"] == pytest.approx((counts + 2 * base) / (counts.sum(axis=0) + 2))
    assert (support.readings, support.cells, support.median, support.refused) == (4, 2, 2.0, 1)
    fitted = apply_fit(door(), fit).known[0]
    assert np.array_equal(fitted.table, fit.tables["door"])
    assert fitted.states == ("shut", "open")


def test_a_fit_is_the_same_after_its_file(tmp_path):
    truth, readings = simulated(300)
    fit, _ = learn(room(), truth, readings)
    write_fit(tmp_path / "fit.toml", fit)
    assert read_fit(tmp_path / "fit.toml").file == fit.file
    fitted = with_fit(room(), tmp_path / "fit.toml")
    for ours, theirs in zip(fitted.known, apply_fit(room(), fit).known, strict=True):
        assert np.array_equal(ours.table, theirs.table)
    assert with_fit(room(cells=40), tmp_path / "fit.toml").lines == 1600
    few, _ = learn(room(), *simulated(LEAST_READINGS - 1))
    assert few.file.variables == ()
    enough, _ = learn(room(), *simulated(LEAST_READINGS))
    assert [each.rows for each in enough.file.variables] == [LEAST_READINGS] * 2
    for unfitted in (with_fit(room(), None), apply_fit(room(), few)):  # as it was set by hand
        assert np.array_equal(unfitted.known[0].table, room().known[0].table)


def test_counted_tables_and_their_file_survive_a_round_trip(tmp_path):
    fit, _ = learn(door(), {"x": ["a", "b"]}, {"door": [1, 0]}, method=FitMethod.COUNTS)
    for name in ("a.npz", "b.npz"):
        write_fit(tmp_path / name, fit)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    again = read_fit(tmp_path / "a.npz")
    assert again.file == fit.file
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        content = json.loads(archive.read("fit.json"))
    # as documented in docs/how-to/models.md
    assert sorted(content) == ["floor", "format", "method", "model", "recording", "variable"]
    assert content["variable"] == [{"name": "door", "rows": 2}]
    assert np.array_equal(again.tables["door"], fit.tables["door"])
    with pytest.raises(ModelError, match="writes a file that ends in .npz"):
        write_fit(tmp_path / "a.toml", fit)


def test_a_learnt_prior_is_dirichlets(tmp_path):
    truth, readings = {"x": ["a", "b", "b", "b"]}, {"door": [1, 0, 0, None]}
    options = {
        "method": FitMethod.COUNTS,
        "pseudo_count": 0.5,
        "prior": FitPrior.UNIFORM,
        "learn_prior": True,
    }
    fit, _ = learn(door(), truth, readings, **options)
    cells = door().lines
    expected = (np.array([1, 3, *[0] * (cells - 2)]) + 0.5) / (4 + 0.5 * cells)
    assert fit.prior == pytest.approx(expected)
    write_fit(tmp_path / "fit.npz", fit)
    model = with_fit(door(), tmp_path / "fit.npz")
    assert model.prior_distribution == pytest.approx(expected)
    assert read_fit(tmp_path / "fit.npz").file.prior_rows == 4
    unlearnt, _ = learn(door(), truth, readings, **options | {"learn_prior": False})
    assert apply_fit(door(), unlearnt).prior_distribution == pytest.approx(door().prior_distribution)
    other = Model(name="other", searched=(dimension("x", size=cells + 1),), known=())
    with pytest.raises(ModelError, match="prior"):
        apply_fit(other, Fit(file=fit.file.replace(variables=()), tables={}, prior=fit.prior))
    moving = replace(door(), prior=None, transition=Transition(np.full(cells, 1 / cells), np.eye(cells)))
    with pytest.raises(ModelError, match="--learn-prior: the prior of .* is predicted by its filter"):
        learn(moving, truth, readings, **options)
    assert apply_fit(moving, unlearnt).transition is moving.transition


def archive(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def array_bytes(header, data=b""):
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


META = json.dumps(
    {"format": 1, "method": "counts", "model": "m", "floor": 0.0, "recording": []}
    | {"variable": [{"name": "k", "rows": 1}]}
)
HEADER = "{{'descr': '{}', 'fortran_order': False, 'shape': {}, }}"


@pytest.mark.parametrize(
    "members",
    [
        {},
        {"fit.json": "{"},
        {"fit.json": "[" * 100_000},
        {"fit.json": "[]"},
        {"fit.json": META},
        {"fit.json": META, "table0.npy": b"nothing"},
        *(
            {"fit.json": META, "table0.npy": array_bytes(HEADER.format(kind, shape), b"x" * 8)}
            for kind, shape in (("<f8", (10**6, 10**6)), ("|O", (1, 1)), ("<f8", (2, 1)))
        ),
        {"fit.json": META.replace('"k"', "7")},
        *(
            {
                "fit.json": json.dumps(json.loads(META) | {"prior_rows": 1, "variable": []}),
                "prior.npy": array_bytes(HEADER.format("<f8", (rows, 1)), b"x" * 8 * rows),
            }
            for rows in (0, 2)
        ),
        {"fit.json": META.replace("counts", "normals")},
    ],
)
def test_a_damaged_or_hostile_file_of_tables_is_refused(tmp_path, members):
    path = archive(tmp_path / "x.npz", members)
    for cut in (0, 9):
        path.write_bytes(path.read_bytes()[cut:])
        with pytest.raises(ModelError, match=re.escape(str(path))):
            read_fit(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("sigma = ", "sgima = "),
        ("format = 1", "format = 1\nprior_rows = 3"),
        ('method = "normals"', 'method = "counts"'),
        ("format = 1", "format = 2"),
        ('name = "range"', 'name = "rnge"'),
        ("outliers = 0.", "outliers = 7."),
        ("sigma = ", "sigma = 0 # "),
    ],
)
def test_a_fit_that_was_edited_wrongly(tmp_path, old, new):
    truth, readings = simulated(300)
    path = tmp_path / "fit.toml"
    write_fit(path, learn(room(), truth, readings)[0])
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(ModelError):
        with_fit(room(), path)


OTHER = Model(
    name="o", searched=(dimension("x", size=3),), known=(Known(name="door", table=np.full((2, 3), 0.5)),)
)


@pytest.mark.parametrize(
    "attempt",
    [
        lambda: learn(door(), {"x": [0]}, {"door": [1]}),
        lambda: learn(door(), {"x": [77]}, {"door": [1]}, method=FitMethod.COUNTS),
        lambda: learn(room(), *simulated(20), pool=("rnge*",)),
        lambda: apply_fit(OTHER, learn(door(), {"x": [0]}, {"door": [1]}, method=FitMethod.COUNTS)[0]),
    ],
)
def test_what_cannot_be_learnt_in_this_way(attempt):
    with pytest.raises(ModelError):
        attempt()


@pytest.fixture
def corridor(tmp_path):
    folder = tmp_path / "corridor"
    folder.mkdir()
    (folder / "model.py").write_text(CASE)
    random = np.random.default_rng(8)
    for name in ("learn.csv", "check.csv"):
        x = random.uniform(0, 10, 400)
        lines = ["true_x,wall_m,back_m,door"]
        for at in x:
            opened = "open" if random.random() < (0.8 if at < 5 else 0.2) else "shut"
            back = f"{at + random.normal(0, 0.1):.3f}" if random.random() < 0.5 else ""
            lines.append(f"{at:.3f},{10 - at + random.normal(0, 0.1):.3f},{back},{opened}")
        (tmp_path / name).write_text("\n".join(lines) + "\n")
    return tmp_path


def fit(folder, *arguments):
    return toolchain("fit", folder / "corridor", folder / "learn.csv", "--truth", "x=true_x", *arguments)


def test_the_command_fits_normals_and_a_model_loads_them(corridor):
    out = corridor / "fit.toml"
    readings = ["--reading", "wall=wall_m", "--reading", "back=back_m"]
    result = done(fit(corridor, "-o", out, "--floor", "0", *readings, "--check", corridor / "check.csv"))
    assert "400 rows with a truth inside the searched dimensions, 0 others" in result.stdout
    assert re.search(r"wall +400 +\d+ +\d% +\d+ +0.1\d* +0 +0.\d%", result.stdout)
    assert re.search(r"back +(19|2)\d\d? ", result.stdout)
    medians = [float(each) for each in re.findall(r"median (\d+\.\d+)", result.stdout)]
    surprises = [float(each) for each in re.findall(r"true cell (\d+\.\d+) bits", result.stdout)]
    assert medians[1] < medians[0]
    assert surprises[1] < surprises[0]
    fitted = load_model(corridor / "corridor", {"fit": str(out)})
    assert fitted.known[0].normal.sigma.max() < 0.25
    assert f"--set fit={out}." in result.stdout


LABELS = """
import numpy as np
from toolchain.models.model import Known, Model, dimension

def model():
    return Model(name="gas", searched=(dimension("gas", size=3, states=("air", "smoke", "methane")),), known=(
        Known(name="sensor", table=np.array([[0.8, 0.3, 0.3], [0.1, 0.6, 0.1], [0.1, 0.1, 0.6]])),))
"""


def fitted_gas(folder, model, learnt, checked, *options):
    """Return the output of `fit` for rows (state, reading), and the words of its last confusion matrix."""
    (folder / "model.py").write_text(model)
    for name, rows in (("learn.csv", learnt), ("check.csv", checked)):
        (folder / name).write_text("gas,sensor\n" + "".join(f"{state},{value}\n" for state, value in rows))
    out = ("-o", folder / "fit.npz", "--method", "counts", "--check", folder / "check.csv", *options)
    said = done(toolchain("fit", folder, folder / "learn.csv", "--truth", "gas=gas", *out)).stdout
    return said, [line.split() for line in said.split("fitted, gas: ", 1)[1].splitlines()[1:5]]


def test_labels_have_a_confusion_matrix_and_no_distances(tmp_path):
    rows = [("air", 0)] * 4 + [("smoke", 1)] * 3 + [("smoke", 0)] + [("methane", 2)] * 2
    said, matrix = fitted_gas(tmp_path, LABELS, rows, rows, "--learn-prior")
    assert "distance" not in said
    assert "accuracy 90.0% (most probable cell, 9 of 10)" in said
    assert matrix == [
        ["air", "smoke", "methane"],
        ["air", "4", "0", "0"],
        ["smoke", "1", "3", "0"],
        ["methane", "0", "0", "2"],
    ]
    assert read_fit(tmp_path / "fit.npz").prior == pytest.approx(np.array([5, 5, 3]) / 13)


def test_rows_that_a_model_regards_as_impossible_count_as_wrong(tmp_path):
    model = LABELS.replace("[0.1, 0.1, 0.6]", "[0.1, 0.1, 0.6], [0, 0, 0]")
    said, matrix = fitted_gas(tmp_path, model, [("air", 0), ("smoke", 1)], [("air", 0)] + [("air", 3)] * 2)
    assert "accuracy 33.3% (most probable cell, 1 of 3)" in said
    assert said.count("rows impossible in this model, which count as wrong: 2") == 2
    assert matrix[:2] == [["air", "smoke", "methane", "none"], ["air", "1", "0", "0", "2"]]


@pytest.mark.parametrize(
    "arguments",
    [
        ["-o", "fit.npz"],
        ["-o", "fit.toml", "--learn-prior"],
        ["-o", "fit.toml", "--method", "counts"],
        ["-o", "fit.toml"],
        ["-o", "fit.toml", "--reading", "wal=wall_m"],
        ["-o", "fit.toml", "--truth", "y=true_x"],
        ["-o", "fit.toml", "--floor", "1"],
        ["-o", "fit.npz", "--method", "counts", "--pseudo-count", "0"],
        ["-o", "fit.toml", "--tolerance", "-1"],
        ["-o", "fit.toml", "--reading", "wall=wall_m", "--check", "LEARN"],
    ],
)
def test_mistakes_of_the_command(corridor, arguments):
    result = fit(corridor, *(each.replace("LEARN", str(corridor / "learn.csv")) for each in arguments))
    assert result.exit_code == 2, result.stdout
    assert "Traceback" not in result.stderr
    assert not list(corridor.glob("fit.*"))


def test_a_star_stands_for_the_same_text(corridor):
    case = corridor / "corridor" / "model.py"
    case.write_text(case.read_text().replace('"wall"', '"wall_range"').replace('"back"', '"back_range"'))
    done(fit(corridor, "-o", str(corridor / "fit.toml"), "--reading", "*_range=*_m", "--pool", "*_range"))
    variables = read_fit(corridor / "fit.toml").file.variables
    assert [variable.name for variable in variables] == ["wall_range", "back_range"]
    assert variables[0].sigma == variables[1].sigma
