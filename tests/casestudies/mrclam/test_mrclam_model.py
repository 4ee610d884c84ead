"""The landmarks' model against unquantised fusion, on sightings made here: the data set does not ship."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casestudies.mrclam.model import Landmark, model, read_landmarks
from casestudies.mrclam.player import area_grid
from machines.encode import decode_code
from scripts.benches.mrclam import unquantised_posterior
from tests.casestudies.cells import centre
from toolchain.building.quantise import quantise
from toolchain.deployment.address import to_address
from toolchain.errors import ModelError
from toolchain.models.case_study import load_model
from toolchain.models.model import exact_posterior, fuse

LANDMARKS = (Landmark(6, 5.7, 5.0), Landmark(9, 2.3, 3.4), Landmark(17, 0.0, -2.8), Landmark(20, 2.1, -3.9))
CSV = "landmark,x_m,y_m\n" + "".join(f"{each.number},{each.x},{each.y}\n" for each in LANDMARKS)
GRID = area_grid()


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("data") / "landmarks.csv"
    file.write_text(CSV)
    return file


@pytest.fixture(scope="module")
def robot(path):
    return model(path)


@pytest.fixture(scope="module")
def codes(robot):
    return [decode_code(table, 8) for table in quantise(robot).tables]


def sight(random, x, y, *, outlier=None):
    """Return readings of a robot at (x, y) with noise; one range may be an outlier, some landmarks are
    hidden.
    """
    readings = []
    for place, landmark in enumerate(LANDMARKS):
        if place == random.integers(0, 6):
            readings.append((None, None))
            continue
        range_m = math.dist((x, y), (landmark.x, landmark.y)) + random.normal(0, 0.25)
        bearing = math.atan2(landmark.y - y, landmark.x - x) + random.normal(0, 0.12)
        readings.append((abs(range_m) + (5.0 if place == outlier else 0.0), bearing))
    return readings


def addresses(robot, readings):
    values = [value for each in readings for value in each]
    return [to_address(known.as_variable(), value) for known, value in zip(robot.known, values, strict=True)]


def test_columns_alternate_and_may_all_be_missing(robot):
    names = [f"{what}_{each.number}" for each in LANDMARKS for what in ("range", "bearing")]
    assert [known.name for known in robot.known] == names
    assert {known.on_missing for known in robot.known} == {"missing"}
    assert [(d.label, d.size) for d in robot.searched] == [("y", 32), ("x", 32)]
    nothing = exact_posterior(robot, [None] * len(robot.known))
    assert nothing == pytest.approx(np.full(1024, 1 / 1024))
    for line in (0, 31, 500, 1023):
        x, y = robot.searched[1].value(line % 32), robot.searched[0].value(line // 32)
        assert (x, y) == pytest.approx(centre(GRID, line))


@pytest.mark.parametrize("outlier", [None, 1])
def test_bins_and_codes_are_as_accurate_as_raw_float64(robot, codes, outlier):
    random = np.random.default_rng(7)
    cells = np.array([centre(GRID, line) for line in range(GRID.width * GRID.height)])
    raw, binned, coded = [], [], []
    for _ in range(60):
        truth = random.uniform((-1, -6), (6, 6))
        readings = sight(random, *truth, outlier=outlier)
        places = addresses(robot, readings)
        codes_here = [table[place] for table, place in zip(codes, places, strict=True) if place is not None]
        posteriors = (
            unquantised_posterior(LANDMARKS, readings),
            exact_posterior(robot, places),
            fuse(np.ones(GRID.width * GRID.height), codes_here),
        )
        for errors, posterior in zip((raw, binned, coded), posteriors, strict=True):
            errors.append(math.dist(posterior @ cells, truth))
    assert np.median(raw) < 0.4  # a cell is 0.28 m x 0.44 m
    assert np.median(binned) < 1.1 * np.median(raw)
    assert np.median(coded) < 1.15 * np.median(raw)


@settings(max_examples=25)
@given(
    st.floats(-1.5, 6.5),
    st.floats(-6.5, 6.5),
    st.floats(0, 12) | st.none(),
    st.floats(-10, 10) | st.none(),
    st.sampled_from([0.0, 0.05]),
)
def test_unquantised_fusion_is_density_and_floor_at_the_centres(x, y, range_m, bearing_rad, floor):
    landmark = Landmark(1, x, y)
    found = unquantised_posterior([landmark], [(range_m, bearing_rad)], width=5, height=4, floor=floor)
    expected = []
    for line in range(20):
        cx, cy = centre(area_grid(5, 4), line)
        product = 1.0
        if range_m is not None:
            product *= math.exp(-0.5 * ((range_m - math.dist((cx, cy), (x, y))) / 0.25) ** 2) + floor
        if bearing_rad is not None:
            off = math.remainder(bearing_rad - math.atan2(y - cy, x - cx), math.tau)
            product *= math.exp(-0.5 * (off / 0.12) ** 2) + floor
        expected.append(product)
    if sum(expected) > 1e-200:
        assert found == pytest.approx(np.array(expected) / sum(expected), rel=1e-6, abs=1e-12)


def test_the_command_lines_settings_reach_it(path):
    from casestudies import mrclam

    folder = mrclam.__path__[0]
    few = load_model(folder, {"landmarks": str(path), "width": "4", "height": "3", "bearing_values": "20"})
    assert (few.lines, few.known[1].values) == (12, 20)
    with pytest.raises(ModelError, match="landmarks"):
        load_model(folder, {})


@pytest.mark.parametrize(
    "wrong", [{"width": 0}, {"bearing_values": 0}, {"range_values": 0}, {"range_step": 0.0}, {"floor": -1.0}]
)
def test_sizes_that_do_not_fit(path, wrong):
    with pytest.raises(ModelError):
        model(path, **wrong)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("number,x_m,y_m\n1,2,3\n", "no column 'landmark'"),
        ("landmark,x_m,y_m\n1,2,3\n1,4,5\n", "row 2: landmark 1"),
        ("landmark,x_m,y_m\n1,2,north\n", "row 1"),
        ("landmark,x_m,y_m\n1,2,nan\n", "row 1"),
        ("landmark,x_m,y_m\n-1,2,3\n", "row 1"),
    ],
)
def test_landmarks_are_read_in_the_files_order_or_refused(path, tmp_path, text, place):
    assert read_landmarks(path) == LANDMARKS
    file = tmp_path / "landmarks.csv"
    file.write_text(text)
    with pytest.raises(ModelError, match=place):
        read_landmarks(file)
