"""The sky that noisy maps show, against dense matrices."""

import healpy
import numpy as np

from mcsim.comparison.sky_of_maps import wiener
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix

NSIDE, LMAX = 4, 6


def real(alm: np.ndarray) -> np.ndarray:
    """Return real and imaginary parts, those of m > 0 times sqrt(2): a Euclidean vector."""
    size = np.where(alm_.orders(LMAX) == 0, 1.0, np.sqrt(2.0))
    return np.concatenate([(size * alm).real, (size * alm).imag[alm_.orders(LMAX) > 0]])


def matrix() -> np.ndarray:
    """Return the synthesis as a matrix on such vectors, by healpy."""
    columns = []
    for m_positive, unit in ((False, 1.0), (True, 1j)):
        for index in np.flatnonzero((alm_.orders(LMAX) > 0) | ~np.array(m_positive)):
            alm = np.zeros(alm_.size(LMAX), complex)
            alm[index] = unit / (1.0 if alm_.orders(LMAX)[index] == 0 else np.sqrt(2.0))
            columns.append(healpy.alm2map(alm, NSIDE, lmax=LMAX))
    return np.stack(columns, axis=1)


def test_the_adjoint_is_the_transposed_matrix():
    map_ = np.random.default_rng(1).standard_normal(12 * NSIDE**2)
    assert np.allclose(real(healpix.adjoint(map_, LMAX)), matrix().T @ map_, atol=1e-10)


def test_the_filter_solves_the_normal_equations_with_weights_of_every_pixel():
    draw, synthesis = np.random.default_rng(2), matrix()
    weight = np.where(draw.random(12 * NSIDE**2) < 0.2, 0.0, draw.uniform(0.5, 2.0, 12 * NSIDE**2))
    power = 1.0 / (1.0 + np.arange(LMAX + 1)) ** 2
    weighted = weight * draw.standard_normal(12 * NSIDE**2)
    of_l = alm_.degrees(LMAX)
    prior = np.concatenate([power[of_l], power[of_l[alm_.orders(LMAX) > 0]]])
    wanted = np.linalg.solve(synthesis.T @ (weight[:, None] * synthesis) + np.diag(1.0 / prior), synthesis.T @ weighted)
    found = real(wiener(weighted, weight, power, 1))
    assert np.allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())
