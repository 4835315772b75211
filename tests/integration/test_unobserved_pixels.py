"""Pixels that data lack and the model has: perfect maps depart from nothing with them, nor without."""

import healpy
import numpy as np
import pytest

import mcsim
from instruments import ask, data_of, learned_small, two_channels
from mcsim import config
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.map_checks import checked_maps
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from refusals import refused


@pytest.fixture(scope="module")
def small():
    return learned_small()


def near(pixel):
    """Return 28 of the 3,072 pixels, those nearest to one."""
    directions = np.array(healpy.pix2vec(16, np.arange(3072)))
    return np.argsort(-np.array(healpy.pix2vec(16, pixel)) @ directions)[:28]


@pytest.mark.parametrize("which", [(0, 1, 2, 3), (1,)], ids=["all", "one"])
@pytest.mark.parametrize("pixels", [np.arange(28), near(400), near(1500)], ids=["pole", "high", "equator"])
def test_a_hole_of_perfect_maps_is_no_gap(small, pixels, which):
    """Of 28 pixels at the pole of all maps p was 1e-12, and a modulation was named; more rounds made it 0."""
    for seed in (700, 701, 702):
        maps = list(simulate.maps(data_of(small.run, seed=seed), 0))
        whole = ObservedMaps(small, [one.copy() for one in maps], ask).gap.pvalue
        for number in which:
            maps[number][pixels] = healpy.UNSEEN
        assert ObservedMaps(small, maps, ask).gap.pvalue > 0.3 * whole


def test_few_pixels_that_are_exactly_zero_are_refused_at_once(small):
    """A modulation of the sky and a foreground were detected, without a word on the pixels."""
    maps = dict(zip(small.analysis.model.survey.map_names, simulate.maps(data_of(small.run), 0), strict=True))
    maps["W1:half1"][7:27] = 0.0
    with refused("W1:half1", "20 pixels", "UNSEEN"):
        mcsim.diagnose(small.run, maps)


def test_rounded_maps_may_be_zero_and_so_may_what_is_not_observed(small):
    names = small.analysis.model.survey.map_names
    maps = [np.round(one) for one in simulate.maps(data_of(small.run), 0)]
    assert np.sum(maps[0] == 0.0) > 3
    checked_maps(small.analysis.model, dict(zip(names, maps, strict=True)))
    hidden = [np.where(np.arange(one.size) < 20, healpy.UNSEEN, one) for one in maps]
    checked_maps(small.analysis.model, dict(zip(names, hidden, strict=True)))


@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_holes_of_a_map_without_noise_are_refused(noise):
    """Fifteen of 49,152 pixels made a chi^2 of 2e14: what is put in their place is never as exact as such a map."""
    table = two_channels("quiet", lmax=16, nside=8, fwhm_arcmin=600.0, period_s=3011.0)
    table["map"].pop("splits")
    table["channel"][1]["noise"] = {"sigma0_uk": noise}
    model = model_of(survey(config.load(table)), DiagnosisSettings())
    maps = dict(zip(model.survey.map_names, simulate.maps(model.survey, 0), strict=True))
    checked_maps(model, maps)
    quiet, noisy = model.survey.map_names[1], model.survey.map_names[0]
    for name in (noisy, quiet):
        maps[name] = np.where(np.arange(768) // 2 == 50, healpy.UNSEEN, maps[name])
        if name == noisy:
            checked_maps(model, maps)
    with refused(quiet, 2, "map.mask"):
        checked_maps(model, maps)
