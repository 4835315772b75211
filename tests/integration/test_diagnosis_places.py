"""Places that stand out of residual maps: they are said, and nothing is named that does not add them."""

from dataclasses import dataclass, replace

import healpy
import numpy as np
import pytest

from instruments import ask, data_of, learned, learned_small, two_channels
from mcsim import config, systematics
from mcsim.datavector.campaign import with_effects
from mcsim.diagnosis.inference import diagnose_data
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix

SPOT = 700  #: a pixel of nside 16


@dataclass(frozen=True, kw_only=True)
class HotSpot(systematics.Effect):
    """A spot of 8 degrees on the sky, of an amplitude in uK at its centre."""

    name = "hot_spot"
    scope = "channel"
    unit = "uK"
    parametrization = systematics.Parametrization()

    def sky(self, sky, site, draw):
        """With a Gaussian spot."""
        toward = np.array(healpy.pix2vec(16, SPOT)) @ np.array(healpy.pix2vec(64, np.arange(49152)))
        spot = np.exp(-0.5 * (np.arccos(np.clip(toward, -1.0, 1.0)) / np.deg2rad(3.4)) ** 2)
        return sky + self.amplitude * healpix.analysis(spot, site.lmax)


@pytest.fixture(scope="module")
def small():
    return learned_small()


@pytest.fixture(scope="module")
def shared(small):
    return data_of(small.run)


def test_perfect_maps_have_no_such_places(small, shared):
    """By chance one of a million has: those of twelve skies."""
    assert not any(ObservedMaps(small, list(simulate.maps(shared, r)), ask).notes() for r in range(12))


def test_bad_pixels_of_one_map_are_named_nothing(small, shared):
    """They were called more noise, a narrower beam or point sources, without a word of where they are."""
    rng = np.random.default_rng(2)
    bad = rng.choice(3072, 4, replace=False)
    changed = [map_uk.copy() for map_uk in simulate.maps(shared, 2)]
    changed[2][bad] += np.array([-20.0, 18.0, 16.0, -15.0]) * shared.maps[2].noise_uk[bad]
    found = diagnose_data(ObservedMaps(small, changed, ask), "glitches")
    assert (found.kind, found.sets) == ("unknown", ())
    assert [effect.name for one in found.contradicted for effect in one.effects] == ["noise_level"]
    first, remedy, *_, refusal = found.verdict["notes"]
    assert f"4 places of the residual of {shared.map_names[2]} stand out, up to" in first
    for lon, lat in zip(*healpy.pix2ang(16, bad, lonlat=True), strict=True):
        assert f"longitude {lon:.0f}°, latitude {lat:.0f}°".replace("-", "−") in first
    assert "leave" in remedy
    assert "noise level of W1" in refusal


def test_what_explains_a_part_of_bad_pixels_is_not_detected(small, shared):
    """Two of 60 and 50 errors were half explained by more noise."""
    changed = [map_uk.copy() for map_uk in simulate.maps(shared, 2)]
    changed[2][[2574, 803]] += np.array([60.0, -50.0]) * shared.maps[2].noise_uk[[2574, 803]]
    found = diagnose_data(ObservedMaps(small, changed, ask), "glitches")
    assert (found.kind, found.partial, found.contradicted) == ("unknown", (), ())


def test_what_adds_a_place_may_be_named(small, shared):
    library = dict(small.analysis.library) | {"hot_spot": HotSpot}
    known = replace(small, analysis=replace(small.analysis, library=tuple(library.items())))
    spot = config.Effect(name="hot_spot", channel="W1", parameters={"amplitude": 400.0})
    hot = survey(with_effects(shared.config, [spot]), library=library)
    data = ObservedMaps(known, list(simulate.maps(hot, 5)), ask)
    assert data.notes()
    assert data.stands_out_beside([])
    assert data.stands_out_beside([config.Effect(name="dipole_residual", channel="W1", parameters={"amplitude": 3.0})])
    assert not data.stands_out_beside([spot])


def test_what_a_nuisance_leaves_alone_does_not_stand_out():
    """Residuals were compared with a scatter that is small where the dipole is 0: 16 times that of their map."""
    table = two_channels("uncertain")
    table["nuisance"] = [{"effect": "calibration", "channel": "W1", "width": 0.01}]
    known = learned(table)
    run = known.run
    plain = replace(run, nuisances=())
    for seed in range(900, 906):
        maps = list(simulate.maps(data_of(plain, seed=seed), 0))
        assert ObservedMaps(known, maps, ask).notes() == []
    maps[2][SPOT] += 20.0 * data_of(plain).maps[2].noise_uk[SPOT]
    (place, _) = ObservedMaps(known, maps, ask).notes()
    assert place.startswith("One place of the residual of W1:half1 stands out")


def test_a_strong_effect_is_named_beside_a_bad_pixel_of_another_map(small):
    """The pixel is not why it fits: without it the S/N is the same."""
    found = data_of(small.run, "beam_ellipticity", "W1", amplitude=0.3, angle_deg=20.0)
    maps = [map_uk.copy() for map_uk in simulate.maps(found, 4)]
    maps[0][1000] += 12.0 * found.maps[0].noise_uk[1000]
    told = diagnose_data(ObservedMaps(small, maps, ask), "both")
    assert [(one.name, one.channel) for one in told.effects] == [("beam_ellipticity", "W1")]
    assert abs(told.effects[0].amplitude - 0.3) < 4.0 * told.effects[0].sigma
    assert f"One place of the residual of {found.map_names[0]}" in told.notes[0]
