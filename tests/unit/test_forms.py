"""Effects of free form where their numbers leave what maps can have, and where a channel does not see them."""

from dataclasses import replace

import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.reconstruction.plugin import Plugin
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, real
from mcsim.sphere.sky import dipole_alm, gaussian_alm
from mcsim.systematics import Site

LMAX, NSIDE = 12, 8
SITE = Site(
    channel="W1",
    frequency_ghz=47.0,
    frame="galactic",
    nside=NSIDE,
    lmax=LMAX,
    beam=Beam.gaussian(600.0, LMAX),
    dipole_uk=np.array([300.0, -200.0, 100.0]),
)
SKY = gaussian_alm(np.full(LMAX + 1, 40.0), np.random.default_rng(1))


def acting(base, amplitude=1.0, **values):
    return Plugin("unlisted_1", base, "W1", values).kind()(amplitude=amplitude)


@pytest.mark.parametrize("on_dipole", [True, False])
def test_a_square_may_have_its_constant_taken_off(on_dipole):
    """The maps had it taken off with the monopole: the change is factor (T^2 + offset), up to the sky's own degree."""
    low = alm_.resize(alm_.resize(SKY, LMAX, LMAX // 2), LMAX // 2, LMAX)  # whose square ends at LMAX
    effect = acting("SignalPower", 0.5, factor=2e-3, offset=-7000.0, on_dipole=on_dipole)
    found = healpix.synthesis((effect.sky(low, SITE, None) - low)[None], NSIDE, LMAX)[0]
    whole = low + dipole_alm(SITE.dipole_uk, LMAX) if on_dipole else low
    map_uk = healpix.synthesis(whole[None], NSIDE, LMAX)[0]
    np.testing.assert_allclose(found, 0.5 * 2e-3 * (map_uk**2 - 7000.0), rtol=0, atol=1e-8 * np.abs(found).max())


def test_noise_that_is_less_by_more_than_all_is_none():
    pattern = (-0.4, 0.9, 2.5, -1.2)
    found = acting("NoisePattern", coefficients=pattern, frame="galactic").noise(SITE)
    whole = 1.0 + real.field(np.array(pattern), *healpix.centres(NSIDE))
    assert whole.min() < -0.2
    np.testing.assert_allclose(found, np.where(whole > 0.0, whole, 0.0), atol=1e-12)


def test_foregrounds_of_free_form_grow_with_frequency_and_not_in_separated_maps():
    coefficients = (1.0, 2.0, -3.0, 0.5)
    plain = acting("AddedPattern", coefficients=coefficients, frame="galactic").sky(SKY, SITE, None) - SKY
    light = acting("AddedPattern", coefficients=coefficients, frame="galactic", index=-2.0, foreground=True)
    np.testing.assert_allclose(light.sky(SKY, SITE, None) - SKY, 4.0 * plain, atol=1e-10)  # 47 GHz, of 94
    np.testing.assert_array_equal(light.sky(SKY, replace(SITE, foregrounds=False), None), SKY)


@pytest.mark.parametrize("on_dipole", [True, False])
def test_a_signal_from_elsewhere_may_be_that_of_the_sky_alone(on_dipole):
    """Without monopole and dipole of the sky, which the main beam sees as before."""
    towards = ((0.6, 0.0, 0.8, 1.0), (0.0, -1.0, 0.0, 0.5))
    lobe = acting("Elsewhere", towards=towards, factor=0.1, top=6, on_dipole=on_dipole).beam(SITE.beam, SITE)
    change = lobe.blm.copy()
    change[: SITE.beam.mmax + 1] -= SITE.beam.blm
    assert change[:, 2:7].any(axis=0).all()
    assert not change[:, 7:].any()
    assert change[:, :2].any(axis=0).all() == on_dipole
    assert on_dipole or not change[:, :2].any()
