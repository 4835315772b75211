import itertools

import healpy
import numpy as np
import pytest
from astropy.io import fits

from mcsim.sphere import healpix
from mcsim.sphere.sky import gaussian_alm
from refusals import refused


def smooth_sky(lmax: int) -> np.ndarray:
    ell = np.arange(lmax + 1)
    return gaussian_alm(1.0 / (ell + 1.0) ** 2, np.random.default_rng(5))


def error(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt(np.sum(np.abs(found - true) ** 2) / np.sum(np.abs(true) ** 2)))


@pytest.mark.parametrize("nside", [1, 2, 32])
@pytest.mark.parametrize("iterations", [0, 2])
def test_analysis_is_that_of_healpy(nside: int, iterations: int) -> None:
    lmax = 2 * nside
    sky = smooth_sky(lmax)
    map_ = healpix.synthesis(sky[None], nside, lmax)[0]
    np.testing.assert_allclose(map_, healpy.alm2map(sky, nside, lmax=lmax), atol=1e-12)
    expected = healpy.map2alm(map_, lmax, iter=iterations, use_weights=nside > 1)
    assert error(healpix.analysis(map_, lmax, iterations), expected) < 1e-12


def test_every_iteration_gains_a_decade() -> None:
    nside, lmax = 64, 128
    sky = smooth_sky(lmax)
    map_ = healpix.synthesis(sky[None], nside, lmax)[0]
    errors = [error(healpix.analysis(map_, lmax, n), sky) for n in range(4)]
    assert errors[0] < 1e-3
    assert all(after < before / 10 for before, after in itertools.pairwise(errors))


def test_gradient_against_finite_differences() -> None:
    nside, lmax, step = 16, 20, 1e-6
    sky = smooth_sky(lmax)
    theta, phi = healpy.pix2ang(nside, np.arange(12 * nside**2))
    found = healpix.gradient(sky, nside, lmax)

    def at(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
        import ducc0

        points = np.stack([theta, phi], axis=1)
        return ducc0.sht.synthesis_general(alm=sky[None], lmax=lmax, spin=0, loc=points, epsilon=1e-13, nthreads=1)[0]

    south = (at(theta + step, phi) - at(theta - step, phi)) / (2 * step)
    east = (at(theta, phi + step) - at(theta, phi - step)) / (2 * step * np.sin(theta))
    np.testing.assert_allclose(found[0], south, atol=1e-5)
    np.testing.assert_allclose(found[1], east, atol=1e-5)


def test_pixel_window_against_the_power_of_pixels() -> None:
    """w_l^2 is the mean over pixels of 4 pi / (2l+1) sum_m |w_lm|^2, here of indicators on a grid 64 times finer."""
    nside, fine, lmax = 2, 128, 6
    ratio = (fine // nside) ** 2
    power = np.zeros(lmax + 1)
    for pixel in range(12 * nside**2):
        indicator = np.zeros(12 * fine**2)
        inside = np.arange(pixel * ratio, (pixel + 1) * ratio)
        indicator[healpy.nest2ring(fine, inside)] = 12 * nside**2 / (4 * np.pi)
        power += 4 * np.pi * healpy.anafast(indicator, lmax=lmax, iter=0) / (12 * nside**2)
    ell = np.arange(lmax + 1)
    fine_window = 1 - ell * (ell + 1) * (4 * np.pi / (12 * fine**2)) / 24
    found, expected = healpix.pixel_window(nside, lmax), np.sqrt(power) * fine_window
    # What the extrapolation in the sub-pixels leaves grows as l^4.
    np.testing.assert_allclose(found[:5], expected[:5], rtol=1e-4)
    np.testing.assert_allclose(found[5:], expected[5:], rtol=4e-4)


def test_a_pixel_window_is_the_same_from_the_cache_and_without_one(tmp_path, monkeypatch) -> None:
    def window() -> np.ndarray:
        healpix.pixel_window.cache_clear()
        healpix._distances.cache_clear()
        return healpix.pixel_window(4, 12)

    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path / "cache"))
    first = window()
    assert len(list((tmp_path / "cache").glob("pixels-*"))) == 4  # two faces, each with two sizes of sub-pixels
    monkeypatch.setattr(healpix, "_histogram", None)  # nothing is computed again
    np.testing.assert_array_equal(window(), first)
    monkeypatch.undo()
    (tmp_path / "file").touch()
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path / "file"))
    np.testing.assert_array_equal(window(), first)


def test_read_pixel_window(tmp_path) -> None:
    path = tmp_path / "window.fits"
    column = fits.Column("TEMPERATURE", "D", array=np.linspace(1, 0.5, 11))
    fits.BinTableHDU.from_columns([column]).writeto(path)
    np.testing.assert_allclose(healpix.read_pixel_window(path, 5), np.linspace(1, 0.5, 11)[:6])
    with refused("window.fits", 10, "lmax", 20, "longer"):
        healpix.read_pixel_window(path, 20)
    np.save(tmp_path / "negative.npy", -np.linspace(1, 0.5, 11))
    with refused("negative.npy", -1, "sign"):
        healpix.read_pixel_window(tmp_path / "negative.npy", 5)
    with refused("missing.fits"):
        healpix.read_pixel_window(tmp_path / "missing.fits", 20)
    path.write_text("not FITS")
    with refused("window.fits"):
        healpix.read_pixel_window(path, 5)


@pytest.mark.parametrize("spin", [0, 2])
def test_rings_that_are_made_alone_are_those_of_the_whole_map(spin: int) -> None:
    sky = np.stack([smooth_sky(16)] * (2 if spin else 1))
    rings = healpix.rings_between(8, 1.0, 1.3)
    where = healpix.geometry(8)
    assert where["theta"][rings.start] < 1.0 < 1.3 < where["theta"][rings.stop - 1]
    first, last = where["ringstart"][[rings.start, rings.stop]]
    whole = healpix.synthesis(sky, 8, 16, spin)
    np.testing.assert_allclose(healpix.synthesis(sky, 8, 16, spin, rings=rings), whole[:, first:last], atol=1e-13)
