"""Several effects in one channel: the order in which they act, whatever the order in which they are listed."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from mcsim import systematics
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import ScanModel
from mcsim.sphere.sky import gaussian_alm
from mcsim.sphere.spectra import load

FWHM, LMAX = 240.0, 96


def site_of(beam: Beam) -> systematics.Site:
    """A channel with WMAP's scan."""
    model = ScanModel.load("wmap")
    pointing = systematics.Pointing(model, model.line_of_sight("A"))
    return systematics.Site(
        channel="W1", frequency_ghz=94.0, frame="ecliptic", nside=16, lmax=LMAX, beam=beam, pointing=pointing
    )


def effect(name: str, amplitude: float, **parameters: float) -> systematics.Effect:
    return systematics.get(name)(amplitude=amplitude, **parameters)


@pytest.mark.parametrize(
    "other",
    [
        effect("calibration", 0.2),
        effect("beam_width", 0.1),
        effect("beam_ellipticity", 0.1, angle_deg=70.0),
        effect("pointing_jitter", 100.0),
    ],
    ids=lambda one: one.name,
)
def test_effects_act_on_the_orders_that_a_beam_gets_back(other):
    """A beam with all of its orders back is the beam as measured, to any effect beside, before or after it."""
    measured = Beam.elliptical(1.1 * FWHM, FWHM / 1.1, angle_deg=20.0, lmax=LMAX, mmax=4)
    site = replace(site_of(measured.truncated(0)), whole=lambda: measured)
    expected = systematics.seen_through([other], site_of(measured)).blm
    restored = effect("beam_noncircularity", 1.0)
    for acting in permutations([other, restored]):
        found = systematics.seen_through(acting, site).blm
        orders = min(len(found), len(expected))
        np.testing.assert_allclose(found[:orders], expected[:orders], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    "own",
    [effect("dipole_residual", 30.0), effect("monopole_residual", 30.0), effect("nonlinearity", 0.05)],
    ids=lambda one: one.name,
)
def test_the_sky_changes_before_a_channel_does(own):
    """A modulation of the sky is none of a residual, nor of the response: all channels look at one sky."""
    site = replace(site_of(Beam.gaussian(FWHM, LMAX)), dipole_uk=np.array([0.0, 0.0, 3364.5]))
    sky = gaussian_alm(load("wmap7", LMAX), np.random.default_rng(1))
    common = effect("dipole_modulation", 0.2)
    expected = own.sky(systematics.looked_at([common], sky, site, 1, 0), site, np.random.default_rng)
    for acting in permutations([own, common]):
        np.testing.assert_array_equal(systematics.looked_at(acting, sky, site, 1, 0), expected)


def test_a_coma_is_of_the_stretched_beam():
    """A stretch of 16 % after it would change its m = 1 part by 18 %; a width as much before it as after."""
    site = site_of(Beam.gaussian(FWHM, LMAX))
    stretch, coma = effect("beam_ellipticity", 0.16, angle_deg=20.0), effect("beam_coma", 0.02, angle_deg=20.0)
    expected = coma.beam(stretch.beam(site.beam, site), site).blm
    for acting in permutations([coma, stretch]):
        np.testing.assert_array_equal(systematics.seen_through(acting, site).blm, expected)
    wide = effect("beam_width", 0.1)
    one, other = (systematics.seen_through(acting, site).blm for acting in permutations([coma, wide]))
    assert np.abs(one - other).max() < 1e-4 * np.abs(one[1:]).max()


@pytest.mark.parametrize("calibrated", ["none", "dipole"])
def test_no_coma_amplifies_a_sidelobe(calibrated):
    """(u^3 - 3u) of a ring at five sigmas is a hundred: its integral would grow by as much."""
    beam = Beam.gaussian(FWHM, LMAX)
    coma, ring = effect("beam_coma", 0.1), systematics.get("beam_sidelobe")(amplitude=0.005, calibrated=calibrated)
    expected = ring.beam(coma.beam(beam, site_of(beam)), site_of(beam)).blm
    for acting in permutations([coma, ring]):
        np.testing.assert_array_equal(systematics.seen_through(acting, site_of(beam)).blm, expected)


@pytest.mark.parametrize(
    ("one", "least"),
    [
        (effect("calibration", 0.2), 1e-15),
        (effect("beam_width", 0.2), 1e-6),
        (effect("beam_ellipticity", 0.2, angle_deg=70.0), 1e-4),
        (effect("pointing_offset", 60.0, angle_deg=70.0), 1e-7),
        (effect("time_constant", 0.02), 1e-3),
        (effect("beam_coma", 0.01, angle_deg=70.0), 1e-2),
    ],
    ids=lambda one: getattr(one, "name", ""),
)
def test_the_inverse_of_an_effect_takes_it_back(one, least):
    """Exactly where there is such an effect; of a late signal, or of a coma, by all but the square of the amplitude.

    A beam's continuation beyond lmax is good to 1e-6, and what is cut off beyond its orders is 1e-8 of its power.
    """
    site = site_of(Beam.elliptical(1.05 * FWHM, FWHM / 1.05, angle_deg=20.0, lmax=LMAX, mmax=8))
    changed, back = (systematics.seen_through(acting, site).blm for acting in ([one], [one, one.inverse()]))
    before = site.beam.blm[:5]
    change = np.abs(changed[:5] - before).max()
    assert np.abs(back[:5] - before).max() < least * np.abs(before).max()
    assert np.abs(back[:5] - before).max() < 0.2 * change
