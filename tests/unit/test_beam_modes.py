"""Modes of a beam from one map, against whole matrices and the simulator's own maps."""

import healpy
import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.simulation.beam_modes import BeamModes
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap, unit_skies
from mcsim.simulation.map_filter import MapFilter, unknown_dipole
from mcsim.sphere import healpix
from refusals import refused

NSIDE, LMAX, ORDERS = 4, 8, 2
NPIX = 12 * NSIDE**2
CL = unknown_dipole(np.append([0.0, 0.0], 3000.0 / np.arange(2, LMAX + 1.0) ** 2))
DEGREES = np.array([ell for ell, _ in unit_skies(LMAX)])


@pytest.fixture(scope="module")
def modes() -> BeamModes:
    rng = np.random.default_rng(8)
    mask = np.abs(healpy.pix2vec(NSIDE, np.arange(NPIX))[2]) > 0.2
    window = healpix.pixel_window(NSIDE, LMAX)
    response = convolve.response(Beam.gaussian(900.0, LMAX), LMAX, window)
    inverse = InverseCovariance(CL, [ObservedMap(response, rng.uniform(0.2, 5.0, NPIX) * mask / 30.0**2)], 1e-10)
    w = rng.uniform(-0.6, 0.6, (ORDERS, NPIX)) + 1j * rng.uniform(-0.6, 0.6, (ORDERS, NPIX))
    moments = Moments(NSIDE, "ecliptic", np.ones(NPIX), w)
    return BeamModes(MapFilter("map", inverse, window, LMAX), moments, ORDERS, 1)


def observed(modes: BeamModes, beta: np.ndarray) -> np.ndarray:
    """What orders b_ls = beta_ls b_l0 add to the maps of all unit skies, by the simulator, (pixel, sky)."""
    circular = modes.filter.inverse.maps[0].response.factors[0]
    response = convolve.Response(np.concatenate([np.zeros((1, LMAX + 1)), beta * circular]))
    maps = [convolve.spin_maps(sky, response, NSIDE) for _, sky in unit_skies(LMAX)]
    return np.stack([convolve.noncircular_map(one, modes.moments) for one in maps], axis=1)


@pytest.fixture(scope="module")
def matrices(modes: BeamModes) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Response, C^-1 between observed pixels, and dC of every number."""
    precision = modes.filter.inverse.precision[0]
    seen = precision > 0.0
    response = np.stack([modes.filter.inverse.observe(sky)[0] for _, sky in unit_skies(LMAX)], axis=1)[seen]
    inverse = np.linalg.inv((response * CL[DEGREES]) @ response.T + np.diag(1.0 / precision[seen]))
    changes = []
    for part in (1.0, 1j):
        for s, ell in np.argwhere(~np.isnan(modes.spectra(np.zeros(28)))):
            beta = np.zeros((ORDERS, LMAX + 1), dtype=complex)
            beta[s, ell] = part
            half = (observed(modes, beta)[seen] * CL[DEGREES]) @ response.T
            changes.append(half + half.T)
    return response, inverse, changes


def test_score_is_the_derivative_of_the_likelihood(modes: BeamModes, matrices) -> None:
    """q = y' dC y / 2, number by number."""
    _, inverse, changes = matrices
    data = np.random.default_rng(2).normal(size=NPIX) * 40.0
    y = inverse @ data[modes.filter.inverse.precision[0] > 0.0]
    expected = np.array([0.5 * y @ change @ y for change in changes])
    np.testing.assert_allclose(modes.score(data), expected, atol=1e-7 * np.abs(expected).max())


def test_mean_is_that_of_the_simulated_beam(modes: BeamModes, matrices) -> None:
    """Sign, phase and normalisation: exact mean for a slightly elliptical beam at 30 degrees, to second order."""
    response, inverse, changes = matrices
    beam = Beam.elliptical(905.0, 895.0, angle_deg=30.0, lmax=LMAX)
    beta = np.zeros((ORDERS, LMAX + 1), dtype=complex)
    beta[1] = beam.blm[2] / beam.blm[0]
    seen = modes.filter.inverse.precision[0] > 0.0
    changed = response + observed(modes, beta)[seen]
    apart = (changed * CL[DEGREES]) @ changed.T - (response * CL[DEGREES]) @ response.T
    moved = [inverse @ change for change in changes]
    mean = np.array([0.5 * np.sum(one * (inverse @ apart).T) for one in moved])
    fisher = np.array([[0.5 * np.sum(one * other.T) for other in moved] for one in moved])
    found = modes.spectra(np.linalg.solve(fisher, mean))
    np.testing.assert_allclose(found[:, 2:], beta[:, 2:], rtol=0.02, atol=0.01 * np.abs(beta).max())


def test_random_maps_estimate_the_fisher_matrix(modes: BeamModes, matrices) -> None:
    """Diagonal within 5 standard deviations of the estimate, that of a U-statistic of 40 maps."""
    _, inverse, changes = matrices
    number = 40
    found = np.diag(modes.fisher([modes.probe(k) for k in range(number)]))
    for value, change in zip(found, changes, strict=True):
        moved = inverse @ change
        expected = 0.5 * np.trace(moved @ moved)
        # (y' dC z)^2 / 2: its mean for given y is y' dC C^-1 dC y / 2
        given = 2.0 * np.trace(moved @ moved @ moved @ moved) / 4.0
        variance = 4.0 * given / number + 2.0 * expected**2 / (number * (number - 1) / 2)
        assert abs(value - expected) < 5.0 * np.sqrt(variance)


def test_moments_that_do_not_fit_are_refused(modes: BeamModes) -> None:
    with refused("orders", 3):
        BeamModes(modes.filter, modes.moments, 3, 1)
