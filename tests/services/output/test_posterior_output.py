"""Posteriors as the command `listen` prints, draws and saves them."""

import contextlib
import csv
import errno
import io
import json
import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posteriors.axes import Axis
from posteriors.errors import LabelError
from posteriors.frame_report import FrameReport, VariableReading
from posteriors.posterior import Posterior
from services.errors import SettingsError
from services.output import posterior_file
from services.output.master_output import print_json, sentence
from services.output.posterior_file import open_result_file, record
from services.output.posterior_output import ROWS, drawing, line, picture
from services.sockets.records import Outcome, Published
from tests.posteriors.messages import posterior_of
from toolchain.deployment import BM1Section, BoardSection, Deployment, Dimension, Source

HASH = "0" * 64


def deployment(*searched):
    lines = 1
    for dimension in searched:
        lines *= dimension.size
    return Deployment(
        name="test",
        source=[Source(uri="ws://robot:9090", topic="/t", type="a/B")],
        searched=list(searched),
        machine=BM1Section(lines=lines),
        board=[BoardSection(image="boards/board0.bm", image_hash=HASH, line_offset=0, lines=lines)],
    )


GRID = deployment(
    Dimension(label="y", size=2, offset=0.5, step=2.0), Dimension(label="x", size=3, offset=-1, step=0.25)
)
ROOMS = deployment(Dimension(label="room", size=3, states=("kitchen", "hall", "attic")))


def made(values, *labels, number=7):
    values = np.asarray(values, float)
    report = number and FrameReport(
        stamp_ns=5,
        heard_ns=0,
        outcome="posterior",
        number=number,
        cycles=812,
        received_ns=1_000_000,
        readings={"D1": VariableReading(7.5, 7, 0.2)},
    )
    return posterior_of(values / values.sum(), *labels, heard_ns=4_210_000, report=report or None)


def axes_of(posterior, deployment):
    return (posterior.with_units(deployment) if deployment else posterior).axes


EMPTY = FrameReport(
    stamp_ns=9, heard_ns=0, outcome="no posterior: impossible", number=8, published=False, missing=("D2",)
)


class TestLine:
    def test_indices_or_values_in_their_units(self):
        posterior = made([[0, 0, 1], [1, 0, 2]], "y", "x")
        assert line(posterior, axes_of(posterior, None)) == (
            "frame 7: cell x 2, y 1 with 0.5; mean cell x 1.5, y 0.75; 812 cycles; 3.21 ms"
        )
        assert "x -0.5, y 2.5 with 0.5; mean x -0.625, y 2;" in line(posterior, axes_of(posterior, GRID))

    def test_replicas_have_a_posterior_each(self):
        posterior = made([[0, 0, 1], [0, 0, 0], [1, 2, 1]], "replica", "x")
        posterior = replace(posterior, probabilities=(0, 0, 1, 0, 0, 0, 0.25, 0.5, 0.25))
        assert line(posterior, axes_of(posterior, None)) == (
            "frame 7: 3 replicas; replica 0 cell x 2 with 1; replica 1 no posterior; replica 2 cell x 1 with 0.5; "
            "812 cycles; 3.21 ms"
        )
        many = replace(posterior, probabilities=(1.0,) * 200, sizes=(200, 1))
        assert "replica 3 cell x 0 with 1; and 196 more; 812 cycles" in line(many, axes_of(many, None))

    def test_states_have_names_and_no_mean_and_a_frame_may_have_no_posterior(self):
        posterior = made([1, 3, 0], "room", number=None)
        assert line(posterior, axes_of(posterior, ROOMS)) == "frame -: room hall with 0.75"
        assert line(EMPTY, []) == "frame 8: no posterior: impossible"

    def test_what_came_over_the_wire_does_not_reach_the_terminal(self):
        evil = "\x1b]0;owned\x07"
        posterior = made([1, 3], evil)
        axes = axes_of(posterior, None)
        drawn = picture(posterior, axes, width=80, colour=False).plain
        bad = FrameReport(stamp_ns=9, heard_ns=0, outcome=evil, number=8, published=False)
        assert "\x1b" not in line(posterior, axes) + drawn + line(bad, [])
        assert len(line(made([1, 3], "x" * 500), axes_of(made([1, 3], "x" * 500), None))) < 200

    def test_a_posterior_of_another_deployment(self):
        with pytest.raises(LabelError, match="deployment of"):
            axes_of(made([[1, 0], [0, 0]], "y", "x"), GRID)


class TestPicture:
    def test_bars(self):
        posterior = made([1, 3, 0], "room")
        rows = picture(posterior, axes_of(posterior, ROOMS), width=37, colour=False).plain.splitlines()
        assert rows[0] == "room"
        assert [row.split() for row in rows[1:]] == [
            ["kitchen", "#" * 7, "0.25"],
            ["hall", "#" * 20, "0.75"],
            ["attic", "0"],
        ]

    def test_a_map_has_its_first_row_below(self):
        posterior = made([[0, 0, 4], [1, 0, 2]], "y", "x")
        rows = picture(posterior, axes_of(posterior, GRID), width=60, colour=False).plain.splitlines()
        assert rows[:3] == ["  y", "2.5 |::  ++|", "0.5 |    @@|"]
        assert rows[3].split() == ["-1", "x", "-0.5"]

    def test_x_goes_across_whatever_the_order_of_the_dimensions(self):
        maps = []
        for values, labels in (([[0, 0, 4], [1, 0, 2]], "yx"), ([[0, 1], [0, 0], [4, 2]], "xy")):
            posterior = made(values, *labels)
            maps.append(picture(posterior, axes_of(posterior, None), width=60, colour=False).plain)
        assert maps[0] == maps[1]

    def test_in_colour_cells_are_coloured(self):
        posterior = made([[0, 1], [0, 0]], "y", "x")
        text = picture(posterior, axes_of(posterior, None), width=60, colour=True)
        colours = [str(span.style) for span in text.spans]
        dark, bright = "on rgb(68,1,84)", "on rgb(253,231,36)"
        assert colours == [dark, dark, dark, bright]

    def test_more_than_two_dimensions(self):
        values = np.zeros((3, 2, 4))
        values[1, :, 2] = 1
        posterior = made(values, "a", "b", "c")
        rows = picture(posterior, axes_of(posterior, None), width=60, colour=False).plain.splitlines()
        assert rows[0].strip() == "a"
        assert rows[2] == "  |    @@  |"
        assert rows[-1] == "summed over b"

    @given(st.integers(1, 400), st.integers(1, 400), st.integers(20, 500))
    def test_any_size_fits(self, height, width, room):
        posterior = made(np.ones((height, width)), "y", "x")
        rows = picture(posterior, axes_of(posterior, None), width=room, colour=False).plain.splitlines()
        assert len(rows) <= ROWS + 4
        assert max(len(row) for row in rows if "|" in row) <= max(min(room, 160), 20)
        assert sum(row.count("@") for row in rows) > 0
        room = max(room, 30)
        bars = made(np.ones(height), "x")
        rows = picture(bars, axes_of(bars, None), width=room, colour=False).plain.splitlines()
        assert len(rows) <= ROWS + 1
        assert max(map(len, rows)) <= room + 10

    def test_a_low_terminal_gets_a_low_picture(self):
        posterior = made(np.ones((64, 64)), "y", "x")
        drawn = picture(posterior, axes_of(posterior, None), width=60, colour=False, rows=8).plain
        assert drawn.count("|\n") == 8
        assert drawn.endswith("each mark is a block of 8 x 3 cells")

    @pytest.mark.parametrize(("terminal", "asked"), [(False, ""), (True, ""), (True, "1")])
    def test_on_a_terminal_one_picture_changes_and_elsewhere_each_is_whole(
        self, monkeypatch, terminal, asked
    ):
        out = io.StringIO()
        out.isatty = lambda: terminal
        monkeypatch.setattr("sys.stdout", out)
        for name, value in {
            "TERM": "xterm-256color",
            "NO_COLOR": asked,
            "COLUMNS": "40",
            "LINES": "24",
        }.items():
            monkeypatch.setenv(name, value)
        with drawing() as show:
            for each in (A, EMPTY, B):
                show(each, axes_of(each, None) if each is not EMPTY else [])
        shown = out.getvalue()
        if not terminal:
            assert "\x1b" not in shown
            assert shown.count("@@") == 3  # b has two such cells
            lines = [row for row in shown.splitlines() if row.startswith("frame")]
            assert lines == [line(A, axes_of(A, None)), line(EMPTY, []), line(B, axes_of(B, None))]
            return
        assert "\x1b[2K" in shown  # a line that is drawn again
        assert "frame 9: " in shown  # the last one, though its turn had not come
        assert (";5;" in shown) == (not asked)
        assert ("@@" in shown) == bool(asked)
        assert shown.endswith("\x1b[?25h")  # the cursor is back


def save(path, *heard, deployment=GRID):
    file = open_result_file(path)
    for each in heard:
        file.add(each, axes_of(each, deployment) if isinstance(each, Posterior) else [])
    file.close()


A, B = made([[0, 0, 4], [1, 0, 3]], "y", "x"), made([[1, 0, 0], [0, 0, 1]], "y", "x", number=9)


class TestFiles:
    def test_json_lines(self, tmp_path):
        path = tmp_path / "out.jsonl"
        save(path, A, EMPTY)
        save(path, B)  # another day
        first, empty, last = map(json.loads, path.read_text().splitlines())
        assert first == {
            "frame": 7,
            "stamp_ns": 5,
            "cycles": 812,
            "missing": [],
            "readings": {"D1": {"value": 7.5, "address": 7, "age_ms": 0.2}},
            "latency_us": 3210.0,
            "probability": 0.5,
            "best": {"y": 0, "x": 2},
            "mean": {"y": 0.5, "x": 1.75},
            "best_value": {"y": 0.5, "x": -0.5},
            "mean_value": {"y": 1.5, "x": -0.5625},
            "labels": ["y", "x"],
            "sizes": [2, 3],
            "probabilities": [0, 0, 0.5, 0.125, 0, 0.375],
        }
        assert empty == {
            "frame": 8,
            "stamp_ns": 9,
            "cycles": None,
            "missing": ["D2"],
            "readings": {},
            "outcome": "no posterior: impossible",
        }
        assert last["frame"] == 9

    def test_states_and_no_deployment(self):
        posterior = made([1, 3, 0], "room")
        said = record(posterior, axes_of(posterior, ROOMS))
        assert (said["best_value"], said["mean_value"]) == ({"room": "hall"}, {})
        assert "best_value" not in record(A, axes_of(A, None))

    def test_csv(self, tmp_path):
        path = tmp_path / "out.csv"
        save(path, A, EMPTY)
        save(path, B)
        first, last = csv.DictReader(path.read_text().splitlines())
        assert first["frame"] == "7"
        assert (first["y"], first["x"], first["probability"]) == ("0.5", "-0.5", "0.5")
        assert (first["y=0 x=2"], first["y=1 x=2"]) == ("0.5", "0.375")
        assert last["frame"] == "9"
        with pytest.raises(SettingsError):  # another model
            save(path, made([1, 0], "x"), deployment=None)
        assert len(path.read_text().splitlines()) == 3

    def test_archive(self, tmp_path):
        path = tmp_path / "out.npz"
        save(path, A, EMPTY, B)
        with np.load(path) as there:
            assert there["probabilities"].shape == (2, 2, 3)
            np.testing.assert_array_equal(there["probabilities"][0], A.values)
            assert there["frame"].tolist() == [7, 9]
            assert there["latency_us"].tolist() == [3210.0, 3210.0]
            assert there["labels"].tolist() == ["y", "x"]
            assert there["axis0"].tolist() == [0.5, 2.5]
            assert there["axis1"].tolist() == [-1, -0.75, -0.5]
        assert [each.name for each in tmp_path.iterdir()] == ["out.npz"]

    def test_an_archive_is_whole_before_its_end_and_has_a_limit_and_one_form(self, tmp_path, monkeypatch):
        monkeypatch.setattr(posterior_file, "_EVERY", 0.0)
        monkeypatch.setattr(posterior_file, "MOST_NUMBERS", 12)
        file = open_result_file(tmp_path / "out.npz")
        file.add(A, axes_of(A, None))
        with np.load(tmp_path / "out.npz") as there:
            assert there["probabilities"].shape == (1, 2, 3)
        with pytest.raises(SettingsError):
            file.add(made([1, 0], "x"), [Axis("x", 2)])
        file.add(B, axes_of(B, None))
        with pytest.raises(SettingsError):
            file.add(A, axes_of(A, None))
        file.close()
        with np.load(tmp_path / "out.npz") as there:
            assert len(there["frame"]) == 2

    def test_a_frame_whose_report_was_lost(self, tmp_path):
        lost = made([[1, 0, 0], [0, 0, 1]], "y", "x", number=None)
        save(tmp_path / "out.npz", lost)
        save(tmp_path / "out.csv", lost)
        with np.load(tmp_path / "out.npz") as there:
            assert there["frame"].tolist() == [-1]
            assert np.isnan(there["latency_us"]).all()
        assert next(csv.DictReader((tmp_path / "out.csv").read_text().splitlines()))["frame"] == ""

    @pytest.mark.parametrize(
        "name", ["out.txt", "out", "out.jsonl.gz", "none/out.jsonl", "none/out.csv", "none/out.npz"]
    )
    def test_another_ending_or_no_such_folder(self, tmp_path, name):
        with pytest.raises(SettingsError):
            open_result_file(tmp_path / name)

    def test_half_a_line_is_not_added_to(self, tmp_path):
        (tmp_path / "out.jsonl").write_text('{"frame": 1')
        with pytest.raises(SettingsError):
            open_result_file(tmp_path / "out.jsonl")

    @pytest.mark.parametrize("name", ["out.jsonl", "out.csv"])
    def test_a_full_disk_leaves_whole_lines(self, tmp_path, monkeypatch, name):
        posterior = made([1, 2, 3], "room")
        with contextlib.closing(open_result_file(tmp_path / name)) as file:
            file.add(posterior, axes_of(posterior, None))
            whole = (tmp_path / name).read_bytes()
            room = [10]
            write = os.write

            def into_little_room(number, data):
                data = data[: room[0]]
                if not data:
                    raise OSError(errno.ENOSPC, "No space left on device")
                room[0] -= len(data)
                return write(number, data)

            monkeypatch.setattr("os.write", into_little_room)
            with pytest.raises(SettingsError):
                file.add(posterior, axes_of(posterior, None))
            monkeypatch.undo()
        assert (tmp_path / name).read_bytes() == whole
        with contextlib.closing(open_result_file(tmp_path / name)) as file:
            file.add(posterior, axes_of(posterior, None))
        assert len((tmp_path / name).read_bytes().splitlines()) == len(whole.splitlines()) + 1


class TestMaster:
    """Results as `master` prints them: the words and the keys of `listen`."""

    deployment = deployment(
        Dimension(label="y", size=2, offset=0.5, step=2.0, unit="m"),
        Dimension(label="size", size=3, states=("small", "medium", "large")),
    )
    posterior = made([[0, 0, 2], [1, 0, 1]], "y", "size")
    published = Published(7, Outcome.PUBLISHED, True, 2, 0.5, 812, 3_210_000)

    def test_the_line_of_a_master_begins_with_the_words_of_listen(self):
        said = sentence(self.published, self.deployment)
        assert said == "frame 7: y 0.5 m, size large with 0.5; 812 cycles; 3.21 ms"
        heard = line(self.posterior, axes_of(self.posterior, self.deployment))
        assert heard == said.replace("with 0.5;", "with 0.5; mean y 1.5 m;")

    def test_best_means_the_same_in_both_objects(self, capfdbinary):
        print_json(self.published, self.deployment)
        said = json.loads(capfdbinary.readouterr().out)
        heard = record(self.posterior, axes_of(self.posterior, self.deployment))
        assert list(said["best"].items()) == [("y", 0), ("size", 2)]
        for key in ("best", "best_value", "probability"):
            assert said[key] == heard[key]
