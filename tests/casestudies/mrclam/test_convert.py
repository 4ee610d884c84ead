"""Conversion of a tiny data set in the format of the public one."""

import math
import os

import pytest

from casestudies.mrclam.convert import app, read_barcodes
from casestudies.mrclam.model import read_landmarks
from casestudies.mrclam.player import read_recording
from tests.command_runner import invoke
from toolchain.errors import ModelError

T0 = 1248272272.0
POSTS = {6: (5.0, 4.0), 7: (-1.0, 2.0), 8: (3.0, -4.0), 20: (-2.0, -2.0)}
BARCODE = {subject: 90 - 3 * subject for subject in range(1, 21)}
STANDS = (1.0, 2.0, 3.0)
"""x, y, heading: post 7 lies at a bearing of pi, where turns end."""


def sighting(second, post, *, at=STANDS, wild=0.0):
    """A line of the measurements: what a perfect camera sees."""
    x, y = POSTS[post]
    bearing = math.atan2(y - at[1], x - at[0]) - at[2]
    bearing = (bearing + math.pi) % (2 * math.pi) - math.pi
    away = math.hypot(x - at[0], y - at[1]) + wild
    return f"{T0 + second:.3f}   {BARCODE[post]}   {away:.4f}   {bearing:.4f}"


@pytest.fixture
def data(tmp_path):
    """Robot 3 stands for two seconds, drives off in the third, and is lost by motion capture after the fourth."""
    folder = tmp_path / "MRCLAM_Dataset1"
    folder.mkdir()
    lines = ["# Subject #    Barcode #"] + [f"{subject:5d}   {code:5d}" for subject, code in BARCODE.items()]
    (folder / "Barcodes.dat").write_text("\n".join(lines) + "\n")
    lines = ["# Subject #   x [m]   y [m]   x std-dev [m]   y std-dev [m]"]
    lines += [f"{post}   {x:.8f}   {y:.8f}   0.00010101   0.00010503" for post, (x, y) in POSTS.items()]
    (folder / "Landmark_Groundtruth.dat").write_text("\n".join(lines) + "\n")
    lines = ["# Time [s]    x [m]    y [m]    orientation [rad]"]
    for step in range(401):
        x = STANDS[0] + (0.3 * (step - 200) / 100 if 200 < step <= 300 else 0.3 if step > 300 else 0)
        lines.append(f"{T0 + step / 100:.3f}  {x:.8f}  {STANDS[1]:.8f}  {STANDS[2]:.8f}")
    (folder / "Robot3_Groundtruth.dat").write_text("\n".join(lines) + "\n")
    lines = ["# Time [s]    Subject #    range [m]    bearing [rad]"]
    lines += [sighting(0, 6), sighting(0.1, 7), sighting(0.2, 8), sighting(0.3, 8), sighting(0.4, 8, wild=5)]
    lines.append(f"{T0 + 0.5:.3f}   {BARCODE[2]}   1.0   0.0")  # another robot
    lines.append(f"{T0 + 0.6:.3f}   4711   1.0   0.0")  # misread
    lines += [sighting(1.1, 6), sighting(1.2, 7)]
    lines += [sighting(2 + post / 100, post) for post in POSTS]
    lines += [sighting(3 + post / 100, post, at=(1.3, 2.0, 3.0)) for post in (6, 7, 20)]
    lines += [sighting(4 + post / 100, post) for post in POSTS]
    (folder / "Robot3_Measurement.dat").write_text("\n".join(lines) + "\n")
    return folder


def run(*arguments):
    ended = invoke(app, arguments)
    return ended.exit_code, ended.stdout, ended.stderr


def test_seconds_without_motion(data, tmp_path):
    out = tmp_path / "out" / "data"
    code, said, err = run(data, "-o", out)
    assert (code, err) == (0, "")
    assert said == (
        f"wrote {out}/landmarks.csv: 4 landmarks\n"
        f"wrote {out}/ds1_robot3.csv: 2 seconds; left out: 1 moving, 1 with fewer than 3 landmarks, "
        "1 without a reference; misread barcodes: 1\n"
    )
    assert {each.number: (each.x, each.y) for each in read_landmarks(out / "landmarks.csv")} == POSTS
    first, later = read_recording(out / "ds1_robot3.csv")
    times = [line.split(",")[0] for line in (out / "ds1_robot3.csv").read_text().splitlines()[1:]]
    assert [float(each) for each in times] == [T0 + 0.5, T0 + 3.5]
    assert (first.x, first.y, later.x) == (1.0, 2.0, 1.3)
    for frame, posts in ((first, (6, 7, 8)), (later, (6, 7, 20))):
        assert list(frame.readings) == [f"{what}_{post}" for post in posts for what in ("range", "bearing")]
        for post in posts:
            x, y = POSTS[post]
            away, bearing = frame.readings[f"range_{post}"], frame.readings[f"bearing_{post}"]
            assert away == pytest.approx(math.hypot(x - frame.x, y - frame.y), abs=1e-3)
            off = bearing - math.atan2(y - frame.y, x - frame.x)
            assert (off + math.pi) % (2 * math.pi) - math.pi == pytest.approx(0, abs=1e-3)
            assert abs(bearing) <= math.pi + 1e-3


def test_bearings_on_both_sides_of_where_a_turn_ends(data, tmp_path):
    path = data / "Robot3_Measurement.dat"
    east = [
        f"{T0 + 0.7 + at / 100:.3f} {BARCODE[20]} 5.0 {math.pi - 3.0 + off:.4f}"
        for at, off in enumerate((0.1, -0.2, 0.05))
    ]
    path.write_text(path.read_text() + "\n".join(east) + "\n")
    assert run(data, "-o", tmp_path, "--robot", "3")[0] == 0
    bearing = read_recording(tmp_path / "ds1_robot3.csv")[0].readings["bearing_20"]
    assert bearing % (2 * math.pi) == pytest.approx(math.pi + 0.05, abs=1e-3)


@pytest.mark.parametrize(
    ("file", "old", "new", "place"),
    [
        ("Barcodes.dat", "# Subject", "Subject", "Barcodes.dat, line 1"),
        ("Barcodes.dat", "    1 ", "   21 ", "line 2"),
        ("Landmark_Groundtruth.dat", "6   5", "5   5", "line 2"),
        ("Robot3_Groundtruth.dat", "3.00000000\n", "nan\n", "line 2"),
        ("Robot3_Groundtruth.dat", f"{T0:.3f}", f"{T0 + 9:.3f}", "Robot3_Groundtruth.dat"),
        ("Robot3_Measurement.dat", None, None, "Robot3_Measurement.dat"),
        ("Barcodes.dat", None, None, "Barcodes.dat"),
    ],
)
def test_what_is_damaged_is_named(data, tmp_path, file, old, new, place):
    if old is None:
        (data / file).unlink()
    else:
        text = (data / file).read_text()
        assert old in text
        (data / file).write_text(text.replace(old, new, 1))
    code, _out, err = run(data, "-o", tmp_path / "out", "--robot", "3")
    assert code == 2
    assert err.startswith(f"error: {data}")
    assert place in err
    assert err.count("\n") == 1


def test_no_robot_and_no_window(data, tmp_path):
    (data / "Robot3_Measurement.dat").write_text("# nothing was seen\n")
    code, out, err = run(data, "-o", tmp_path)
    assert (code, out.count("\n")) == (0, 1)
    assert err.startswith("warning: robot 3")
    (data / "Robot3_Measurement.dat").unlink()
    assert run(data, "-o", tmp_path)[0] == 2


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "Barcodes.dat")
    with pytest.raises(ModelError, match=r"Barcodes\.dat"):
        read_barcodes(tmp_path)
