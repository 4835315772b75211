"""Surveys with nuisances that are a user's own effects, against those of runs with the effects that are drawn."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import mcsim
from instruments import two_channels
from mcsim import config, systematics
from mcsim.simulation import simulate
from mcsim.simulation.nuisance import DisturbedSurvey, tables
from mcsim.simulation.survey import survey


@dataclass(frozen=True, kw_only=True)
class Own(mcsim.Effect):
    scope = "common"
    unit = "fraction"
    cause = "A test."
    signature = "None."
    step = 0.01


@dataclass(frozen=True, kw_only=True)
class BentGain(Own):
    name = "bent_gain"

    def gain(self, time_s, site):
        return self.amplitude * np.cos(time_s / 1e6) + 10.0 * self.amplitude**2


@dataclass(frozen=True, kw_only=True)
class BentSignal(Own):
    name = "bent_signal"

    def signal(self, time_s, theta, phi, psi, site):
        return 100.0 * self.amplitude * np.cos(psi) + 1000.0 * self.amplitude**2


@dataclass(frozen=True, kw_only=True)
class HighGain(Own):
    name = "high_gain"

    def gain(self, time_s, site):
        if self.amplitude == 0.0 or site.frequency_ghz < 80.0:
            return None
        return self.amplitude * np.cos(time_s / 1e6)


@pytest.mark.parametrize("kind", [BentGain, BentSignal, HighGain])
def test_a_nuisance_acts_as_the_effect_that_is_drawn(kind):
    """One that is not linear in its amplitude, too, or that changes nothing in one channel."""
    library = {**systematics.catalogue(), kind.name: kind}
    table = two_channels("own", lmax=12, nside=8, fwhm_arcmin=800.0, period_s=300.0)
    run = config.load(table | {"nuisance": [{"effect": kind.name, "width": 0.05}]})
    acting = replace(run, effects=tuple(tables(run, run.ensemble.seed, 1, library)))
    found = simulate.maps(DisturbedSurvey.of(run, library).at(1), 1)
    expected = simulate.maps(survey(acting, library=library), 1)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found[2:] - simulate.maps(survey(replace(run, nuisances=())), 1)[2:]).max() > 1.0
