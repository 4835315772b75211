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
