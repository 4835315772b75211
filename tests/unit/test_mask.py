"""Masks from files: resolution, frame, soft edges."""

import healpy
import numpy as np
import pytest

from mcsim.sphere import mask, rotation
from refusals import refused


def band(nside: int, half_width_deg: float = 20.0) -> np.ndarray:
    """1 outside a band about the equator."""
    theta, _ = healpy.pix2ang(nside, np.arange(12 * nside**2))
    return (np.abs(np.pi / 2 - theta) > np.deg2rad(half_width_deg)).astype(float)


@pytest.fixture
def write(tmp_path):
    def to_file(values: np.ndarray, **options):
        healpy.write_map(tmp_path / "mask.fits", values, dtype=np.float64, overwrite=True, **options)
        return tmp_path / "mask.fits"

    return to_file


def test_as_it_is(write):
    values = np.random.default_rng(1).uniform(size=12 * 8**2)
    np.testing.assert_array_equal(mask.read_mask(write(values), 8), values)
    nested = healpy.reorder(values, r2n=True)
    np.testing.assert_array_equal(mask.read_mask(write(nested, nest=True), 8), values)


def test_a_kept_mask_is_read_again_once_its_file_is_another(write):
    path = write(np.ones(48))
    first = mask.kept_mask(path, 2, "ecliptic")
    assert mask.kept_mask(path, 2, "ecliptic") is first
    assert not first.flags.writeable
    assert np.array_equal(first, mask.read_mask(path, 2))
    soft = mask.kept_mask(path, 4, "ecliptic", None, 5.0)
    assert soft.shape == (192,)
    path = write(np.append(np.zeros(100), np.ones(92)))
    assert mask.kept_mask(path, 2, "ecliptic").min() == 0.0


def test_another_resolution(write):
    """Finer maps see the coarse pixel that they lie in; coarser ones the mean of the fine pixels in them."""
    path = write(band(8))
    fine = mask.read_mask(path, 32)
    centres = np.stack(healpy.pix2vec(32, np.arange(fine.size)))
    np.testing.assert_array_equal(fine, band(8)[healpy.vec2pix(8, *centres)])
    coarse = mask.read_mask(path, 4)
    children = healpy.nest2ring(8, 4 * healpy.ring2nest(4, np.arange(192))[:, None] + np.arange(4))
    np.testing.assert_allclose(coarse, band(8)[children].mean(axis=1), atol=1e-15)
    assert np.any((coarse > 0.0) & (coarse < 1.0))


@pytest.mark.parametrize("nside", [16, 32, 64])
def test_another_frame(write, nside):
    """A Galactic cut in an ecliptic map: pixels by their Galactic latitude, but for those that the edge cuts."""
    found = mask.read_mask(write(band(32)), nside, "ecliptic", "galactic")
    centres = np.stack(healpy.pix2vec(nside, np.arange(found.size)))
    galactic = rotation.rotation_matrix("ecliptic", "galactic") @ centres
    latitude = np.rad2deg(np.arcsin(galactic[2]))
    inside, outside = np.abs(latitude) < 15.0, np.abs(latitude) > 25.0
    assert np.all(found[inside] == 0.0)
    assert np.all(found[outside] == 1.0)
    # A band of 20 degrees on either side of the equator is sin(20 deg) of the sky.
    assert abs(found.mean() - (1.0 - np.sin(np.deg2rad(20.0)))) < 0.01
    np.testing.assert_array_equal(mask.read_mask(write(band(nside)), nside, "galactic", "galactic"), band(nside))


def test_frame_that_the_file_states(write):
    path = write(band(32), coord="G")
    np.testing.assert_array_equal(
        mask.read_mask(path, 32, "ecliptic"), rotation.rotate_pixels(band(32), "galactic", "ecliptic")
    )
    np.testing.assert_array_equal(mask.read_mask(path, 32, "galactic", "galactic"), band(32))
    with refused("mask.fits", "galactic", "map.mask_frame", "ecliptic"):
        mask.read_mask(path, 32, "ecliptic", "ecliptic")


def brute_force_distance(values: np.ndarray) -> np.ndarray:
    """Angle from every pixel's centre to the nearest pixel of weight 0."""
    nside = healpy.get_nside(values)
    vectors = np.stack(healpy.pix2vec(nside, np.arange(values.size)), axis=-1)
    zeros = vectors[values == 0.0]
    return np.array([np.arctan2(np.linalg.norm(np.cross(v, zeros), axis=1), zeros @ v).min() for v in vectors])


@pytest.mark.parametrize("width_deg", [12.0, 60.0, 90.0])
def test_edge_rises_like_a_cosine_with_the_distance_from_the_zeros(width_deg):
    values = band(8)
    # A hole of one pixel, away from the band, and a weight that is neither 0 nor 1.
    values[100], values[5] = 0.0, 0.4
    width = np.deg2rad(width_deg)
    distance = brute_force_distance(values)
    edge = np.where(distance < width, 0.5 - 0.5 * np.cos(np.pi * distance / width), 1.0)
    np.testing.assert_allclose(mask.apodise(values, width), values * edge, atol=1e-12)


def test_apodisation_of_nothing(write):
    np.testing.assert_array_equal(mask.apodise(band(8), 0.0), band(8))
    np.testing.assert_array_equal(mask.apodise(np.ones(768), 0.1), np.ones(768))
    np.testing.assert_array_equal(mask.apodise(np.zeros(768), 0.1), np.zeros(768))
    soft = mask.read_mask(write(band(32)), 32, apodisation_deg=10.0)
    np.testing.assert_array_equal(soft, mask.apodise(band(32), np.deg2rad(10.0)))


def test_soft_edge_damps_the_small_scales_of_the_mask():
    """Its slope is a half sine: the power is multiplied by [cos(lw/2) / (1 - (lw/pi)^2)]^2, < 1/64 from 3 pi/w on."""
    sharp, width = band(64), np.deg2rad(10.0)
    power = [healpy.anafast(values, lmax=128, iter=3) for values in (sharp, mask.apodise(sharp, width))]
    assert power[1][54:].sum() < power[0][54:].sum() / 64.0


@pytest.mark.parametrize(
    ("values", "named"),
    [
        (np.full(768, 2.0), ("mask.fits", "0 ... 1")),
        (np.full(768, -np.inf), ("mask.fits", "0 ... 1")),
        (np.ones(12 * 9), ("mask.fits", "nside", 3)),
    ],
)
def test_bad_values(write, values, named):
    with refused(*named):
        mask.read_mask(write(values), 8)


def test_bad_file(tmp_path):
    (tmp_path / "mask.fits").write_text("nothing")
    with refused("mask.fits"):
        mask.read_mask(tmp_path / "mask.fits", 8)
