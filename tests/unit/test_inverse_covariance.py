"""The inverse covariance of maps that share a sky, against matrices that are written out."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve, inverse_covariance
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap, product
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from refusals import refused

NSIDE, LMAX = 8, 14
CL = np.append([0.0, 0.0], 3000.0 / np.arange(2, LMAX + 1.0) ** 2)


def basis(lmax: int) -> np.ndarray:
    """Real orthonormal basis of skies as coefficients, shape ((lmax + 1)^2, size)."""
    found = []
    for index, m in enumerate(alm_.orders(lmax)):
        for value in (1.0,) if m == 0 else (np.sqrt(0.5), 1j * np.sqrt(0.5)):
            alm = np.zeros(alm_.size(lmax), dtype=complex)
            alm[index] = value
            found.append(alm)
    return np.stack(found)


def maps_with_everything(rng: np.random.Generator) -> list[ObservedMap]:
    """Two channels, one with two splits: a mask, uneven noise, orders of the beam, centroids."""
    npix = 12 * NSIDE**2
    lat = np.arcsin(healpy.pix2vec(NSIDE, np.arange(npix))[2])
    mask = np.abs(np.rad2deg(lat)) > 12.0
    elliptical = convolve.response(Beam.elliptical(900.0, 600.0, angle_deg=20.0, lmax=LMAX), LMAX)
    round_beam = convolve.response(Beam.gaussian(500.0, LMAX), LMAX)
    size = elliptical.mmax
    w = rng.uniform(-0.6, 0.6, (size, npix)) + 1j * rng.uniform(-0.6, 0.6, (size, npix))
    moments = Moments(
        NSIDE, "ecliptic", np.ones(npix), w, rng.uniform(-0.03, 0.03, npix), rng.uniform(-0.03, 0.03, npix)
    )
    other = replace(moments, w=w.conj(), dtheta=None, dphi=None)
    weights = [rng.uniform(0.2, 5.0, npix) * mask, rng.uniform(0.2, 5.0, npix), rng.uniform(0.1, 2.0, npix) * mask]
    return [
        ObservedMap(elliptical, weights[0] / 10.0**2, moments),
        ObservedMap(elliptical, weights[1] / 10.0**2, other),
        ObservedMap(round_beam, weights[2] / 10.0**2, replace(moments, w=moments.w[:1])),
    ]


@pytest.fixture(scope="module")
def case() -> tuple[InverseCovariance, np.ndarray, np.ndarray]:
    """Filter, its response to every unit sky as a matrix over observed pixels, and which these are."""
    maps = maps_with_everything(np.random.default_rng(3))
    filtered = InverseCovariance(CL, maps, tolerance=1e-10)
    matrix = np.stack([filtered.observe(sky).ravel() for sky in basis(LMAX)], axis=1)
    return filtered, matrix, filtered.precision.ravel() > 0


def test_response_is_that_of_the_simulation(case) -> None:
    filtered, *_ = case
    sky = gaussian_alm(CL, np.random.default_rng(1))
    for m, found in zip(filtered.maps, filtered.observe(sky), strict=True):
        circular = convolve.circular_alm(sky, m.response)
        expected = healpy.alm2map(circular, NSIDE, lmax=LMAX)
        if m.moments.dtheta is not None:
            *_, dtheta, dphi = (None, *healpy.alm2map_der1(circular, NSIDE, lmax=LMAX)[1:])
            expected = expected + m.moments.dtheta * dtheta + m.moments.dphi * dphi
        spins = convolve.spin_maps(sky, m.response, NSIDE)
        expected = expected + convolve.noncircular_map({s: spins[s] for s in m.spins}, m.moments)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_adjoint_has_the_same_products(case) -> None:
    filtered, *_ = case
    rng = np.random.default_rng(2)
    maps, sky = rng.normal(size=filtered.precision.shape), gaussian_alm(CL + 1.0, rng)
    expected = float(np.sum(maps * filtered.observe(sky)))
    assert product(filtered.adjoint(maps), sky, LMAX) == pytest.approx(expected, rel=1e-11)


def test_inverse_equals_a_dense_solve(case) -> None:
    """C = P S P^t + N over observed pixels, S diagonal in unit skies of degree l."""
    filtered, matrix, seen = case
    power = np.repeat(CL[alm_.degrees(LMAX)], np.where(alm_.orders(LMAX) == 0, 1, 2))
    response = matrix[seen]
    covariance = (response * power) @ response.T + np.diag(1.0 / filtered.precision.ravel()[seen])
    data = np.random.default_rng(5).normal(size=filtered.precision.shape) * 60.0
    expected = np.linalg.solve(covariance, data.ravel()[seen])
    found = filtered.apply(data).ravel()
    assert not found[~seen].any()
    np.testing.assert_allclose(found[seen], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    found_sky = filtered.wiener(data)
    sky = np.array([product(found_sky, one, LMAX) for one in basis(LMAX)])
    np.testing.assert_allclose(sky, power * (response.T @ expected), rtol=0, atol=1e-6 * np.abs(sky).max())


def test_what_was_subtracted_has_no_weight(case) -> None:
    """It equals noise of 10 mK in each template, and maps that differ by templates are the same."""
    filtered, matrix, seen = case
    templates = np.stack([np.ones(12 * NSIDE**2), *healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))])
    own = [replace(one, templates=templates) if i != 1 else one for i, one in enumerate(filtered.maps)]
    without = InverseCovariance(CL, own, tolerance=1e-12)
    power = np.repeat(CL[alm_.degrees(LMAX)], np.where(alm_.orders(LMAX) == 0, 1, 2))
    covariance = (matrix * power) @ matrix.T + np.diag(1.0 / np.where(seen, filtered.precision.ravel(), 1.0))
    for i in (0, 2):
        own_pixels = slice(i * templates.shape[1], (i + 1) * templates.shape[1])
        covariance[own_pixels, own_pixels] += 1e8 * templates.T @ templates
    data = np.random.default_rng(5).normal(size=filtered.precision.shape) * 60.0
    expected = np.linalg.solve(covariance[np.ix_(seen, seen)], data.ravel()[seen])
    found = without.apply(data)
    np.testing.assert_allclose(found.ravel()[seen], expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    moved = data + np.array([[100.0], [0.0], [30.0]]) * templates[1]
    np.testing.assert_allclose(without.apply(moved), found, rtol=0, atol=1e-6 * np.abs(found).max())
    assert np.abs(found - filtered.apply(data)).max() > 0.01 * np.abs(found).max()


def test_filter_of_uniform_noise_is_the_isotropic_one() -> None:
    """s^ = C_l B_l / (C_l B_l^2 + N_l) a_lm where the pixels' own quadrature is as good as that of a weight."""
    beam = convolve.response(Beam.gaussian(900.0, LMAX), LMAX)
    noise_power = 20.0
    precision = np.full(12 * 16**2, healpy.nside2pixarea(16) / noise_power)
    filtered = InverseCovariance(CL, [ObservedMap(beam, precision)])
    alm = gaussian_alm(CL, np.random.default_rng(9))
    found = filtered.wiener(filtered.observe(alm))
    b = beam.factors[0].real
    expected = alm_.multiply(alm, CL * b**2 / (CL * b**2 + noise_power), LMAX)
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


def test_draws_are_zero_where_nothing_is_observed(case) -> None:
    filtered, _, _ = case
    drawn = filtered.draw("any", 0)
    np.testing.assert_array_equal(drawn != 0.0, filtered.precision > 0.0)


def test_iterations_begin_at_what_is_near(case, monkeypatch) -> None:
    """At the solution itself they end at once: maps are made once, to see what is left of the system."""
    filtered, _, _ = case
    weighted = filtered.adjoint(filtered.weighted(filtered.draw("near", 0)))
    seen, observe, found = [], filtered.observe, filtered.solve(weighted)
    monkeypatch.setattr(filtered, "observe", lambda sky: seen.append(sky) or observe(sky))
    again = filtered.solve(weighted, found)
    assert len(seen) == 1
    np.testing.assert_allclose(again, found, rtol=0, atol=1e-9 * np.abs(found).max())


def test_what_does_not_converge_is_no_result(case, monkeypatch) -> None:
    filtered, _, _ = case
    weighted = filtered.adjoint(filtered.weighted(filtered.draw("far", 0)))
    monkeypatch.setattr(inverse_covariance, "ITERATIONS", 3)
    with refused(3):
        filtered.solve(weighted)


def test_an_approach_does_not_jump_between_maps(case) -> None:
    """Some maps need one more iteration for the tolerance than others; on the way between them all have the same."""
    filtered, _, _ = case
    few, more = (filtered.adjoint(filtered.precision * filtered.draw("way", number)) for number in (0, 7))
    found = np.stack([filtered.approach((1.0 - t) * few + t * more, 1.0, 30) for t in np.linspace(0.0, 1.0, 101)])
    steps, bends = (np.linalg.norm(np.diff(found, n, axis=0), axis=1) for n in (1, 2))
    assert bends.max() < 0.02 * steps.min()


def test_bad_input_is_refused() -> None:
    beam = convolve.response(Beam.gaussian(900.0, LMAX), LMAX)
    with refused():
        InverseCovariance(CL, [])
    with refused(0):
        InverseCovariance(CL, [ObservedMap(beam, np.zeros(12 * NSIDE**2))])
    with refused(LMAX, 10):
        InverseCovariance(CL[:11], [ObservedMap(beam, np.ones(12 * NSIDE**2))])
