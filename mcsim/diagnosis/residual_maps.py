"""Residual maps in coarse pixels, in units of what simulations of the model scatter by there."""

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.wiener_filter import FilteredMaps, Model

Map = NDArray[np.float64]

NSIDE = 16
"""Of residual maps, if the data are not coarser: finer pixels show noise and little else."""


def coarse_residuals(model: Model, filtered: FilteredMaps) -> Map:
    """Return sum of N^-1 (d - P s^) over the fine pixels in each coarse one, RING, shape (map, 12 nside^2), uK^-1."""
    nside = min(NSIDE, model.nside)
    fine = healpy.ring2nest(model.nside, np.arange(12 * model.nside**2))
    coarse = healpy.nest2ring(nside, fine // (model.nside // nside) ** 2)
    return np.stack([np.bincount(coarse, weights=row, minlength=12 * nside**2) for row in filtered.residual])


def standardised(x: Map, mean: Map, scatter: Map, count: int) -> Map:
    """Return coarse residuals of data less the mean and over the scatter of those of simulations.

    Parameters
    ----------
    x
        Shape (map, npix).
    mean, scatter, count
        Mean and standard deviation of the simulations, shape (map, npix), and their number, above 3.

    Returns
    -------
    ndarray
        Unit variance in every pixel where the model is right; NaN where nothing was observed.

    Notes
    -----
    The filter leaves a part of the sky in the residual (at high l, behind a mask), so that noise alone is not the
    scatter. x less the mean of N, over their scatter, is Student's t with N - 1 degrees of freedom times
    sqrt(1 + 1/N), of variance (1 + 1/N) (N - 1)/(N - 3), by which it is divided.
    Rms of simulated data: tests/integration/test_diagnosis.py.
    """
    seen = scatter > 0.0
    scale = np.sqrt((1.0 + 1.0 / count) * (count - 1.0) / (count - 3.0))
    return np.where(seen, (x - mean) / np.where(seen, scatter, 1.0) / scale, np.nan)


def rms(drawn: Map) -> Map:
    """Return the rms of the maps of each simulation over their common scatter, shape (N, map), from (N, map, npix).

    Where the filter leaves much of the sky, pixels are correlated, and the rms of a single sky is not near 1.
    """
    if not drawn.size:
        return np.zeros(drawn.shape[:2])
    spread = drawn.std(axis=0, ddof=1)
    z = np.divide(drawn - drawn.mean(axis=0), spread, out=np.full_like(drawn, np.nan), where=spread > 0.0)
    return np.asarray(np.sqrt(np.nanmean(z**2, axis=2)))
