"""Spin-moment maps against ducc0.totalconvolve, which evaluates sample by sample by another algorithm."""

import ducc0
import healpy
import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.sky import gaussian_alm

NSIDE, LMAX, MMAX, SAMPLES = 32, 256, 4, 5


@pytest.fixture(scope="module")
def beam() -> Beam:
    """Complex b_lm of every order up to 4, of a size that makes each matter."""
    rng = np.random.default_rng(3)
    ell = np.arange(LMAX + 1)
    blm = np.zeros((MMAX + 1, LMAX + 1), complex)
    for m in range(MMAX + 1):
        phase = np.exp(2j * np.pi * rng.random(LMAX + 1)) if m else 1.0
        blm[m] = np.where(
            ell >= m, np.sqrt((2 * ell + 1) / (4 * np.pi)) * np.exp(-((ell / 150.0) ** 2)) / (1 + m) * phase, 0
        )
    return Beam(blm)


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    ell = np.arange(LMAX + 1)
    return gaussian_alm(1.0 / (1.0 + ell) ** 2, np.random.default_rng(4))


@pytest.fixture(scope="module")
def psi() -> np.ndarray:
    return np.random.default_rng(5).uniform(0, 2 * np.pi, (SAMPLES, 12 * NSIDE**2))


def moments(psi: np.ndarray, smax: int) -> Moments:
    w = np.array([np.mean(np.exp(-1j * s * psi), axis=0) for s in range(1, smax + 1)])
    return Moments(nside=NSIDE, frame="ecliptic", hits=np.full(psi.shape[1], float(len(psi))), w=w)


def totalconvolve(sky: np.ndarray, blm: np.ndarray, theta: np.ndarray, phi: np.ndarray, psi: np.ndarray) -> np.ndarray:
    mmax = blm.shape[0] - 1
    packed = np.concatenate([blm[m, m:] for m in range(mmax + 1)])
    interpolator = ducc0.totalconvolve.Interpolator(
        sky[None], packed[None], separate=False, lmax=LMAX, kmax=mmax, epsilon=1e-13, nthreads=1
    )
    return interpolator.interpol(np.stack([theta, phi, psi], axis=1))[0]


def test_map_is_the_mean_of_its_samples(beam: Beam, sky: np.ndarray, psi: np.ndarray) -> None:
    theta, phi = healpy.pix2ang(NSIDE, np.arange(psi.shape[1]))
    expected = np.mean([totalconvolve(sky, beam.blm, theta, phi, angle) for angle in psi], axis=0)
    response = convolve.response(beam, LMAX)
    found = convolve.circular_map(sky, response, NSIDE)
    found = found + convolve.noncircular_map(convolve.spin_maps(sky, response, NSIDE), moments(psi, MMAX))
    assert np.std(found - expected) / np.std(expected) < 1e-12


@pytest.mark.parametrize("s", [1, 2, 3])
def test_sign_of_every_order(s: int, beam: Beam, sky: np.ndarray, psi: np.ndarray) -> None:
    """One order at a time, so that two wrong signs cannot cancel."""
    blm = np.zeros_like(beam.blm)
    blm[s] = beam.blm[s]
    theta, phi = healpy.pix2ang(NSIDE, np.arange(psi.shape[1]))
    expected = totalconvolve(sky, blm[: s + 1], theta, phi, psi[0])
    maps = convolve.spin_maps(sky, convolve.response(Beam(blm[: s + 1]), LMAX), NSIDE)
    found = convolve.noncircular_map(maps, moments(psi[:1], s))
    assert np.std(found - expected) / np.std(expected) < 1e-12


def test_circular_part_is_the_beam_window(beam: Beam, sky: np.ndarray) -> None:
    found = convolve.circular_map(sky, convolve.response(beam, LMAX), NSIDE)
    expected = healpy.alm2map(alm_.multiply(sky, beam.window, LMAX), NSIDE, lmax=LMAX)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_beam_turned_against_the_scan_cancels(beam: Beam, sky: np.ndarray, psi: np.ndarray) -> None:
    """A beam rotated by +a and samples rotated by -a give the same map."""
    angle = 0.7
    turned = Beam(beam.blm * np.exp(-1j * angle * np.arange(MMAX + 1))[:, None])
    first = convolve.noncircular_map(convolve.spin_maps(sky, convolve.response(beam, LMAX), NSIDE), moments(psi, MMAX))
    second = convolve.noncircular_map(
        convolve.spin_maps(sky, convolve.response(turned, LMAX), NSIDE), moments(psi - angle, MMAX)
    )
    np.testing.assert_allclose(second, first, atol=1e-12 * np.std(first))


def test_pixel_window_multiplies_every_order(beam: Beam) -> None:
    window = np.linspace(1.0, 0.5, LMAX + 1)
    found = convolve.response(beam, LMAX, window).factors
    np.testing.assert_allclose(found, convolve.response(beam, LMAX).factors * window)


def test_centroid_is_the_first_order_of_a_shift(sky: np.ndarray) -> None:
    """Samples displaced by d inside the pixels: d . grad T against the sky evaluated there, to second order in d."""
    rng = np.random.default_rng(6)
    npix, step = 12 * NSIDE**2, 1e-4
    d = step * rng.normal(size=(2, npix))
    theta, phi = healpy.pix2ang(NSIDE, np.arange(npix))
    smooth = alm_.multiply(sky, np.exp(-((np.arange(LMAX + 1) / 60.0) ** 2)), LMAX)
    moved = np.stack([theta + d[0], (phi + d[1] / np.sin(theta)) % (2 * np.pi)], axis=1)
    at_sample = ducc0.sht.synthesis_general(alm=smooth[None], lmax=LMAX, spin=0, loc=moved, epsilon=1e-13, nthreads=1)[
        0
    ]
    centre = healpix.synthesis(smooth[None], NSIDE, LMAX)[0]
    placed = Moments(NSIDE, "ecliptic", np.ones(npix), np.zeros((1, npix), complex), d[0], d[1])
    found = convolve.centroid_map(healpix.gradient(smooth, NSIDE, LMAX), placed)
    first_order, second_order = np.std(at_sample - centre), np.std(at_sample - centre - found)
    # The neglected term is of relative size l d / 2 with l ~ 60.
    assert second_order < 60 * step * first_order


def test_adjoint_of_the_turned_map(beam: Beam, sky: np.ndarray, psi: np.ndarray) -> None:
    weight = np.random.default_rng(5).normal(size=12 * NSIDE**2)
    response, scanned = convolve.response(beam, LMAX), moments(psi, MMAX)
    maps = convolve.spin_maps(sky, response, NSIDE)
    found = sum(2.0 * np.sum(convolve.turned([(weight, scanned)], s) * map_) for s, map_ in maps.items())
    assert found == pytest.approx(weight @ convolve.noncircular_map(maps, scanned), rel=1e-12)
    both = convolve.turned([(weight, scanned), (weight**2, scanned)], 2)
    assert both == pytest.approx(convolve.turned([(weight + weight**2, scanned)], 2), abs=1e-12)


def test_channels_with_equal_beams_share_their_transforms(sky: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    synthesis = healpix.synthesis
    monkeypatch.setattr(healpix, "synthesis", lambda *a, **k: made.append(1) or synthesis(*a, **k))
    maps, slope = convolve.CircularMaps(NSIDE, LMAX), healpix.gradient(sky, NSIDE, LMAX)
    made.clear()
    first = maps.map(sky)
    np.testing.assert_array_equal(maps.map(sky.copy()), first)
    np.testing.assert_array_equal([maps.gradient(sky), maps.gradient(sky.copy())], [slope, slope])
    assert len(made) == 2
    np.testing.assert_allclose(maps.map(2.0 * sky), 2.0 * first, rtol=1e-12, atol=1e-12 * np.abs(first).max())
    np.testing.assert_allclose(maps.gradient(2.0 * sky), 2.0 * slope, rtol=1e-9)
    assert len(made) == 4
