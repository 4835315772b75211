"""Numbers in the cells of a table that is drawn in colours."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike


def write_cells(axes: Axes, cells: Iterable[tuple[tuple[int, ...], str]], dark: ArrayLike, size: float) -> None:
    """Write texts into cells, each given by row and column: white where they are ``dark``, shape (rows, columns)."""
    for (row, column), text in cells:
        colour = "white" if np.asarray(dark)[row, column] else "black"
        axes.text(column, row, text, ha="center", va="center", fontsize=size, color=colour)
