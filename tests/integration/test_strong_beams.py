"""Beams far from the model's are named with their size: observed skies are found as such beams see them."""

import numpy as np
import pytest

from instruments import ask, data_of, learned, two_channels
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate


@pytest.fixture(scope="module")
def model():
    return learned(two_channels("small"), "calibration", "beam_width")


@pytest.mark.parametrize("amplitude", [-0.3, -0.08, 0.08])
def test_a_wide_or_narrow_beam_has_its_size(model, amplitude):
    """In skies that the model's beam was taken to see, -0.3 was -0.22, -0.08 was -0.072 and 0.08 was 0.085."""
    found = []
    for realization in range(3):
        maps = list(simulate.maps(data_of(model.run, "beam_width", "W1", amplitude=amplitude), realization))
        verdict = diagnose_data(ObservedMaps(model, maps, ask), "beam")
        assert verdict.kind == "effect"
        ((one,),) = (each.effects for each in verdict.sets)
        assert (one.name, one.channel) == ("beam_width", "W1")
        found.append((one.amplitude, one.sigma))
    values, errors = np.array(found).T
    assert abs(values.mean() - amplitude) < 3.0 * np.sqrt(np.mean(errors**2) / len(values))
