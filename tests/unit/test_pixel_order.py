"""Maps whose pixels are in another order than they are taken to be are refused before anything is simulated."""

from pathlib import Path

import healpy
import numpy as np
import pytest

import mcsim
from instruments import data_of, two_channels
from layouts import table
from mcsim import config
from mcsim.simulation import simulate
from mcsim.sphere import map_files, mask
from mcsim.sphere.pixel_order import check_ring
from refusals import refused

NSIDE = 32
NPIX = 12 * NSIDE**2


def smooth():
    """Return a sky of the degrees that pixels of this size show, as red as the CMB's."""
    ell = np.arange(2 * NSIDE + 1.0)
    return healpy.synfast(np.where(ell > 1, 1.0 / np.maximum(ell * (ell + 1), 1.0), 0.0), NSIDE, new=True)


@pytest.fixture(scope="module")
def maps():
    """Skies without and with as much noise, and with half of it and a source; a belt as a mask, and hits of a scan."""
    np.random.seed(4)  # healpy's own
    rng = np.random.default_rng(4)
    sky, z = smooth(), healpy.pix2vec(NSIDE, np.arange(NPIX))[2]
    noise = rng.standard_normal(NPIX)
    source = sky + 0.5 * sky.std() * noise + 1e4 * (np.arange(NPIX) == 777)
    part = np.where(z > 0.4, sky, healpy.UNSEEN)
    hits = 100.0 / np.sqrt(1.05 - z**2)
    return [sky, sky + 0.7 * sky.std() * noise, source, part, (np.abs(z) > 0.3).astype(float), hits]


def test_maps_in_their_order_are_taken(maps):
    for map_ in maps:
        check_ring(map_, "map")


def test_nested_maps_that_are_called_ring_are_refused(maps):
    for map_ in maps:
        with refused("a.fits", "NESTED", "ORDERING"):
            check_ring(healpy.reorder(map_, r2n=True), "a.fits")


def test_ring_maps_that_are_called_nested_are_refused(maps):
    for map_ in maps[:4]:  # a mask and hits of a scan are smooth in either
        with refused("a.fits", "NESTED", "ORDERING"):
            check_ring(healpy.reorder(map_, n2r=True), "a.fits")


@pytest.mark.parametrize("nside", [8, 24, 32])
def test_what_tells_nothing_is_taken(nside):
    """White noise, a constant, few pixels, and coarse or odd ones."""
    noise = np.random.default_rng(5).standard_normal(12 * nside**2)
    few = np.where(np.arange(noise.size) < 200, np.arange(noise.size), healpy.UNSEEN)
    for map_ in (noise, 0.0 * noise, few, np.full(noise.size, np.nan)):
        check_ring(map_, "map")


@pytest.mark.parametrize("nside", [16, 64])
def test_stripes_along_rings_are_taken(nside):
    """A NESTED reading puts pixels of one ring together: of scans at one declination, whole, in part and with noise."""
    rng, npix = np.random.default_rng(6), 12 * nside**2
    stripes, noise = rng.standard_normal(4 * nside)[healpy.pix2ring(nside, np.arange(npix))], rng.standard_normal(npix)
    south = healpy.pix2vec(nside, np.arange(npix))[2] < -0.6
    for map_ in (stripes, stripes + 0.5 * noise, (stripes > 0.0).astype(float), np.where(south, stripes, np.nan)):
        check_ring(map_, "map")


def test_noise_whose_neighbours_have_opposite_signs_is_taken():
    """Neighbours of noise without its beam correlate by -0.3, which is less than 0 of any other order."""
    np.random.seed(7)  # healpy's own
    ell = np.arange(3.0 * NSIDE)
    check_ring(healpy.synfast(np.exp(ell * (ell + 1.0) * (1.5 / NSIDE) ** 2), NSIDE, new=True), "map")


def test_what_was_not_observed_is_no_neighbour_in_single_precision(maps):
    """In the pixels that are seen there is white noise alone, in either order."""
    noise = np.random.default_rng(8).standard_normal(NPIX)
    part = np.where(maps[3] == healpy.UNSEEN, healpy.UNSEEN, noise)
    check_ring(healpy.reorder(part, r2n=True).astype(np.float32).astype(float), "map")


def test_files_of_maps_and_masks_are_refused(maps, tmp_path):
    nested = healpy.reorder(maps[4], r2n=True)
    path = Path(table(tmp_path / "mask.fits", {"TEMPERATURE": nested}))
    np.save(tmp_path / "mask.npy", nested)
    for own in (path, tmp_path / "mask.npy"):
        with refused(str(own), "NESTED"):
            map_files.read_map(own)
        with refused(str(own), "NESTED"):
            mask.read_mask(own, NSIDE)
    np.testing.assert_array_equal(map_files.read_map(path, any_order=True)[0], nested)


def test_a_diagnosis_refuses_them_before_it_simulates(tmp_path, monkeypatch):
    monkeypatch.setattr("mcsim.diagnosis.api.batch", lambda *_: pytest.fail("simulates"))
    model = two_channels("ordered") | {"map": {"nside": 16}}
    found = data_of(config.load(model))
    nested = {name: healpy.reorder(one, r2n=True) for name, one in zip("VW", simulate.maps(found, 0), strict=True)}
    with refused("map V1", "NESTED"):
        mcsim.diagnose(model, {f"{name}1": one for name, one in nested.items()})
