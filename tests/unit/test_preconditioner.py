"""The preconditioner of the inverse covariance: its Laplacian, its symmetry, and the iterations that it leaves."""

import healpy
import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.simulation import convolve
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap, product, unit_skies
from mcsim.simulation.preconditioner import Preconditioner, laplacian
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix

NSIDE, LMAX = 32, 64
CL = np.append([0.0, 0.0], 6000.0 / np.arange(2.0, LMAX + 1) ** 2)
Z = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]


@pytest.mark.parametrize("ell", [2, 4, 12])
def test_laplacian_has_the_spectrum_of_the_sphere(ell: int) -> None:
    """On average over the orders; it is off by up to 7 per cent, because pixels are no squares."""
    matrix = laplacian(NSIDE, np.arange(12 * NSIDE**2))
    alm = np.where(alm_.degrees(ell) == ell, 1.0 + 1.0j, 0.0) / np.where(alm_.orders(ell) == 0, 1.0, np.sqrt(2.0))
    field = healpix.synthesis(alm[None], NSIDE, ell)[0]
    assert (field @ matrix @ field) / (field @ field) == pytest.approx(ell * (ell + 1.0), rel=0.1)


def test_laplacian_of_some_pixels_holds_the_others_at_zero() -> None:
    some = np.flatnonzero(np.abs(Z) < 0.2)
    whole, part = laplacian(NSIDE, np.arange(12 * NSIDE**2)), laplacian(NSIDE, some)
    assert np.abs(part - whole[some][:, some]).max() < 1e-9 * np.abs(whole).max()
    assert np.abs(part - part.T).max() == 0.0


@pytest.mark.parametrize(("hidden", "most"), [(0.0, 8), (0.25, 21)])
def test_few_iterations_are_left(hidden: float, most: int) -> None:
    """S/N in power from 150,000 to one half, noise that differs ninefold; 17 and 433 by the diagonal."""
    precision = (1.0 + 8.0 * Z**4) * (np.abs(Z) >= hidden) / 5.0**2
    response = convolve.response(Beam.gaussian(300.0, LMAX), LMAX)
    inverse = InverseCovariance(CL, [ObservedMap(response, precision)], 1e-6)
    data = inverse.draw("iterations", 0)
    assert inverse.iterations(inverse.adjoint(inverse.precision * data)) <= most


@pytest.mark.parametrize(("monopole", "dipole"), [(1e-3, 1e-7), (0.0, 1e-3), (1e-3, 0.0), (30.0, 20.0)])
def test_a_faint_monopole_and_dipole_cost_no_iterations(monopole: float, dipole: float) -> None:
    """As noise has that is not white, where it stands as a sky of its own beside the sky: powers of it over noise.

    They were taken for modes of a bright sky, and of the inverse 650 times too large: rounding grew in the iterations
    to several standard deviations of a matched filter.
    """
    faint, precision = CL.copy(), (1.0 + 8.0 * Z**4) * (np.abs(Z) >= 0.25) / 5.0**2
    faint[:2] = np.array([monopole, dipole]) * 4.0 * np.pi / precision.sum()
    response = convolve.response(Beam.gaussian(300.0, LMAX), LMAX)
    known, inverse = (InverseCovariance(cl, [ObservedMap(response, precision)], 1e-6) for cl in (CL, faint))
    weighted = [one.adjoint(one.precision * one.draw("iterations", 0)) for one in (known, inverse)]
    assert inverse.iterations(weighted[1]) <= known.iterations(weighted[0]) + 2
    near, nudged = (inverse.approach(scale * weighted[1], 1e-3, 30) for scale in (1.0, 1.0 + 1e-10))
    assert np.linalg.norm(nudged - near) < 2e-10 * np.linalg.norm(near)


@pytest.mark.parametrize("lowest", [(3.0, 5.0), (0.0, 5.0), (3.0, 0.0), (0.0, 0.0), (1e4, 2e4)])
def test_without_a_mask_the_inverse_is_exact(lowest: tuple[float, float]) -> None:
    """Within the quadrature of its pixels; elements over those of the diagonal of the true one."""
    gain = np.array([*lowest, 900.0, 300.0, 100.0, 30.0])
    approximate = Preconditioner(gain, np.ones(768))
    skies = [(np.sqrt(1.0 + gain[ell]), sky) for ell, sky in unit_skies(5) if gain[ell]]
    matrix = [[a * b * product(approximate.apply(x), y, 5) for a, x in skies] for b, y in skies]
    np.testing.assert_allclose(matrix, np.eye(len(skies)), atol=0.05)


@pytest.mark.parametrize("lowest", [None, (0.0, 0.0), (0.0, 0.1), (3.0, 0.01)])
def test_preconditioner_is_symmetric_and_positive(lowest: tuple[float, float] | None) -> None:
    """With a monopole and a dipole, without, and with faint ones."""
    lmax = 5
    gain, first = 1e4 / np.arange(1.0, lmax + 2) ** 3, 0 if lowest is None else 2
    gain[:first] = [] if lowest is None else lowest
    precision = np.where(np.abs(healpy.pix2vec(8, np.arange(768))[2]) < 0.3, 0.0, 1.0)
    precision[100:140] = 0.2  # a soft edge
    approximate = Preconditioner(gain, precision)
    skies = [sky for ell, sky in unit_skies(lmax) if gain[ell]]
    matrix = np.array([[product(approximate.apply(x), y, lmax) for y in skies] for x in skies])
    np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-12 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix).min() > 0.0
