"""The sky of maps with holes: it makes them again, and is no larger than it must be where they hide it."""

import healpy
import numpy as np
import pytest

import mcsim
from mcsim.comparison.scene import Scene
from mcsim.comparison.sky_of_maps import TRUSTED, averaged, mean_map, sky_in
from mcsim.sphere import healpix

NSIDE, LMAX = 16, 32


@pytest.fixture(scope="module")
def scene() -> Scene:
    power = 1e4 / np.maximum(np.arange(LMAX + 1.0), 2.0) ** 2
    draw = np.random.default_rng(5)
    size = healpy.Alm.getsize(LMAX)
    sky = healpy.almxfl((draw.standard_normal(size) + 1j * draw.standard_normal(size)) / np.sqrt(2.0), np.sqrt(power))
    sky[: LMAX + 1] = np.sqrt(2.0) * sky[: LMAX + 1].real
    beam = mcsim.Beam.elliptical(500.0, 400.0, lmax=LMAX, mmax=2)
    return Scene(sky, beam, healpix.pixel_window(NSIDE, LMAX), (mcsim.Moments.parallel_transport(NSIDE, 30.0, 2),))


@pytest.fixture(scope="module")
def seen() -> np.ndarray:
    return (healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2] > -0.2)[None]


def test_holes_hide_no_more_than_the_power_of_the_sky(scene, seen):
    """A sky that makes up for what moments miss may be anything where it is hidden."""
    maps = scene.maps() * (1.0 + 0.5 * TRUSTED * np.random.default_rng(6).standard_normal((1, 12 * NSIDE**2)))
    found = sky_in(maps, seen, scene)
    assert np.linalg.norm(found) < 1.05 * np.linalg.norm(scene.sky)
    assert _left(scene, found, seen) < TRUSTED


def test_a_sky_is_corrected_for_what_is_missing_beside_it(scene, seen):
    less = 0.9 * scene.sky
    found = sky_in(0.1 * scene.maps(), seen, scene, beside=less)
    assert _left(scene, less + found, seen) < TRUSTED
    assert np.linalg.norm(less + found) < 1.05 * np.linalg.norm(scene.sky)


@pytest.mark.parametrize("lmax", [2, 3])
def test_skies_of_few_degrees_are_found_behind_holes(seen, lmax):
    """Power is averaged over five degrees: of fewer there was no average of the same length."""
    sky = (1.0 + np.arange(healpy.Alm.getsize(lmax))).astype(complex)
    beam, window = mcsim.Beam.gaussian(500.0, lmax), healpix.pixel_window(NSIDE, lmax)
    few = Scene(sky, beam, window, (mcsim.Moments.parallel_transport(NSIDE, 30.0, 2),))
    assert _left(few, sky_in(few.maps(), seen, few), seen) < TRUSTED


def test_power_is_averaged_over_the_nearest_degrees():
    assert np.allclose(averaged(np.array([5.0, 10.0, 15.0, 20.0])), [6.0, 10.0, 10.0, 9.0])
    power = np.random.default_rng(7).random(40)
    assert np.allclose(averaged(power)[2:-2], [power[k : k + 5].mean() for k in range(36)])


def _left(scene: Scene, sky: np.ndarray, seen: np.ndarray) -> float:
    """Return what the simulation of a sky leaves of the scene's maps where they are seen, over their rms."""
    rest = (scene.maps() - Scene(sky, scene.beam, scene.window, scene.moments).maps())[seen]
    return float(rest.std() / scene.maps()[seen].std())


def test_the_mean_of_maps_is_that_of_those_that_see_a_pixel():
    maps = np.array([[1.0, 2.0, 5.0, 7.0], [3.0, -9.0, 5.0, 8.0]])
    seen = np.array([[True, True, False, False], [True, False, True, False]])
    assert mean_map(maps, seen).tolist() == [2.0, 2.0, 5.0, 0.0]
