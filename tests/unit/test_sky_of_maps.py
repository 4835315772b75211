"""The sky of maps with holes: it makes them again, and is no larger than it must be where they hide it."""

import healpy
import numpy as np
import pytest

import mcsim
from mcsim.comparison.scene import Scene
from mcsim.comparison.sky_of_maps import TRUSTED, sky_in
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


def _left(scene: Scene, sky: np.ndarray, seen: np.ndarray) -> float:
    """Return what the simulation of a sky leaves of the scene's maps where they are seen, over their rms."""
    rest = (scene.maps() - Scene(sky, scene.beam, scene.window, scene.moments).maps())[seen]
    return float(rest.std() / scene.maps()[seen].std())
