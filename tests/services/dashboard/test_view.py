"""The messages for one browser: pictures, marginals, pausing and stepping, and files of the kept frames."""

import csv
import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from posteriors.axes import Axis, deployment_axes
from posteriors.frame_report import VariableReading
from services.dashboard.feed import Feed
from services.dashboard.saving import archive, same_shape, table
from services.dashboard.view import View, choices, default_labels
from tests.services.dashboard.frames import posterior, report
from toolchain.deployment import Dimension

HOSTILE = "<img src=x onerror=alert(1)>"


def unpack(message):
    (length,) = struct.unpack_from("<I", message)
    return json.loads(message[4 : 4 + length]), message[4 + length :]


def shown(*outcomes, axes=(), words=(), chosen=()):
    feed = Feed()
    for outcome in outcomes:
        feed.add(outcome, 0.0)
    view = View(feed)
    view.choose(chosen)
    return unpack(view.message(view.frame, axes, dict(words)))


def test_a_heat_map_with_its_mean_and_covariance():
    values = np.zeros((3, 4))
    values[1, 2], values[1, 0], values[2, 2] = 0.5, 0.25, 0.25
    head, picture = shown(posterior(7, values))
    assert list(np.frombuffer(picture, np.uint8).reshape(3, 4)[1]) == [128, 0, 255, 0]
    plot = head["plot"]
    assert [axis["label"] for axis in plot["axes"]] == ["y", "x"]
    assert (head["number"], plot["max"]) == (7, 0.5)
    assert plot["mean"] == [1.25, 1.5]
    points = [(1, 2), (1, 2), (1, 0), (2, 2)]
    rows, columns = np.cov(np.array(points).T, bias=True)
    assert plot["covariance"] == pytest.approx([rows[0], rows[1], columns[1]])


def test_x_goes_across_as_on_a_map():
    values = np.zeros((4, 3))
    values[3, 1] = 1.0
    head, picture = shown(posterior(1, values, ("x", "y")))
    assert [axis["label"] for axis in head["plot"]["axes"]] == ["y", "x"]
    assert np.frombuffer(picture, np.uint8).reshape(3, 4)[1, 3] == 255


def test_axes_have_the_units_of_the_deployment():
    axes = [
        Axis("room", 3, Dimension(label="room", size=3, states=("hall", "bath", "attic"))),
        Axis("x", 4, Dimension(label="x", size=4, offset=-1.5, step=0.5, unit="m")),
    ]
    head, _ = shown(posterior(1, labels=("room", "x")), axes=axes)
    room, x = head["plot"]["axes"]
    assert (x["offset"], x["step"], x["unit"], x["known"]) == (-1.5, 0.5, "m", True)
    assert room["states"] == ["hall", "bath", "attic"]
    assert "mean" not in head["plot"], "names have no mean"
    assert not shown(posterior(1))[0]["plot"]["axes"][0]["known"]


def test_one_variable_is_bars_each_with_its_sampling_error():
    values = np.array([[0.1, 0.3], [0.1, 0.5]])
    one = posterior(1, values, ("rain", "wind"), details={"effective_samples": "10000"})
    head, picture = shown(one, chosen=("rain",))
    assert np.frombuffer(picture, "<f4") == pytest.approx([0.4, 0.6, 0.0049, 0.0049], rel=0.01)
    head, picture = shown(one, chosen=("wind",))
    assert np.frombuffer(picture, "<f4") == pytest.approx([0.2, 0.8, 0.004, 0.004], rel=0.01)
    assert head["plot"]["error"] == pytest.approx(0.004, rel=0.01)
    assert shown(one)[0]["plot"]["error"] == pytest.approx(0.005, rel=0.01), "that of the worst cell"
    head, picture = shown(posterior(1, [0.2, 0.8], ("rain",)))
    assert (len(picture), head["plot"]["error"]) == (8, None)


def test_readings_have_units_and_names():
    readings = {name: VariableReading(1.0, 1, 0.5) for name in ("D1", "grass", "other")}
    words = {"D1": ("m", ()), "grass": ("", ("dry", "wet"))}
    head, _ = shown(posterior(1, readings=readings), words=words)
    assert head["readings"] == [
        ["D1", 1.0, 1, 0.5, "m"], ["grass", "wet", 1, 0.5, ""], ["other", 1.0, 1, 0.5, ""],
    ]  # fmt: skip


def test_chosen_marginals_of_more_variables_and_replicas():
    values = np.random.default_rng(3).random((2, 3, 4, 5))
    values /= values.sum(axis=(1, 2, 3), keepdims=True)
    one = posterior(1, values, ("replica", "a", "b", "c"))
    assert choices(("a", "b", "c")) == [("a", "b"), ("a", "c"), ("b", "c"), ("a",), ("b",), ("c",)]
    head, picture = shown(one, chosen=("c", "a"))
    expected = values.sum(axis=(0, 2)).T / 2
    assert head["plot"]["max"] == pytest.approx(expected.max())
    assert list(np.frombuffer(picture, np.uint8)) == pytest.approx(
        (expected * 255 / expected.max()).ravel(), abs=0.51
    )
    bars = np.frombuffer(shown(one, chosen=("b",))[1], "<f4")
    assert bars == pytest.approx(values.sum(axis=(0, 1, 3)) / 2)
    feed = Feed()
    assert default_labels(feed.add(one, 0.0)) == ("a", "b")
    assert shown(one, chosen=("gone",))[0]["plot"]["axes"][0]["label"] == "a"


def test_pause_step_and_return_to_the_newest():
    feed = Feed()
    view = View(feed)
    view.pause(True)
    view.step(-1)
    assert (view.frame, view.at) == (None, None)
    for number in range(1, 6):
        feed.add(posterior(number), 0.0)
    view.step(-2)
    feed.add(posterior(6), 0.0)
    head = unpack(view.message(view.frame, (), {}))[0]
    assert (head["number"], head["paused"], head["last"]) == (3, True, 6)
    view.step(1)
    assert view.frame.report.number == 4
    view.step(-100)
    assert view.frame.report.number == 1
    view.pause(False)
    assert (view.frame.report.number, view.at) == (6, None)


def test_a_frame_without_a_posterior_says_why():
    head, picture = shown(
        posterior(1), report(2, outcome="no posterior: impossible on every board", published=False)
    )
    assert (head["plot"], head["outcome"], picture) == (None, "no posterior: impossible on every board", b"")


def test_names_stay_what_they_are():
    one = posterior(
        1, labels=(HOSTILE, "x"), readings={HOSTILE: VariableReading(1.5, 3, 0.5)}, missing=(HOSTILE,)
    )
    head, _ = shown(one, words={HOSTILE: (HOSTILE, ())})
    assert head["plot"]["axes"][0]["label"] == HOSTILE
    assert (head["readings"], head["missing"]) == ([[HOSTILE, 1.5, 3, 0.5, HOSTILE]], [HOSTILE])


def test_the_kept_frames_as_files(boat):
    feed = Feed()
    feed.add(posterior(1, np.full((2, 2), 0.25)), 0.0)
    feed.add(report(2, published=False), 0.0)
    values = np.zeros((8, 8))
    values[5, 2] = 1.0
    for number in (3, 4):
        feed.add(posterior(number, values, cycles=70), 0.0)
    frames = same_shape(feed.frames, None)
    with np.load(io.BytesIO(archive(frames, deployment_axes(boat)))) as arrays:
        assert arrays["probabilities"].shape == (2, 8, 8)
        assert list(arrays["frame"]) == [3, 4]
        assert len(arrays["axis0"]) == 8
    names, *rows = csv.reader(io.StringIO(table(frames).decode()))
    row = dict(zip(names, rows[0], strict=True))
    assert (row["frame"], row["cycles"], row["y"], row["x"], row["y=5 x=2"]) == ("3", "70", "5", "2", "1.0")
    assert same_shape(feed.frames, feed.frames[0]) == [feed.frames[0]]
    assert same_shape((), None) == []


def test_a_spreadsheet_computes_no_name():
    frame = Feed().add(posterior(1, [0.5, 0.5], ("=1+1",)), 0.0)
    assert b"\n=" not in table([frame])
    assert b",=" not in table([frame])


def test_numbers_beyond_every_range():
    """Anybody can publish them, and the page must go on."""
    huge = 10**30
    reading = {"D1": VariableReading(1e300, huge, 0.5)}
    one = posterior(huge, np.full((2, 2), 1e-300), cycles=huge, readings=reading)
    head, picture = shown(replace(one, heard_ns=1))
    assert (head["number"], head["cycles"]) == ("1.00e+30", "1.00e+30")
    assert head["plot"]["max"] == 0.25
    assert list(picture) == [255] * 4
    for value in (1e307, 5e-324):
        extreme = replace(posterior(1, np.full((2, 2), value), cycles=10**400), heard_ns=1)
        head, picture = shown(extreme)
        assert (head["plot"]["mean"], list(picture)) == ([0.5, 0.5], [255] * 4)
