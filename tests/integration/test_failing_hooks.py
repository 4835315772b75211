"""A hook that fails at the amplitude of the data ends a diagnosis: it is no reason to call the gap unknown."""

from dataclasses import dataclass, replace

import numpy as np

from instruments import ask, two_channels
from mcsim import Effect, config, systematics
from mcsim.datavector import campaign
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import context
from mcsim.diagnosis.inference import diagnose_data
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.systematics import HookError
from refusals import refused


@dataclass(frozen=True, kw_only=True)
class Wider(Effect):
    """A wider beam, whose hook is right for the small amplitudes of its responses alone."""

    name = "wider"
    scope = "channel"
    unit = "1"
    cause = "a wider beam"
    signature = "L = 0"
    step = 0.01

    def beam(self, beam, site):
        if abs(self.amplitude) > 0.1:
            raise ZeroDivisionError("of a user")
        return replace(beam, blm=beam.blm * np.exp(-self.amplitude * (np.arange(beam.lmax + 1.0) / 40.0) ** 2))


def test_a_hook_that_fails_at_the_fitted_amplitude_ends_the_diagnosis():
    library = {"wider": Wider, "noise_level": systematics.get("noise_level")}
    run, settings = config.load(two_channels("small")), DiagnosisSettings(beam_orders=2)
    analysis = analysis_of(run, settings=settings, library=library)
    known = context(analysis, *campaign.learned(analysis, ask, 260, time_ordered=False))
    wide = config.Effect(name="beam_width", channel="V1", parameters={"amplitude": 0.3})
    maps = list(simulate.maps(survey(campaign.with_effects(run, [wide])), 0))
    with refused("wider", "ZeroDivisionError", by=HookError):
        diagnose_data(ObservedMaps(known, maps, ask), "wide")
