"""Residual maps, and what they tell of the noise of every pixel, in single passes over memory."""

from collections.abc import Sequence

import numpy as np

from mcsim.support.arrays import Map, divided
from mcsim.support.compiled import njit

Weighted = Sequence[tuple[Map, Map]]
"""Residuals r, zero where nothing was seen, and precisions 1/N of the maps of a channel, shape (npix,) each."""


@njit(nogil=True)
def weigh(clean, expected, precision, residual):  # type: ignore[no-untyped-def]
    """Fill a residual: precision times what a map has beside what is expected."""
    for pixel in range(residual.size):
        residual[pixel] = precision[pixel] * (clean[pixel] - expected[pixel])


def fill_difference(maps: Weighted, found: Map) -> None:
    """Fill u^2 - 1 of every pixel seen by a channel's first two maps, u their difference over its noise.

    Of a channel with one map, u is its residual over the noise. Pixels that are not seen are left alone.
    """
    first, a = maps[0]
    if len(maps) == 1:
        seen = first != 0.0
        found[:] = divided(first**2, np.where(seen, a, 0.0)) - seen
    else:
        _difference(first, a, *maps[1], found)


@njit(nogil=True)
def _difference(first, a, second, b, found):  # type: ignore[no-untyped-def]
    """Fill (r/a - s/b)^2 / (1/a + 1/b) - 1: residuals come times their precision."""
    for pixel in range(found.size):
        if first[pixel] != 0.0 and second[pixel] != 0.0:
            square = (first[pixel] * b[pixel] - second[pixel] * a[pixel]) ** 2
            found[pixel] = square / (a[pixel] * b[pixel] * (a[pixel] + b[pixel])) - 1.0


def add_squares(maps: Weighted, total: Map) -> None:
    """Add N r^2 of every pixel and map: twice the derivative of ln L in ln N, but for a constant.

    All modes take part that know of the noise: those of the difference of splits, and those of their sum that the sky
    does not fill. A pixel that the data lack counts like the map's mean.
    """
    for residual, precision in maps:
        _add_square(residual, precision, total)


@njit(nogil=True)
def _add_square(residual, precision, total):  # type: ignore[no-untyped-def]
    whole, seen, lacking = 0.0, 0, 0
    for pixel in range(residual.size):
        if residual[pixel] != 0.0 and precision[pixel] > 0.0:
            square = residual[pixel] ** 2 / precision[pixel]
            total[pixel] += square
            whole += square
        seen += residual[pixel] != 0.0
        lacking += residual[pixel] == 0.0 and precision[pixel] > 0.0
    if lacking:
        for pixel in range(residual.size):
            if residual[pixel] == 0.0 and precision[pixel] > 0.0:
                total[pixel] += whole / max(seen, 1)
