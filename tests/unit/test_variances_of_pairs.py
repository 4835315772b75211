"""Variances and covariances of A^{LM} of two maps whose spectra differ."""

import numpy as np
import pytest

from mcsim.bipolar.theory import Overlap, Spectra, isotropic_variance
from mcsim.bipolar.theory.circles import Circles

LMAX = 8
ELL = np.arange(LMAX + 1)
X, Y, CROSS = 100.0 / (ELL + 1.0) ** 2, 50.0 * np.exp(-0.3 * ELL), 10.0 / (ELL + 1.0)


@pytest.mark.parametrize("shift", [1, 2])
def test_covariances_of_two_degrees_are_of_each_maps_own(shift: int) -> None:
    """The first map has l1 and l1 + n, the second one l2 and l2 + n."""
    overlap = Overlap(np.ones((3, 1)), np.ones((3, 1)))
    found = isotropic_variance([(1, 0, 1)], Spectra(X, Y, CROSS), overlap, shift)[0]
    for l2 in range(2, LMAX - shift):
        expected = np.sqrt(X[l2 - 1] * X[l2 - 1 + shift] * Y[l2] * Y[l2 + shift])
        assert found[l2] == pytest.approx(expected)


def test_the_second_term_of_two_degrees_has_the_cross_spectrum_of_both() -> None:
    """Masks give single M such a term; the weights here have one that is the same at all degrees."""
    around = Circles(np.array([0.5, 1.0]), np.array([0.5, 0.5]), np.zeros((1, 2)), np.ones((2, 1, 2)))
    weights = Overlap(np.ones((1, 1)), np.ones((1, 1)), around)
    one, other = (isotropic_variance([(2, 1, 1)], Spectra(X, Y, c), weights)[0] for c in (CROSS, 0.0 * CROSS))
    ratio = (one - other)[3:] / (CROSS[3:] * CROSS[2:-1])
    assert abs(ratio[0]) > 0.01
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)


def test_what_rounding_leaves_of_maps_of_one_sky_is_no_variance() -> None:
    """Of odd L, and without noise; else a signal to noise of any size comes of it."""
    cl = np.random.default_rng(1).uniform(1.0, 2.0, 200)
    found = isotropic_variance([(1, 0, 0)], Spectra(cl, 2.0 * cl, np.sqrt(2.0) * cl))[0]
    np.testing.assert_array_equal(found[1:], 0.0)
