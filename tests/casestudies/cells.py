"""Cells of a grid by their lines."""


def line_at(grid, x, y):
    """The machine's line of the cell that contains a point."""
    column, row = grid.cell(x, y)
    return row * grid.width + column


def centre(grid, line):
    """The centre (x, y) of a line's cell, in the map's units."""
    row, column = divmod(line, grid.width)
    return grid.x_low + (column + 0.5) * grid.cell_width, grid.y_low + (row + 0.5) * grid.cell_height
