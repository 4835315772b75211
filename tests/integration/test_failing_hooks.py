"""A hook that fails at the amplitude of the data ends a diagnosis: it is no reason to call the gap unknown."""

import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest

from instruments import ask, two_channels
from mcsim import Effect, config, systematics
from mcsim.datavector import campaign
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import context
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.systematics import HookError
from refusals import refused

RUN = config.load(two_channels("small"))


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
        if abs(self.amplitude) > 0.4:
            raise ZeroDivisionError("of a user")
        return replace(beam, blm=beam.blm * np.exp(-self.amplitude * (np.arange(beam.lmax + 1.0) / 40.0) ** 2))


@pytest.fixture(scope="module")
def known():
    library = {"wider": Wider, "noise_level": systematics.get("noise_level")}
    analysis = analysis_of(RUN, settings=DiagnosisSettings(beam_orders=2), library=library)
    return context(analysis, *campaign.learned(analysis, ask, 260, time_ordered=False))


def observed(**amplitudes):
    """Return maps of effects of V1 by name, with their amplitudes."""
    acting = [
        config.Effect(name=name, channel="V1", parameters={"amplitude": size}) for name, size in amplitudes.items()
    ]
    return list(simulate.maps(survey(campaign.with_effects(RUN, acting)), 0))


def test_a_hook_that_fails_in_any_simulation_of_a_diagnosis_ends_it(known):
    """It was taken for an amplitude that cannot be: a set lost its response, or a reduction was "not measured"."""
    maps, answers, calls = observed(beam_width=0.05, noise_level=0.4), {}, []

    def recorded(jobs):
        calls.append(key := pickle.dumps(jobs))
        if key not in answers:
            answers[key] = list(ask(jobs))
        return answers[key]

    diagnose_data(ObservedMaps(known, maps, recorded), "both")
    asked = len(calls)
    assert asked > 20
    for last in range(asked, 0, -4):

        def failing(jobs, last=last):
            if len(calls) + 1 == last:
                raise HookError("effect of a user: its beam fails")
            return recorded(jobs)

        calls.clear()
        with refused("of a user", by=HookError):
            diagnose_data(ObservedMaps(known, maps, failing), "both")


def test_a_hook_that_fails_at_the_fitted_amplitude_ends_the_diagnosis(known):
    with refused("wider", "ZeroDivisionError", by=HookError):
        diagnose_data(ObservedMaps(known, observed(beam_width=0.6), ask), "wide")


def test_an_amplitude_that_cannot_be_said_ends_the_diagnosis(known, monkeypatch):
    """It was an amplitude that cannot be, in the list of candidates."""

    def failing(kind, amplitude, sigma=0.0):
        if sigma:
            raise HookError("effect wider: its format_amplitude fails")
        return "some"

    monkeypatch.setattr(Wider, "format_amplitude", classmethod(failing))
    with refused("wider", "format_amplitude", by=HookError):
        diagnose_data(ObservedMaps(known, observed(noise_level=0.4), ask), "loud")
