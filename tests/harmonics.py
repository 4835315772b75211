"""Spherical harmonics by their recurrence in l, against which beams are tested."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln


def legendre(lmax: int, m: int, theta: NDArray) -> NDArray:
    """Y_lm(theta, 0) for l = 0..lmax by the three-term recurrence in l."""
    y = np.zeros((lmax + 1, theta.size))
    log_norm = 0.5 * (np.log((2 * m + 1) / (4 * np.pi)) + gammaln(2 * m + 1)) - gammaln(m + 1) - m * np.log(2)
    y[m] = (-1) ** m * np.exp(log_norm) * np.sin(theta) ** m
    for ell in range(m + 1, lmax + 1):
        factor = np.sqrt((4 * ell**2 - 1) / (ell**2 - m**2))
        y[ell] = factor * np.cos(theta) * y[ell - 1]
        if ell > m + 1:
            y[ell] -= factor * np.sqrt(((ell - 1) ** 2 - m**2) / (4 * (ell - 1) ** 2 - 1)) * y[ell - 2]
    return y
