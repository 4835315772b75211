"""What is missing beside nuisances that the maps measure well: they are taken from the maps before the search."""

import numpy as np
import pytest

from instruments import ask, data_of, learned, scored, two_channels
from mcsim import config
from mcsim.datavector.campaign import with_effects
from mcsim.diagnosis import unlisted
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.reconstruction import simulated_scores
from mcsim.reconstruction.fitted_nuisances import FittedNuisances
from mcsim.simulation import simulate
from mcsim.simulation.nuisance import tables

SEED = 78


@pytest.fixture(scope="module")
def model():
    """Return what is learned of an instrument whose calibrations are uncertain by 0.2 % (S/N about 85)."""
    calibrations = [{"effect": "calibration", "channel": name, "width": 0.002} for name in ("V1", "W1")]
    return learned({**two_channels("small"), "nuisance": calibrations}, "calibration")


@pytest.fixture(scope="module")
def scene(model):
    return simulated_scores.scene_for(model.analysis.job(model.run))


def observed(model, realization, *effects):
    """Return maps of the model with a draw of its nuisances, and with effects."""
    run = with_effects(model.run, tables(model.run, SEED, realization))
    maps = list(simulate.maps(data_of(with_effects(run, effects), seed=SEED), realization))
    return ObservedMaps(model, maps, ask)


def fitted(data):
    """Return the nuisances as a diagnosis of the data finds them."""
    found = diagnose_data(data, "nuisances").nuisances
    return FittedNuisances.of(data.same_skies, [(one.amplitude, one.sigma) for one in found])


def test_a_drift_is_described_beside_calibrations(model):
    """Its size is that of the truth, and the same as of a model without nuisances."""
    drift = config.Effect(name="gain_drift", channel="W1", parameters={"amplitude": 1.5e-3, "phase_deg": 40.0})
    data, plain = observed(model, 0, drift), observed(model, 0)
    before = diagnose_data(data, "drift")
    assert before.kind == "unknown"
    found = unlisted.reconstructed(before, data, scored)
    (first,) = found.unlisted
    assert (first.stage, first.frame, first.kind, first.channel) == ("gain", "time", "year 1", "W1")
    assert first.pvalue < 1e-6
    assert found.unlisted_held_out.achieved.value > 0.5
    change = np.subtract(data.data, plain.data)[2:]  # of W1
    assert abs(first.rms_uk / np.sqrt(np.mean(change**2)) - 1.0) < 4.0 * first.relative_error


def test_scores_do_not_depend_on_what_the_nuisances_are(model, scene):
    """The same sky and noise with calibrations of 0 and of two prior widths: they are taken from the maps.

    Before, scores differ by 85 errors for each width. Of the prior 1/7000 of the variance of a calibration is left.
    """
    search = simulated_scores.search_of(model.analysis, scene, scored)
    found = []
    for size in (0.0, 0.004):
        effects = [config.Effect(name="calibration", channel="V1", parameters={"amplitude": size})]
        run = with_effects(model.run, effects if size else ())
        data = ObservedMaps(model, list(simulate.maps(data_of(run, seed=SEED), 5)), ask)
        known = fitted(data)
        marginal = known.marginal(search, scene)
        raw = simulated_scores.scores_of_maps(model.analysis.model, scene, data.data)
        clean = simulated_scores.scores_of_maps(model.analysis.model, scene, known.clean.maps)
        found.append((raw, marginal.of(clean, known.z), known.marginalised(search, marginal).simulations.std(axis=0)))
    (raw_0, clean_0, spread), (raw_1, clean_1, _) = found
    measured = spread > 0.0
    assert np.max(np.abs(raw_1 - raw_0)[measured] / spread[measured]) > 100.0
    assert np.max(np.abs(clean_1 - clean_0)[measured] / spread[measured]) < 1.0


def test_perfect_maps_with_nuisances_have_nothing(model, scene):
    """The best evidence of each is one that maps of the model have: none of ten has p <= 0.01."""
    search, pvalues = simulated_scores.search_of(model.analysis, scene, scored), []
    for realization in range(10, 20):
        data = observed(model, realization)
        known = fitted(data)
        marginal = known.marginal(search, scene)
        x = marginal.of(simulated_scores.scores_of_maps(model.analysis.model, scene, known.clean.maps), known.z)
        own = known.marginalised(search, marginal)
        pvalues.append(own.pvalue(own.evidences(x).max()))
    assert min(pvalues) > 0.01
