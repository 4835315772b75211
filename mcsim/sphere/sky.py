"""Coefficients of isotropic Gaussian skies and of the dipole."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere.checks import check_cl, check_whole


def gaussian_alm(cl: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.complex128]:
    """Draw the coefficients of an isotropic Gaussian sky.

    ``cl`` is C_l in uK^2, shape (lmax + 1,), finite and non-negative; 2 * size(lmax) standard normal numbers are drawn.
    Return a_lm in uK, shape (size(lmax),), with E|a_lm|^2 = C_l; a_l0 is real.
    """
    lmax = np.size(cl) - 1
    check_cl(cl, lmax)
    alm = rng.standard_normal(2 * alm_.size(lmax)).view(np.complex128)
    alm[: lmax + 1] = alm[: lmax + 1].real * np.sqrt(2.0)
    alm *= np.sqrt(cl / 2.0)[alm_.degrees(lmax)]
    return alm


def dipole_alm(dipole_uk: Sequence[float] | NDArray[np.float64], lmax: int) -> NDArray[np.complex128]:
    """Return the a_lm up to ``lmax`` >= 1 of the sky d . n, for a vector d in uK in the frame of the maps."""
    check_whole(lmax, "lmax of a dipole", 1)
    if np.shape(dipole_uk) != (3,) or not np.all(np.isfinite(dipole_uk)):
        raise InputError(f"dipole_uk is {dipole_uk}, but it must be a vector of three finite components in uK.")
    x, y, z = (float(component) for component in dipole_uk)
    alm = np.zeros(alm_.size(lmax), dtype=np.complex128)
    alm[alm_.start(lmax, 0) + 1] = math.sqrt(4.0 * math.pi / 3.0) * z
    alm[alm_.start(lmax, 1) + 1] = -math.sqrt(2.0 * math.pi / 3.0) * complex(x, -y)
    return alm
