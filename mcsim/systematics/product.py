"""Products of a sky with smooth fields of the sphere, exactly."""

from collections.abc import Callable

import ducc0
import numpy as np
from numpy.typing import NDArray

from mcsim.systematics.base import Alm

Field = Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def multiplied(alm: Alm, lmax: int, field: Field, degree: int) -> Alm:
    """Coefficients, up to ``lmax``, of a sky times a field.

    Parameters
    ----------
    alm, lmax
        The sky.
    field
        Function of the components (x, y, z) of the direction, which broadcast.
    degree
        Highest degree of the field.

    Notes
    -----
    Synthesis and analysis on Gauss-Legendre rings that hold degree lmax + degree: exact to round-off.
    """
    x, y, z = grid(lmax, degree)
    rings, columns = x.shape
    sky = ducc0.sht.synthesis_2d(
        alm=alm[None], lmax=lmax, spin=0, ntheta=rings, nphi=columns, geometry="GL", nthreads=1
    )[0]
    return coefficients(sky * field(x, y, z), lmax)


def grid(lmax: int, degree: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Directions (x, y, z) of Gauss-Legendre rings, for products of degrees ``lmax`` and ``degree``."""
    rings, columns = lmax + degree + 1, 2 * (lmax + degree) + 2
    theta = np.asarray(ducc0.misc.GL_thetas(rings))[:, None]
    phi = (np.arange(columns) * 2.0 * np.pi / columns)[None, :]
    return np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)


def coefficients(values: NDArray[np.float64], lmax: int) -> Alm:
    """Coefficients of values on the rings of :func:`grid`."""
    return np.asarray(ducc0.sht.analysis_2d(map=values[None], spin=0, lmax=lmax, geometry="GL", nthreads=1))[0]
