"""Closed forms of Gaussian beams against quadrature on the sphere."""

import numpy as np
import pytest
from numpy.typing import NDArray

from harmonics import legendre
from mcsim.instrument.beams import Beam
from refusals import refused

SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))


def quadrature(major: float, minor: float, angle_deg: float, lmax: int, orders: tuple[int, ...], root: bool) -> NDArray:
    """b_lm / B_0 of the beam by Gauss-Legendre in theta and the trapezoid rule in phi, shape (orders, lmax + 1)."""
    sigma_major, sigma_minor = np.radians(np.array([major, minor]) / 60) * SIGMA_PER_FWHM
    reach = min(np.pi, 9 * sigma_major)
    node, weight = np.polynomial.legendre.leggauss(400)
    theta, weight = (node + 1) * reach / 2, weight * reach / 2
    phi = np.arange(128) * 2 * np.pi / 128
    x = theta[:, None] * np.cos(phi - np.radians(angle_deg))
    y = theta[:, None] * np.sin(phi - np.radians(angle_deg))
    beam = np.exp(-(x**2) / (2 * sigma_major**2) - y**2 / (2 * sigma_minor**2))
    if root:
        beam *= np.sqrt(theta / np.sin(theta))[:, None]
    area = 2 * np.pi * weight * np.sin(theta)
    rings = np.array([(beam @ np.exp(-1j * m * phi)) / phi.size * area for m in orders])
    blm = np.array([legendre(lmax, m, theta) @ ring for m, ring in zip(orders, rings, strict=True)])
    return blm / (beam.mean(axis=1) @ area)


# The tolerances are those of the docstring's table, rounded up to the next 1, 2, 5: the error is theta^4 / 15 m^2.
@pytest.mark.parametrize(
    ("major", "minor", "lmax", "root", "tolerances"),
    [
        (13.9, 12.7, 1024, True, {0: 1e-11, 2: 1e-11, 4: 5e-11}),
        (13.9, 12.7, 1024, False, {0: 5e-7, 2: 1e-6, 4: 2e-6}),
        (60.0, 45.0, 200, True, {0: 1e-11, 2: 1e-9, 4: 1e-8}),
        (300.0, 200.0, 200, True, {0: 1e-8, 2: 5e-7, 4: 5e-6}),
        (1200.0, 800.0, 200, True, {0: 2e-6, 2: 1e-4, 4: 5e-4}),
        (1200.0, 800.0, 200, False, {0: 2e-3, 2: 5e-3, 4: 5e-3}),
    ],
)
def test_elliptical_gaussian_against_quadrature(major, minor, lmax, root, tolerances) -> None:
    beam = Beam.elliptical(major, minor, angle_deg=25.0, lmax=lmax, mmax=6)
    expected = quadrature(major, minor, 25.0, lmax, tuple(tolerances), root)
    for (m, tolerance), reference in zip(tolerances.items(), expected, strict=True):
        np.testing.assert_allclose(beam.blm[m], reference, rtol=0, atol=tolerance * np.abs(reference).max())


def test_odd_orders_and_degrees_below_m_vanish() -> None:
    blm = Beam.elliptical(20, 12, angle_deg=10, lmax=64, mmax=6).blm
    assert not blm[1::2].any()
    assert not np.tril(blm, -1).any()
    assert blm[2, 2:].all()


def test_major_axis_along_x_makes_b_l2_positive_and_along_y_negative() -> None:
    along_x = Beam.elliptical(20, 12, lmax=500, mmax=2).blm[2, 2:]
    along_y = Beam.elliptical(20, 12, angle_deg=90, lmax=500, mmax=2).blm[2, 2:]
    assert np.all(along_x.real > 0)
    np.testing.assert_allclose(along_y, -along_x, rtol=1e-13)


def test_gaussian_is_the_usual_window() -> None:
    ell = np.arange(801)
    sigma = np.radians(1.0) * SIGMA_PER_FWHM
    beam = Beam.gaussian(60.0, 800)
    np.testing.assert_allclose(beam.window, np.exp(-ell * (ell + 1) * sigma**2 / 2), rtol=1e-12)
    assert (beam.mmax, beam.neglected_power, beam.integral) == (0, 0.0, 1.0)


def test_normalisation_is_exact() -> None:
    assert Beam.elliptical(500, 100, angle_deg=33, lmax=50).window[0] == pytest.approx(1, abs=1e-15)


def test_large_degrees_neither_overflow_nor_warn() -> None:
    blm = Beam.elliptical(60, 30, lmax=6000, mmax=8).blm
    assert np.all(np.isfinite(blm))
    assert abs(blm[2, 6000]) < 1e-100


@pytest.mark.parametrize(
    ("widths", "more", "named"),
    [
        ((0.0, 0.0), {}, ("fwhm_major_arcmin", 0.0)),
        ((10.0, -1.0), {}, ("fwhm_minor_arcmin", -1.0)),
        ((float("nan"), 1.0), {}, ("fwhm_major_arcmin", "nan")),
        ((5000.0, 10.0), {}, ("fwhm_major_arcmin", 5000.0, 1200, "window")),
        ((10.0, 12.0), {}, ("fwhm_major_arcmin", 10.0, "fwhm_minor_arcmin", 12.0)),
        ((12.0, 10.0), {"angle_deg": float("inf")}, ("angle_deg", "inf")),
        ((12.0, 10.0), {"mmax": 11}, ("mmax", 11)),
        ((12.0, 10.0), {"mmax": -1}, ("mmax", -1)),
        ((12.0, 10.0), {"lmax": 0}, ("lmax", 0)),
    ],
)
def test_bad_input_is_named(widths, more, named) -> None:
    with refused(*named):
        Beam.elliptical(*widths, **({"lmax": 10} | more))
