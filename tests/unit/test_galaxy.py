"""The model of the Galaxy's light that is drawn: its mean over draws, and its scatter about that."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import healpy
import numpy as np

from instruments import two_channels
from mcsim import config, systematics
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.campaign import with_effects
from mcsim.diagnosis.drawn import PATTERNS, as_seen
from mcsim.simulation import simulate
from mcsim.simulation.channels import table_of
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rng
from mcsim.stats.gaussian import Fit
from mcsim.support.numbers import measured
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


def test_what_is_seen_of_a_pattern_has_its_mean_as_the_full_sky_has() -> None:
    """Off the plane two fifths of the square are that of the mean, which was left out: 7.6 uK in W1 are 9.9."""
    table = two_channels("drawn", lmax=32)
    table["map"]["frame"] = "galactic"
    table["map"]["mask"] = (np.abs(healpix.centres(16)[2]) > 0.34).astype(float)
    mask = table["map"]["mask"] > 0.0
    kind = systematics.get("foreground_residual")
    analysis = analysis_of(config.load(table), library={kind.name: kind})
    fit = Fit(np.array([50.0]), np.eye(1), 1000, 100.0, 1e-9, 0.0, 1, 1.0)
    known: Any = SimpleNamespace(analysis=analysis, candidates=analysis.candidates)
    (said,) = as_seen(known, [0], fit)
    off, on = (survey(with_effects(analysis.run, own)) for own in ([], [table_of(kind(amplitude=50.0), None)]))
    squares = [np.mean((simulate.maps(on, r) - simulate.maps(off, r))[:, mask] ** 2, axis=1) for r in range(PATTERNS)]
    each = np.sqrt(squares)
    for place, channel in ((0, "V1"), (2, "W1")):
        rms = measured(float(each[:, place].mean()), float(each[:, place].std(ddof=1)), " µK")
        assert f"{rms} in {channel}" in said
