"""Cells of a rectangle: every point has one, and each centre lies in its own."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from casestudies.grid import Grid
from tests.casestudies.cells import centre, line_at

BOAT = Grid(x_low=-50, x_high=50, y_low=-50, y_high=50, width=32, height=32)


@st.composite
def grids(draw):
    x_low, y_low = draw(st.integers(-100, 100)), draw(st.integers(-100, 100))
    return Grid(
        x_low=x_low,
        x_high=x_low + draw(st.integers(1, 200)),
        y_low=y_low,
        y_high=y_low + draw(st.integers(1, 200)),
        width=draw(st.integers(1, 40)),
        height=draw(st.integers(1, 40)),
    )


@given(grids(), st.data())
def test_a_point_is_at_most_half_a_cell_from_its_cells_centre(grid, data):
    x = data.draw(st.floats(grid.x_low, grid.x_high))
    y = data.draw(st.floats(grid.y_low, grid.y_high))
    centre_x, centre_y = centre(grid, line_at(grid, x, y))
    assert abs(centre_x - x) <= grid.cell_width / 2 * (1 + 1e-9)
    assert abs(centre_y - y) <= grid.cell_height / 2 * (1 + 1e-9)


def test_lines_are_row_major_from_the_lower_left_corner():
    assert line_at(BOAT, -49.9, -49.9) == 0
    assert line_at(BOAT, 49.9, -49.9) == 31
    assert line_at(BOAT, -49.9, 49.9) == 31 * 32
    assert BOAT.cell(0.1, -49.9) == (16, 0)


def test_points_outside_belong_to_the_border():
    assert BOAT.cell(-1000, 1000) == (0, 31)
    assert BOAT.cell(50, 50) == (31, 31)


def test_the_mean_of_two_cells_lies_between_them_by_weight():
    grid = Grid(x_low=0, x_high=2, y_low=0, y_high=1, width=2, height=1)
    assert grid.mean([3.0, 1.0]) == pytest.approx((0.75, 0.5))
