"""Statistically isotropic Gaussian skies."""

import numpy as np
from numpy.typing import NDArray

from mcsim import alm as alm_


def gaussian_alm(cl: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.complex128]:
    """Draw the coefficients of an isotropic Gaussian sky.

    Parameters
    ----------
    cl
        Power spectrum C_l in uK^2, shape (lmax + 1,), non-negative.
    rng
        Source of randomness: 2 * size(lmax) standard normal numbers are drawn.

    Returns
    -------
    ndarray
        a_lm in uK, shape (size(lmax),), with E|a_lm|^2 = C_l; a_l0 is real.
    """
    lmax = len(cl) - 1
    alm = rng.standard_normal(2 * alm_.size(lmax)).view(np.complex128)
    alm[: lmax + 1] = alm[: lmax + 1].real * np.sqrt(2.0)
    alm *= np.sqrt(cl / 2.0)[alm_.degrees(lmax)]
    return alm
