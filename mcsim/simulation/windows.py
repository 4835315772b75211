"""Windows in l of what is done to maps: means over pixels, squared kernels, files of B_l."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import healpix
from mcsim.sphere.checks import NSIDE_MAX

Window = NDArray[np.float64]

SUBPIXELS = 8
"""Side of the grid inside a pixel that stands for it up to l = 24 nside."""


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


def read_beam(path: Path, lmax: int) -> Window:
    """Read B_l from l = 0 to lmax: a text table (B_l, or ell and B_l), a FITS table or a .npy file.

    Raise InputError if the file cannot be read, ends below lmax, or does not start at 1.
    """
    if path.suffix in (".npy", ".fits", ".fit", ".gz"):
        return healpix.read_pixel_window(path, lmax)
    try:
        table = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a table of B_l ({error}); give columns ell and B_l.") from None
    if table.shape[1] > 1 and not np.array_equal(table[:, 0], np.arange(len(table))):
        raise InputError(f"{path} does not count ell from 0 in its first column; give every ell from 0 on.")
    window: Window = table[:, 1] if table.shape[1] > 1 else table[:, 0]
    if window.size <= lmax or abs(window[0] - 1.0) > 0.01 or not np.all(np.isfinite(window)):
        raise InputError(
            f"{path} holds B_l up to l = {window.size - 1}, from {window[0]:g} on; give finite B_l from 1 at l = 0 up "
            f"to l = {lmax}."
        )
    return window[: lmax + 1]
