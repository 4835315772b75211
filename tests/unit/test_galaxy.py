"""The model of the Galaxy's light that is drawn: its mean over draws, and its scatter about that."""

from functools import partial
from types import SimpleNamespace

import healpy
import numpy as np

from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rng
from mcsim.systematics.galaxy import morphology

LMAX, NSIDE, DRAWS = 48, 32, 60


def test_the_drawn_galaxy_is_a_plane_whose_patches_vary_by_as_much_as_itself() -> None:
    """p(b) (1 + g) with g of unit variance has the mean p(b), and scatters by p(b) about it."""
    site, maps = SimpleNamespace(lmax=LMAX, frame="galactic"), []
    for number in range(DRAWS):
        alm = morphology("", site, partial(rng.generator, 7, number))
        # A Gaussian beam of 4 degrees keeps the harmonics from ringing.
        smooth = np.exp(-0.5 * (np.arange(LMAX + 1.0) * np.deg2rad(4.0 / 2.355)) ** 2)
        maps.append(healpix.synthesis(alm_.multiply(alm, smooth, LMAX)[None], NSIDE, LMAX)[0])
    mean, scatter = np.mean(maps, axis=0), np.std(maps, axis=0)
    sine = np.abs(healpy.pix2vec(NSIDE, np.arange(mean.size))[2])
    bands = [sine < 0.05, abs(sine - 0.3) < 0.05, abs(sine - 0.8) < 0.05]
    profile = np.array([mean[band].mean() for band in bands])
    expected = np.array([np.mean(1.0 / (1.0 + (sine[band] / 0.15) ** 2)) for band in bands])
    # Half of the variance of g is its dipole's, the same on a whole side of the sky: an error of 1/sqrt(60) at most.
    np.testing.assert_allclose(profile / profile[0], expected / expected[0], rtol=0.15, atol=0.02)
    # What is brought to an rms of 1 scatters a little less.
    ratio = scatter[bands[0]].mean() / mean[bands[0]].mean()
    assert 0.6 < ratio < 1.1
