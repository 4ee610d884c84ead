"""A posterior as a notebook shows it: the table, the picture in it, and the drawing with matplotlib."""

import base64
import io
import re
from html.parser import HTMLParser

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.image import imread

from posteriors import LabelError, Posterior
from tests.posteriors.messages import posterior_of
from toolchain.deployment import Dimension

mpl.use("Agg")

Y = Dimension(label="y", size=2, offset=0.5, step=2.0, unit="m")
X = Dimension(label="x", size=3, offset=-1, step=0.25, unit="m")
ROOM = Dimension(label="room", size=3, states=("kitchen", "hall", "attic"))

PURPLE, YELLOW = (68, 1, 84), (253, 231, 36)
"""The ends of the colour scale."""


def made(values, *dimensions, **details):
    labels = (each.label for each in dimensions)
    return posterior_of(np.asarray(values) / np.sum(values), *labels, dimensions=dimensions, details=details)


class _Reader(HTMLParser):
    """The texts of the cells of tables, row by row, and of the paragraphs, as a browser sees them."""

    def __init__(self, html):
        super().__init__()
        self.rows, self.said, self.open = [], [], []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        assert {name for name, _ in attributes} <= {"align", "alt", "src"}
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in {"td", "th"}:
            self.rows[-1].append("")
        elif tag == "p":
            self.said.append("")

    def handle_startendtag(self, tag, _attributes):
        assert tag == "img"

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        assert self.open[-1] in {"td", "th", "p"}
        texts = self.said if self.open[-1] == "p" else self.rows[-1]
        texts[-1] += data


def cells_of(html):
    read = _Reader(html)
    return read.rows, read.said


def as_html(posterior):
    return posterior._repr_html_()


def pixels_of(html):
    """The colours of the picture, uint8[height, width, 3]."""
    data = base64.b64decode(re.search(r'base64,([^"]+)"', html)[1])
    return (imread(io.BytesIO(data)) * 255).round().astype(np.uint8)[:, :, :3]


def test_a_map_has_values_in_their_units_and_its_first_row_at_the_bottom():
    html = as_html(made([[0, 0, 1], [1, 0, 6]], Y, X, effective_samples="812", standard_error="0.004"))
    rows, said = cells_of(html)
    assert rows[1:] == [["x", "3", "-1 m", "-0.5 m", "-0.5 m"], ["y", "2", "0.5 m", "2.5 m", "2.5 m"]]
    assert "0.75; entropy: 1.06 of 2.58 bits; effective samples: 812; standard error: 0.004" in said[0]
    pixels = pixels_of(html)
    height, width, _ = pixels.shape
    assert tuple(pixels[0, -1]) == YELLOW
    assert tuple(pixels[-1, 0]) == PURPLE
    assert (height / width) == pytest.approx(2 / 3, abs=0.02)


def test_states_have_bars():
    rows, _ = cells_of(as_html(made([1, 3, 0], ROOM)))
    assert rows[1] == ["room", "3", "kitchen", "attic", "hall"]
    assert rows[3:] == [["kitchen", "0.2500", "█" * 8], ["hall", "0.7500", "█" * 24], ["attic", "0.0000", ""]]


def test_a_long_dimension_is_a_curve_and_a_third_one_is_summed_out():
    line = Dimension(label="x", size=600, step=0.1)
    pixels = pixels_of(as_html(made(np.arange(600) + 1, line)))
    filled = (pixels == pixels[-1, -1]).all(axis=2).sum(axis=0)
    assert filled[0] < 3
    assert filled[-1] == len(pixels)
    assert (np.diff(filled) >= 0).all()
    values = np.zeros((2, 4, 3))
    values[1, 0, 2] = 1
    html = as_html(posterior_of(values, "floor", "y", "x"))
    assert "summed over floor" in html
    assert tuple(pixels_of(html)[-1, -1]) == YELLOW


def test_replicas_are_shown_and_drawn_one_by_one():
    several = posterior_of([[0, 0, 1], [0, 0, 0], [0.25, 0.5, 0.25]], "replica", "x")
    assert "3 replicas" in as_html(several)
    assert cells_of(as_html(several.replica(2)))[0][1][-1] == "1"
    with pytest.raises(LabelError, match="replica"):
        several.plot()


HOSTILE = st.text(max_size=40) | st.sampled_from(["<script>alert(1)</script>", "$\\frac$", '"&<', "a\x1b[2J"])


@given(HOSTILE, HOSTILE, HOSTILE, st.integers(1, 3))
@settings(max_examples=40)
def test_names_from_a_file_or_a_network_are_only_text(one, other, detail, count):
    labels = [one, other, "third"][:count] if one != other else [one]
    if "replica" in labels:
        return
    posterior = Posterior(
        probabilities=(0.5, *[0.5 / (2 ** len(labels) - 1)] * (2 ** len(labels) - 1)),
        labels=tuple(labels),
        sizes=(2,) * len(labels),
        heard_ns=0,
        details={detail: detail},
    )
    html = as_html(posterior)
    cells_of(html)
    assert "\x1b" not in html
    assert "\x1b" not in repr(posterior)


@pytest.fixture
def axes():
    from matplotlib.figure import Figure

    return Figure().subplots()


class TestPlot:
    @pytest.mark.parametrize("turned", [False, True])
    def test_a_map_has_x_across_and_y_upwards(self, axes, turned):
        values = np.array([[0, 0, 1], [1, 0, 6]])
        drawn = (made(values.T, X, Y) if turned else made(values, Y, X)).plot(axes)
        assert drawn is axes
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "y (m)")
        assert (axes.get_xlim(), axes.get_ylim()) == ((-1.125, -0.375), (-0.5, 3.5))
        (image,) = axes.images
        assert image.origin == "lower"
        assert image.get_array()[1, 2] == 0.75

    def test_states_are_named(self, axes):
        made([1, 3, 0], ROOM).plot(axes)
        assert [each.get_text() for each in axes.get_xticklabels()] == ["kitchen", "hall", "attic"]
        assert [bar.get_height() for bar in axes.patches] == [0.25, 0.75, 0.0]

    def test_a_dollar_is_no_formula(self, axes):
        states = tuple(f"${each}\\frac" for each in "abc")
        evil = Dimension(label="$\\frac", size=3, unit="$\\frac", states=states)
        made(np.ones((3, 3, 3)), evil, evil.replace(label="$_"), evil.replace(label="a$_")).plot(axes)
        axes.figure.canvas.draw()

    def test_a_figure_of_its_own(self):
        from matplotlib import pyplot as plt

        axes = made([1, 3, 0], ROOM).plot()
        assert plt.fignum_exists(axes.figure.number)
        plt.close(axes.figure)
