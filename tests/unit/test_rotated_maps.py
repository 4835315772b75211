"""Maps that a preparation turns into another frame: what is found in them acts on maps as they are made."""

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import healpy
import numpy as np
import pytest

from instruments import two_channels
from mcsim import config, systematics
from mcsim.bipolar import power_spectrum
from mcsim.datavector.analysis import analysis_of, simulated_maps
from mcsim.datavector.campaign import constrained_jobs
from mcsim.datavector.matched_filters import matched_filter
from mcsim.datavector.same_skies import SameSkies
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.shared_sky import shared_sky
from mcsim.reconstruction.plugin import Plugin
from mcsim.simulation import simulate
from mcsim.simulation.channels import table_of
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, real
from mcsim.sphere.rotation import rotate_alm, rotation_matrix
from mcsim.sphere.sky import gaussian_alm
from mcsim.systematics import spacecraft

LMAX = 20
FRAMES = ("ecliptic", "galactic")
RANDOM = tuple(np.random.default_rng(3).normal(size=18))


@lru_cache(maxsize=2)
def site(frame):
    """The place in the simulation of V1 in maps of a frame."""
    run = two_channels("turned", lmax=LMAX, nside=16, period_s=997.0)
    return survey(config.load({**run, "map": {**run["map"], "frame": frame}})).channels[0].site


def acting(base, **values):
    """Return the effect of numbers that were found in galactic maps."""
    return Plugin("unlisted_1", base, "V1", {"frame": "galactic", **values}).kind()(amplitude=1.0)


@pytest.mark.parametrize(
    "effect",
    [
        acting("AddedPattern", coefficients=RANDOM[:9]),
        acting("CompactSource", lon_deg=40.0, lat_deg=-25.0, factor=2.0),
        acting("GainPattern", coefficients=RANDOM[:9]),
        acting("RotatedSky", rotation=RANDOM[:3]),
        acting("BoostedSky", velocity=(0.02, -0.03, 0.01)),
    ],
    ids=lambda effect: type(effect).__mro__[1].__name__,
)
def test_what_acts_on_the_sky_is_the_same_in_maps_of_another_frame(effect):
    draw = np.random.default_rng(5).normal(size=(2, alm_.size(LMAX)))
    sky = draw[0] + 1j * np.where(np.arange(draw.shape[1]) > LMAX, draw[1], 0.0)
    turned = rotate_alm(sky, LMAX, *FRAMES)
    there, here = effect.sky(turned, site("galactic"), None), effect.sky(sky, site("ecliptic"), None)
    changed = np.abs(there - turned).max()
    np.testing.assert_allclose(rotate_alm(here, LMAX, *FRAMES), there, rtol=0, atol=1e-6 * changed)


def test_turned_maps_have_the_dipole_of_their_frame_and_end_at_twice_nside():
    """Effects that follow the dipole would follow one elsewhere; degrees beyond 2 nside are not in a turned map."""
    run = two_channels("turned", lmax=40)
    run |= {"map": {"nside": 16}, "channel": [{**run["channel"][0], "scan": {"kind": "parallel_transport"}}]}
    turned = survey(config.load({**run, "preparation": [{"kind": "rotate", "frame": "galactic"}]})).channels[0]
    there = survey(config.load({**run, "map": {**run["map"], "frame": "galactic"}})).channels[0]
    assert turned.site.frame == "galactic"
    np.testing.assert_allclose(turned.site.dipole_uk, there.site.dipole_uk, atol=1e-6)
    factors, whole = turned.response.factors[0], there.response.factors[0]
    np.testing.assert_allclose(factors[:33], whole[:33], rtol=1e-12)
    assert not factors[33:].any()
    assert whole[33:].all()


def test_noise_that_grows_by_a_pattern_is_the_same_in_maps_of_another_frame():
    pattern = 0.02 * np.array(RANDOM[:9])
    found = acting("NoisePattern", coefficients=tuple(pattern)).noise(site("ecliptic"))
    there = rotation_matrix(*FRAMES) @ healpix.centres(16)
    np.testing.assert_allclose(found, 1.0 + real.field(pattern, *there), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "effect",
    [
        acting("AddedToSamples", wave="sky", coefficients=RANDOM[:4]),
        acting("AddedToSamples", wave="sky", spins=(1,), coefficients=RANDOM[:6]),
        acting("AddedToSamples", wave="sky", spins=(2,), coefficients=RANDOM[:10]),
        acting("AddedToSamples", wave="orientation", harmonic=2, coefficients=RANDOM[:2]),
        acting("GainOverTime", wave="sky", coefficients=RANDOM[:4]),
        acting("GainOverTime", wave="orientation", harmonic=1, coefficients=RANDOM[:2]),
        acting("GainOfOne", wave="orientation", harmonic=1, coefficients=RANDOM[:2], on_sky=False),
    ],
    ids=lambda effect: f"{type(effect).__mro__[1].__name__}-{effect.wave}",
)
def test_what_acts_on_samples_is_the_same_in_maps_of_another_frame(effect):
    """Patterns are those of the centres of pixels of 27', and at the poles psi changes within a pixel."""
    time_s, found = np.linspace(0.0, 3e7, 500), []
    for frame in FRAMES:
        where, pointing = site(frame), site(frame).pointing
        (x, y, z), _ = spacecraft.line_of_sight(pointing, time_s, frame)
        theta, phi = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
        psi = spacecraft.orientation(pointing, time_s, frame)
        gain = effect.gain(time_s, where) if type(effect).__mro__[1].__name__ == "GainOverTime" else None
        found.append(effect.signal(time_s, theta, phi, psi, where) if gain is None else gain)
    there = found[1]
    assert np.std(there) > 0.0
    assert np.quantile(np.abs(found[0] - there), 0.9) < 0.05 * np.std(there)


def test_skies_that_turned_maps_constrain_are_these_skies():
    """Nothing but noise tells the filtered sky of such maps from that of the observed ones."""
    table = two_channels("turned", lmax=LMAX, nside=16)
    table["preparation"] = [{"kind": "rotate", "frame": "galactic"}]
    analysis = analysis_of(config.load(table), settings=DiagnosisSettings(hidden_share=1.0))
    model = analysis.model
    assert model.frame == "galactic"
    observed = shared_sky(model, list(simulate.maps(model.survey, 5)))
    (maps,) = simulated_maps(constrained_jobs(analysis, (), observed, range(1))[0])
    apart = shared_sky(model, maps) - observed
    ell = np.arange(2, 11)  # where the sky is far above the noise
    left, power = (power_spectrum(one, one, LMAX)[ell] for one in (apart, observed))
    assert np.all(left < 0.1 * power)


def test_a_modulation_of_turned_maps_is_undone_where_it_acted():
    """A pattern that is known in galactic maps was not turned into the ecliptic ones that it acts on."""
    table = two_channels("turned", lmax=LMAX, nside=16)
    table["preparation"] = [{"kind": "rotate", "frame": "galactic"}]
    pattern = tuple(0.02 * np.append(np.zeros(4), RANDOM[:5]))
    values = {"coefficients": pattern, "on_dipole": False, "scope": "common", "frame": "galactic"}
    kind = Plugin("unlisted_1", "GainPattern", "V1", values).kind()
    analysis = analysis_of(config.load(table), library={kind.name: kind})
    channel, skies = analysis.model.survey.making.channels[0], SameSkies(analysis, list, ())
    sky = gaussian_alm(analysis.model.cl, np.random.default_rng(7))
    seen = kind(amplitude=1.0).sky(sky, replace(channel.site, lmax=LMAX), None)
    found = skies._turned_back(rotate_alm(seen, LMAX, *FRAMES), skies.turned([table_of(kind(amplitude=1.0), None)]))
    apart = alm_.power(rotate_alm(found, LMAX, *FRAMES[::-1]) - sky, LMAX)[2:].sum()
    assert apart < 0.01 * alm_.power(seen - sky, LMAX)[2:].sum()


def test_noise_after_a_template_without_a_frame_is_looked_for_where_it_is(tmp_path):
    """Such a template is in the frame of maps as they are made; the filter read it as one of turned maps."""
    path = str(tmp_path / "pattern.fits")
    healpy.write_map(path, healpix.centres(16)[0], dtype=np.float64)
    table = two_channels("turned", lmax=LMAX, nside=16) | {"preparation": [{"kind": "rotate", "frame": "galactic"}]}
    effect = systematics.get("noise_anisotropy")(amplitude=0.1, template=path)
    own = tuple(name for name in systematics.catalogue() if name != "noise_level")
    model = analysis_of(config.load(table), without=own).model
    there = (rotation_matrix(*FRAMES[::-1]) @ healpix.centres(16))[0]  # ecliptic x of galactic pixels
    found = matched_filter(model, effect, 0)(SimpleNamespace(squares=[there]))
    # A centre is up to 0.055 rad off, half a diagonal, and the pattern has a slope of 1 and a rms of 0.577.
    np.testing.assert_allclose(found, 0.1 * there @ there, rtol=0.055 / 0.577)
