"""A hook that fails at the amplitude of the data ends a diagnosis: it is no reason to call the gap unknown."""

import pickle
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


def test_a_hook_that_fails_in_any_simulation_of_a_diagnosis_ends_it():
    """It was taken for an amplitude that cannot be: a set lost its response, or a reduction was "not measured"."""
    run, settings = config.load(two_channels("small")), DiagnosisSettings(beam_orders=2)
    library = {name: systematics.get(name) for name in ("beam_width", "noise_level")}
    analysis = analysis_of(run, settings=settings, library=library)
    known = context(analysis, *campaign.learned(analysis, ask, 260, time_ordered=False))
    acting = [
        config.Effect(name=name, channel="V1", parameters={"amplitude": amplitude})
        for name, amplitude in (("beam_width", 0.15), ("noise_level", 0.4))
    ]
    maps = list(simulate.maps(survey(campaign.with_effects(run, acting)), 0))
    answers: dict[bytes, list] = {}
    calls: list[bytes] = []

    def recorded(jobs):
        calls.append(key := pickle.dumps(jobs))
        if key not in answers:
            answers[key] = list(ask(jobs))
        return answers[key]

    diagnose_data(ObservedMaps(known, maps, recorded), "both")
    asked = len(calls)
    assert asked > 5
    for last in range(1, asked + 1):

        def failing(jobs, last=last):
            if len(calls) + 1 == last:
                raise HookError("effect of a user: its beam fails")
            return recorded(jobs)

        calls.clear()
        with refused("of a user", by=HookError):
            diagnose_data(ObservedMaps(known, maps, failing), "both")


def test_a_hook_that_fails_at_the_fitted_amplitude_ends_the_diagnosis():
    library = {"wider": Wider, "noise_level": systematics.get("noise_level")}
    run, settings = config.load(two_channels("small")), DiagnosisSettings(beam_orders=2)
    analysis = analysis_of(run, settings=settings, library=library)
    known = context(analysis, *campaign.learned(analysis, ask, 260, time_ordered=False))
    wide = config.Effect(name="beam_width", channel="V1", parameters={"amplitude": 0.3})
    maps = list(simulate.maps(survey(campaign.with_effects(run, [wide])), 0))
    with refused("wider", "ZeroDivisionError", by=HookError):
        diagnose_data(ObservedMaps(known, maps, ask), "wide")
