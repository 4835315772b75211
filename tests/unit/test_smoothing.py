"""Smoothing as a step of a preparation: from which beam, to which one."""

import healpy
import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.simulation.preparation import preparation
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix
from mcsim.sphere.sky import gaussian_alm
from refusals import refused

FINE = 32


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def run_with(*steps, **changes):
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 260.0, "fwhm_minor_arcmin": 220.0}
    base = {
        "name": "smoothed",
        "sky": {"spectrum": "wmap7", "lmax": 60},
        "map": {"nside": FINE},
        "biposh": {"lmax": 16},
        "ensemble": {"realizations": 2, "seed": 5},
        "channel": [{"name": "V", "beam": beam, "scan": {"kind": "parallel_transport"}}],
        "preparation": list(steps),
    }
    return config.load(base | changes)


def prepare(run, map_uk):
    return preparation(run, run.channels[0], None).apply(map_uk)


def test_smoothing_is_that_of_healpy_and_undoes_the_own_beam(rng):
    lmax = 60
    sky = gaussian_alm(1.0 / (1.0 + np.arange(lmax + 1)) ** 2, rng)
    own, target = np.deg2rad(4.0), np.deg2rad(8.0)
    seen = healpix.synthesis(healpy.smoothalm(sky, own, inplace=False)[None], FINE, lmax)[0]
    wanted = healpix.synthesis(healpy.smoothalm(sky, target, inplace=False)[None], FINE, lmax)[0]
    step = {"kind": "smooth", "fwhm_arcmin": 480.0, "own_fwhm_arcmin": 240.0}
    files = {"window": healpy.gauss_beam(target, 95), "own_window": healpy.gauss_beam(own, 95)}
    for given in step, {"kind": "smooth", **files}:
        # The quadrature of a low nside misses 1e-3 at the poles.
        difference = prepare(run_with(given), seen) - wanted
        assert difference.std() < 2e-4 * wanted.std()
        assert np.abs(difference).max() < 2e-3 * wanted.std()


def test_smoothing_starts_from_the_channels_beam():
    run = run_with({"kind": "smooth", "fwhm_arcmin": 600.0})
    channel = survey(run).channels[0]
    assert channel.site.beam.window[:30] == pytest.approx(healpy.gauss_beam(np.deg2rad(10.0), 29), abs=1e-6)
    assert channel.beam.mmax == survey(run_with()).channels[0].beam.mmax


@pytest.mark.parametrize(
    ("step", "beam"),
    [
        ({"window": healpy.gauss_beam(0.2, 70)}, {}),
        ({"fwhm_arcmin": 480.0, "own_window": healpy.gauss_beam(0.05, 70)}, {}),
        ({"fwhm_arcmin": 480.0}, {"kind": "window", "path": healpy.gauss_beam(0.05, 70)}),
        ({"fwhm_arcmin": 480.0}, {"kind": "blm", "path": mcsim.Beam.gaussian(170.0, lmax=70).blm}),
    ],
)
def test_tables_that_end_below_the_pixels_are_refused_with_what_helps(step, beam):
    steps = [{"kind": "smooth"} | step]
    run = run_with(*steps)
    changes = {"channel": [config.to_dict(run)["channel"][0] | ({"beam": beam} if beam else {})]}
    with refused("V", 70, 95, FINE, "3 nside", "degrade", 16):
        survey(run_with(*steps, **changes))
    survey(run_with({"kind": "degrade", "nside": 16}, *steps, **changes))


def smooth(fwhm_deg, **keys):
    return {"kind": "smooth", "fwhm_arcmin": 60.0 * fwhm_deg} | keys


def test_a_second_smoothing_starts_from_the_target_of_the_first():
    """Beams of 600' and then 800' are one of 800', whether pixels change between or not; other channels keep theirs."""

    def window(*steps):
        return survey(run_with(*steps)).channels[0].site.beam.window[:23]

    once = window(smooth(800.0 / 60.0))
    for between in [], [{"kind": "degrade", "nside": 16}]:
        assert window(smooth(10.0), *between, smooth(800.0 / 60.0)) == pytest.approx(once, abs=1e-6)
    stated = window(smooth(10.0), smooth(800.0 / 60.0, own_fwhm_arcmin=0.0))
    assert stated == pytest.approx(once * healpy.gauss_beam(np.deg2rad(10.0), 22), abs=1e-6)


def test_a_second_target_that_is_narrower_than_the_first_is_refused():
    with refused("V", "narrower", "preparation[1]", 10):
        survey(run_with(smooth(12.0), smooth(6.0)))
