"""Noise far above the model's hides nothing: what else is there is tested with the scatter that data have with it."""

import numpy as np
import pytest

from instruments import ask, learned, two_channels
from mcsim import config
from mcsim.datavector.campaign import with_effects
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

TWICE = config.Effect(name="noise_level", channel="V1", parameters={"amplitude": 1.0})
OFFSET = config.Effect(name="pointing_offset", channel="V1", parameters={"amplitude": 40.0, "angle_deg": 30.0})


@pytest.fixture(scope="module")
def model():
    return learned(two_channels("noisy", sigma0_uk=100.0), "beam_width", "calibration", "beam_sidelobe")


def observed(model, *found):
    return ObservedMaps(model, list(simulate.maps(survey(with_effects(model.run, found)), 3)), ask)


def test_twice_the_noise_is_named_and_leaves_what_agrees(model):
    data = observed(model, TWICE)
    verdict = diagnose_data(data, "noisy")
    ((one,),) = (each.effects for each in verdict.sets)
    assert (verdict.kind, one.name, one.channel) == ("effect", "noise_level", "V1")
    assert abs(one.amplitude - 1.0) < 3.0 * one.sigma
    assert verdict.sets[0].pvalue_alone > 0.01  # without any tolerance
    # The gap stays that of the model.
    assert verdict.test == data.gap
    assert np.all(verdict.standard_deviation == model.ensemble.simulations.std(axis=0, ddof=1))
    assert any("simulations that have the noise level of V1." in one for one in verdict.notes)


def test_an_effect_is_found_beside_twice_the_noise(model):
    noise, offset = sorted(diagnose_data(observed(model, TWICE, OFFSET), "noisy").effects, key=lambda one: one.name)
    assert (noise.name, offset.name, offset.channel) == ("noise_level", "pointing_offset", "V1")
    assert abs(noise.amplitude - 1.0) < 3.0 * noise.sigma
    assert abs(offset.amplitude - 40.0) < 3.0 * offset.sigma
