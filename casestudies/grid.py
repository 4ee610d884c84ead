"""A rectangle divided into cells."""

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """A grid of cells over [x_low, x_high] and [y_low, y_high], in the units of a map.

    Each cell has a line of the machine: line = row * width + column. Rows are counted along y and columns along x, from
    the lower left corner.
    """

    x_low: float
    x_high: float
    y_low: float
    y_high: float
    width: int
    height: int

    @property
    def cell_width(self) -> float:
        """Size of a cell along x, in the map's units."""
        return (self.x_high - self.x_low) / self.width

    @property
    def cell_height(self) -> float:
        """Size of a cell along y, in the map's units."""
        return (self.y_high - self.y_low) / self.height

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the (column, row) of the cell that contains a point, or of the nearest cell to a point outside."""
        column = math.floor((x - self.x_low) / self.cell_width)
        row = math.floor((y - self.y_low) / self.cell_height)
        return min(max(column, 0), self.width - 1), min(max(row, 0), self.height - 1)

    def mean(self, posterior: Sequence[float]) -> tuple[float, float]:
        """Return the mean position (x, y) of a posterior, in the map's units. A cell counts with its centre.

        The posterior is float64[cells], row-major. No value is negative. The sum is above 0, but need not be 1.
        """
        total = math.fsum(posterior)
        by_row = [
            math.fsum(posterior[row * self.width : (row + 1) * self.width]) for row in range(self.height)
        ]
        by_column = [math.fsum(posterior[column :: self.width]) for column in range(self.width)]
        column_mean = math.fsum(mass * (i + 0.5) for i, mass in enumerate(by_column)) / total
        row_mean = math.fsum(mass * (i + 0.5) for i, mass in enumerate(by_row)) / total
        return self.x_low + column_mean * self.cell_width, self.y_low + row_mean * self.cell_height
