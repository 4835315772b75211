"""Variances of A^{LM} of two masked maps against sums over the explicit covariance of their coefficients."""

import healpy
import numpy as np
import pytest
import wignernj
from scipy.special import sph_harm_y

from mcsim.bipolar.modes import modes as all_modes
from mcsim.bipolar.theory import FULL_SKY, Spectra, isotropic_variance, map_harmonics, overlap, pseudo_spectrum
from mcsim.bipolar.theory.circles import circles
from mcsim.ensemble import summary
from mcsim.ensemble.layout import Layout

NSIDE, SKY, LMAX = 8, 20, 14
THETA, PHI = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))
X, Y, Z = np.array(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
INDEX = [(ell, m) for ell in range(SKY + 1) for m in range(-ell, ell + 1)]
DEGREE = np.array([ell for ell, _ in INDEX])
PLACE = {key: i for i, key in enumerate(INDEX)}
CL = 1000.0 / (np.arange(SKY + 1.0) + 1.0)


def belt(distance: np.ndarray) -> np.ndarray:
    """1 far from a plane, 0 on it."""
    weight = np.clip(np.abs(distance) / 0.6, 0.0, 1.0) ** 2
    return weight / np.sqrt(np.mean(weight**2))


def cap(height: np.ndarray) -> np.ndarray:
    """0 at one pole, 1 at the other."""
    weight = np.clip(0.6 + height, 0.0, 1.0)
    return weight / np.sqrt(np.mean(weight**2))


class Masked:
    """Covariances of the coefficients of two maps of one sky without noise, and their mean pseudo-spectra."""

    def __init__(self, x: np.ndarray, y: np.ndarray) -> None:
        harmonics = np.stack([sph_harm_y(ell, m, THETA, PHI) for ell, m in INDEX], axis=1)
        through = [harmonics.conj().T @ (w[:, None] * harmonics) * (4.0 * np.pi / w.size) for w in (x, y)]
        self.xx, self.yy, self.xy = (
            (through[i] * CL[DEGREE]) @ through[j].conj().T for i, j in ((0, 0), (1, 1), (0, 1))
        )
        self.norm = float(np.mean(x * y))

    def spectra(self) -> Spectra:
        found = [np.bincount(DEGREE, np.diag(c).real) / np.bincount(DEGREE) for c in (self.xx, self.yy, self.xy)]
        return Spectra(found[0][: LMAX + 1], found[1][: LMAX + 1], found[2][: LMAX + 1] / self.norm)

    def covariance(self, L: int, d: int, l2: int, shift: int) -> float:
        """The mean over all M of that of single ones."""
        return sum(self.of_one_M((L, M, d), l2, shift) for M in range(-L, L + 1)) / (2 * L + 1)

    def of_one_M(self, mode: tuple[int, int, int], l2: int, shift: int) -> float:
        """E A_{l1 l2} A*_{l1+n l2+n} less the means, times the alternating sign."""
        signs = np.array([(-1.0) ** m for _, m in INDEX])
        mirrored = [PLACE[ell, -m] for ell, m in INDEX]
        both = self.xy[:, mirrored] * signs  # <x_i y_j> without a conjugate
        (i, j, g), (k, n, h) = (self.terms(*mode, ell) for ell in (l2, l2 + shift))
        first = self.xx[np.ix_(i, k)] * self.yy[np.ix_(n, j)].T
        second = both[np.ix_(i, n)] * both[np.ix_(k, j)].conj().T
        return (-1.0) ** shift * float((g @ (first + second) @ h).real) / self.norm**2

    @staticmethod
    def terms(L: int, M: int, d: int, l2: int) -> tuple[list[int], list[int], np.ndarray]:
        l1 = l2 - d
        orders = [m for m in range(-l1, l1 + 1) if abs(m - M) <= l2]
        clebsch = [(-1) ** (m - M) * float(wignernj.clebsch_gordan(l1, m, l2, M - m, L, M)) for m in orders]
        return [PLACE[l1, m] for m in orders], [PLACE[l2, m - M] for m in orders], np.array(clebsch)


PAIRS = {
    "two masks": (belt(Z), belt(0.5 * X + 0.8 * Z)),
    "a mask and none": (np.ones(Z.size), belt(Z)),
    "caps": (cap(Z), cap(-Z)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_variances_of_masked_pairs_are_sums_over_covariances(name: str) -> None:
    """All parities, L = 0 among them; where (C^XY)^2 > C^XX C^YY, at low l, errors of odd L were zero."""
    weights = PAIRS[name]
    masked = Masked(*weights)
    spectra = masked.spectra()
    assert spectra.y is not None
    assert spectra.cross is not None
    modes = [(0, 0, 0), (1, 0, 0), (1, 0, 1), (2, 0, 0), (2, 0, -2), (3, 0, 0)]
    found = overlap(*weights, 2, 16)
    variance = isotropic_variance(modes, spectra, found)
    beside = isotropic_variance(modes, spectra, found, 2)
    for row, (L, _, d) in enumerate(modes):
        for l2 in (4, 6, 8, 10):
            scale = found.autos[0].sum() * spectra.x[l2 - d] * spectra.y[l2]
            assert variance[row, l2] == pytest.approx(masked.covariance(L, d, l2, 0), abs=0.06 * scale)
            assert beside[row, l2] == pytest.approx(masked.covariance(L, d, l2, 2), abs=0.06 * scale)
    assert (spectra.cross**2 > spectra.x * spectra.y)[:4].any()
    assert 0.1 < found.shared < 0.95
    # Two maps of odd L: of what is left of the difference of the two terms.
    for L, row in ((1, 1), (3, 5)):
        for l2 in (4, 6):
            assert variance[row, l2] == pytest.approx(masked.covariance(L, 0, l2, 0), rel=0.15)


@pytest.mark.parametrize("names", [("tilted cap", "tilted cap"), ("belt", "belt"), ("tilted cap", "belt")])
def test_variances_of_single_M_are_sums_over_covariances(names: tuple[str, str]) -> None:
    """They were means over M: errors of single modes were 0.45 to 1.54 of them, and more for asymmetric masks."""
    weights = {"tilted cap": cap(0.2 * X + 0.3 * Y + 0.9 * Z), "belt": belt(0.5 * X + 0.8 * Z)}
    x, y = (weights[name] for name in names)
    masked, l2, far = Masked(x, y), 9, 0.0
    spectra = masked.spectra()
    assert spectra.y is not None
    modes = [mode for mode in all_modes(3, both_orders=True) if mode.L > 0 and (mode.in_auto or x is not y)]
    modes = [mode for mode in modes if mode.L < 3 or abs(mode.d) == mode.M]
    apart, mean = overlap(x, y, 2, 16, 3), overlap(x, y, 2, 16)
    for shift in range(3):
        found, before = (isotropic_variance(modes, spectra, one, shift)[:, l2] for one in (apart, mean))
        l1 = np.array([l2 - mode.d for mode in modes])
        scale = mean.autos[0].sum() * spectra.x[l1] * spectra.y[l2]
        exact = np.array([masked.of_one_M(mode, l2, shift) for mode in modes])
        assert np.abs(found - exact).max() < 0.1 * scale.min()
        assert np.sqrt(np.mean(((found - exact) / scale) ** 2)) < 0.04
        far = max(far, float(np.abs((before - exact) / scale).max()))
    assert far > 0.25


def test_equal_weights_share_all_and_those_of_all_sky_are_one() -> None:
    weight = belt(Z)
    assert overlap(weight, weight, 0, 16).shared == pytest.approx(1.0, rel=1e-12)
    same = overlap(np.ones(Z.size), np.ones(Z.size), 3, 16)
    np.testing.assert_allclose(same.autos.sum(axis=1), [*FULL_SKY.autos[:, 0], 0.0, 0.0, 0.0], atol=1e-12)
    # Summed over all distances in l, of both signs, this is the usual <W^4> / <W^2>^2.
    every = overlap(weight, weight, 23, 23).autos.sum(axis=1)
    assert every[0] + 2.0 * every[1:].sum() == pytest.approx(np.mean(weight**4), rel=1e-3)


def test_covariance_of_bins_is_that_of_the_sums_of_their_coefficients() -> None:
    """Coefficients whose sign alternates as those of A^{LM} do, and which correlate up to two degrees apart."""
    modes, lmax = all_modes(1, both_orders=False), 11
    layout = Layout(1, 1, ("A",), ("A,A",), modes, lmax, False, None, frame="ecliptic", bin_width=5, filtered=False)
    rng = np.random.default_rng(2)
    mixing = np.tril(np.triu(rng.uniform(0.5, 1.0, (lmax + 1, lmax + 1))), 2).T
    covariance = mixing @ mixing.T
    weights = summary.binned(layout, np.broadcast_to(np.eye(lmax + 1)[:, None], (lmax + 1, len(modes), lmax + 1)))
    for row in range(len(modes)):
        used = np.abs(np.moveaxis(weights, 0, -1)[row])
        shifted = np.full((8, len(modes), lmax + 1), np.nan)
        for n in range(8):
            shifted[n, row, : lmax + 1 - n] = np.diag(covariance, n)
        found = summary.binned_covariance(layout, list(shifted))[row]
        np.testing.assert_allclose(found, used @ covariance @ used.T, rtol=1e-12)


def test_the_spectrum_behind_weights_is_a_sum_over_3j_symbols() -> None:
    rng = np.random.default_rng(5)
    cl, weights = rng.random(7), rng.random(9)
    expected = [
        sum(
            (2 * k + 1) * cl[k] * (2 * n + 1) * weights[n] * float(wignernj.wigner3j(ell, k, n, 0, 0, 0)) ** 2
            for k in range(7)
            for n in range(9)
        )
        for ell in range(11)
    ]
    np.testing.assert_allclose(pseudo_spectrum(cl, weights, 10), np.array(expected) / (4 * np.pi), rtol=1e-12)


@pytest.mark.parametrize(("size", "reach", "d_max"), [(5, 9, 2), (14, 20, 8), (9, 8, 2)])
def test_weights_of_few_degrees_have_bins_that_reach_further(size: int, reach: int, d_max: int) -> None:
    """ducc0 ended here with an error of its own: a field of spin n has no degrees below n."""
    weight = belt(Z)
    found = overlap(weight, weight, reach, size, d_max)
    assert found.around is not None
    known = overlap(weight, weight, min(reach, size - d_max), size, d_max)
    assert known.around is not None
    np.testing.assert_allclose(found.autos[: len(known.autos)], known.autos, atol=1e-12)
    for mode in ((0, 0, 0), (2, 0, 0), (2, 1, 2)):
        np.testing.assert_allclose(found.around.beside(mode, 0), known.around.beside(mode, 0), atol=1e-10)


def test_products_along_circles_are_those_of_their_fourier_coefficients() -> None:
    """f_{d+n} f_{d-n}, also where n is above d, of a weight without symmetry."""
    reach, d_max = 3, 1

    def weight(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return 1.0 + 0.5 * x - 0.3 * y + 0.4 * z + 0.6 * x * y - 0.5 * y * z + 0.3 * x * y * z

    harmonics = map_harmonics(weight(*np.array(healpy.pix2vec(16, np.arange(12 * 16**2)))), 3)
    found = circles((harmonics, harmonics, harmonics), 1.0, reach, d_max)
    gamma, phi = (2.0 * np.pi * np.arange(count) / count for count in (32, 64))
    n, d = np.arange(reach + 1), np.arange(d_max + 1)[:, None]
    for place, theta in enumerate(found.theta):
        south = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.full(phi.size, -np.sin(theta))])
        east = np.stack([-np.sin(phi), np.cos(phi), np.zeros(phi.size)])
        along = weight(*(south[..., None] * np.cos(gamma) + east[..., None] * np.sin(gamma)))
        f = np.fft.fft(along) / gamma.size
        # The harmonics are sums over pixels, good to a few times 1e-4.
        np.testing.assert_allclose(found.cross[..., place], np.mean(f[:, d + n] * f[:, d - n], axis=0), atol=2e-3)
