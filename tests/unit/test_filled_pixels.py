"""Pixels that a preparation fills: they have a value, and neither noise nor samples of their own."""

import numpy as np
import pytest

from mcsim import config
from mcsim.instrument.scan import Moments
from mcsim.simulation.preparation import Preparation, preparation

FINE, COARSE = 16, 4
NPIX = 12 * FINE**2
MASK = np.where(np.arange(NPIX) % 7 == 0, 0.0, 1.0)
FILL = {"kind": "fill", "method": "constant"}
DEGRADE = {"kind": "degrade", "nside": COARSE}


def prepared(*steps) -> Preparation:
    run = config.load(
        {
            "name": "filled",
            "sky": {"spectrum": "wmap7", "lmax": 40},
            "map": {"nside": FINE},
            "biposh": {"lmax": 8},
            "channel": [
                {
                    "name": "V",
                    "beam": {"kind": "gaussian", "fwhm_arcmin": 400.0},
                    "scan": {"kind": "parallel_transport"},
                }
            ],
            "preparation": list(steps),
        }
    )
    found = preparation(run, run.channels[0], None)
    assert found is not None
    return found


@pytest.mark.parametrize("hidden", [True, False], ids=["masked", "not observed"])
def test_means_over_filled_pixels_have_the_noise_of_the_others(hidden):
    """Of 16 pixels of 50 uK of which n are observed the mean has n 50^2 / 16^2, whatever the filled ones hold."""
    rng = np.random.default_rng(2)
    steps = prepared(FILL | ({"mask": MASK} if hidden else {}), DEGRADE)
    noise_uk, hits = (np.full(NPIX, 50.0), np.ones(NPIX)) if hidden else (50.0 * MASK, MASK)
    found = steps.noise_uk(noise_uk, hits)
    observed = prepared(DEGRADE).apply(MASK)  # share of every coarse pixel
    assert np.ptp(observed) > 0.1
    assert found == pytest.approx(50.0 * np.sqrt(observed / 16.0))
    seen = hits > 0.0
    draws = [steps.apply(np.where(seen, 50.0 * rng.standard_normal(NPIX), np.nan)) for _ in range(60)]
    # 192 pixels of 60 draws: 4 sigma of a mean square.
    assert np.mean(np.square(draws) / found**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (60 * 192)))


def test_filled_pixels_have_no_samples():
    """Neither hits nor orientations: those of the sky that the scan saw there are not in the map any more."""
    moments = Moments(FINE, "ecliptic", np.full(NPIX, 9.0), np.full((2, NPIX), 0.3 - 0.1j))
    found = prepared(FILL | {"mask": MASK}).moments(moments)
    assert np.array_equal(found.hits, 9.0 * MASK)
    assert np.array_equal(found.w, moments.w * MASK)


@pytest.mark.parametrize("hidden", [True, False], ids=["masked", "not observed"])
def test_hits_of_coarse_pixels_are_those_of_what_was_observed(hidden):
    """Those of a masked pixel were the mean of the others."""
    steps = prepared(FILL | ({"mask": MASK} if hidden else {}), DEGRADE)
    moments = Moments(FINE, "ecliptic", 9.0 * (np.ones(NPIX) if hidden else MASK), np.zeros((2, NPIX), complex))
    assert steps.moments(moments).hits == pytest.approx(9.0 * 16.0 * prepared(DEGRADE).apply(MASK))
