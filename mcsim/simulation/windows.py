"""Windows in l of what is done to maps: means over pixels, squared kernels."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mcsim.sphere import healpix
from mcsim.sphere.checks import NSIDE_MAX

Window = NDArray[np.float64]

SUBPIXELS = 8  #: side of the grid inside a pixel that stands for it up to l = 24 nside


@lru_cache(maxsize=8)
def of_pixels(nside: int, lmax: int) -> Window:
    """Return the pixel window far beyond 3 nside: that of a mean over 8 x 8 sub-pixels, times theirs, (lmax + 1,)."""
    split = min(SUBPIXELS, NSIDE_MAX // nside)
    window = healpix.mean_window(nside, split, lmax) * healpix.pixel_window(split * nside, lmax)
    window.setflags(write=False)
    return window


def stretched(window: Window, nside: int, spread: float) -> Window:
    """Return a pixel window where samples stand ``spread`` times as far from their pixels' centres, (lmax + 1,).

    In pixels so much larger the sky looks as it does at lower degrees in theirs: l (l + 1) counts spread^2 times. It is
    a Gaussian in all but name, w^(spread^2); by how much it departs from one is that of the computed window. Ones stay.
    """
    power, lmax = spread * spread, window.size - 1
    if power == 1.0 or np.all(window == 1.0):
        return window
    own = healpix.pixel_window(nside, (lmax + 1) * int(np.ceil(max(abs(spread), 1.0))))
    there = np.sqrt(0.25 + power * np.arange(lmax + 1.0) * np.arange(1.0, lmax + 2.0)) - 0.5
    return np.asarray(np.interp(there, np.arange(own.size), own) * (window / own[: lmax + 1]) ** power)


@lru_cache(maxsize=8)
def of_average(fine: int, coarse: int, lmax: int) -> Window:
    """Return the window of the plain mean of the fine pixels' centres inside the coarse ones, shape (lmax + 1,).

    It is the mean over the coarse pixels of <P_l(x . y)>, x and y the centres, whose square root a Gaussian sky sees
    exactly; up to about 3 nside of the fine pixels it is the ratio of the two pixel windows.
    """
    split = min(fine // coarse, SUBPIXELS)
    window = healpix.mean_window(coarse, split, lmax)
    if split * coarse != fine:
        finest = np.maximum(healpix.pixel_window(fine, lmax), np.finfo(float).tiny)
        window = window * healpix.pixel_window(split * coarse, lmax) / finest
    window.setflags(write=False)
    return window
