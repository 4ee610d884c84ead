"""The recording's CSV file, and each frame as a message."""

import pytest

from casestudies import DataFileError
from casestudies.mrclam.model import X_LIMITS, Y_LIMITS
from casestudies.mrclam.player import RecordedFrame, Sighting, area_grid, read_recording, sightings_message

HEADING = "time_s,ref_x_m,ref_y_m,ref_std_m,heading_rad,range_6_m,bearing_6_rad,range_20_m,bearing_20_rad"
FIRST = "1248272277.018,4.392,2.407,0.041,-2.0698,,,6.712,-1.8623"
SECOND = "1248272278.018,-1.5,-6.25,0.035,-2.0624,6.794,-2.2450,,"


def file(tmp_path, *lines):
    path = tmp_path / "recording.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_frames_are_read_with_what_was_seen(tmp_path):
    frames = read_recording(file(tmp_path, HEADING, FIRST, SECOND))
    assert frames == (
        RecordedFrame(
            number=1,
            time_s=1248272277.018,
            x=4.392,
            y=2.407,
            sightings=(Sighting(landmark=20, range_m=6.712, bearing_rad=-1.8623),),
        ),
        RecordedFrame(
            number=2,
            time_s=1248272278.018,
            x=-1.5,
            y=-6.25,
            sightings=(Sighting(landmark=6, range_m=6.794, bearing_rad=-2.2450),),
        ),
    )


def test_what_was_not_seen_is_absent_from_the_message(tmp_path):
    first, second = read_recording(file(tmp_path, HEADING, FIRST, SECOND))
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"}
    assert sightings_message(first, header) == {"header": header, "range_20": 6.712, "bearing_20": -1.8623}
    assert set(sightings_message(second, header)) == {"header", "range_6", "bearing_6"}


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        (["landmark,x_m,y_m", "6,5.7093,4.9640"], "time_s"),
        (["time_s,ref_x_m,ref_y_m,ref_std_m,heading_rad", "1,2,3,4,5"], "range_N_m"),
        ([HEADING.replace(",bearing_20_rad", ""), FIRST], "bearing_20_rad"),
        ([HEADING.replace("_6_", "_3_"), FIRST], "landmark 3"),
        ([HEADING], "recording.csv"),
        ([""], "time_s"),
        ([HEADING, FIRST, SECOND.replace("6.794", "far")], "line 3: range_6_m"),
        ([HEADING, FIRST.replace("4.392", "nan")], "line 2: ref_x_m"),
        ([HEADING, FIRST, SECOND[:-3]], "line 3"),
        ([HEADING, FIRST.replace("6.712", "")], "line 2: landmark 20"),
    ],
)
def test_wrong_files_are_refused_with_the_place(tmp_path, lines, place):
    with pytest.raises(DataFileError, match=place):
        read_recording(file(tmp_path, *lines))


def test_paths_that_are_not_files(tmp_path):
    with pytest.raises(DataFileError, match="no-such.csv"):
        read_recording(tmp_path / "no-such.csv")
    with pytest.raises(DataFileError):
        read_recording(tmp_path)
    binary = tmp_path / "picture.csv"
    binary.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(DataFileError, match="picture.csv"):
        read_recording(binary)


def test_the_area_is_the_models():
    grid = area_grid()
    assert ((grid.x_low, grid.x_high), (grid.y_low, grid.y_high)) == (X_LIMITS, Y_LIMITS)
    assert grid.centre(0) == pytest.approx((-2 + 9 / 64, -7 + 14 / 64))
    assert grid.cells == 1024
