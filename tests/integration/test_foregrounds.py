"""The spectral index of a residual foreground: fitted where two differences of channels tell it, and only there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from instruments import ask, data_of, two_channels
from mcsim import config, systematics
from mcsim.datavector import campaign
from mcsim.datavector.analysis import Analysis, analysis_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import DiagnosisContext, context
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.stats.look_elsewhere import global_test

PROPOSED = ("foreground_residual", "noise_level", "dipole_residual", "calibration")
INDEX = 0.4


def small(clean: bool) -> Analysis:
    """Return the analysis of V1 and W1, with a map that has no foregrounds beside them on request."""
    table = two_channels("colour", lmax=20, nside=8, fwhm_arcmin=700.0)
    del table["map"]["splits"]
    table["map"]["frame"] = "galactic"
    if clean:
        table["channel"].append({**table["channel"][0], "name": "CMB", "frequency_ghz": 143.0, "foregrounds": False})
    without = [name for name in systematics.catalogue() if name not in PROPOSED]
    settings = DiagnosisSettings(
        scan_sims=60, beam_orders=1, split_beam_orders=1, response_modes=1 << 12
    )  # nothing here is of a beam
    return analysis_of(config.load(table), without=without, settings=settings)


@pytest.fixture(scope="module")
def three() -> DiagnosisContext:
    analysis = small(clean=True)
    return context(analysis, *campaign.learned(analysis, ask, 300, time_ordered=False))


def test_an_index_is_a_coordinate_where_the_channels_tell_it() -> None:
    for clean, columns in ((True, 2), (False, 1)):
        (own,) = [one for one in small(clean).candidates if one.name == "foreground_residual"]
        assert len(own.columns) == columns
    run = small(clean=True).run
    declared = replace(run, nuisances=(config.Nuisance(effect="foreground_residual", width=(2.0,)),))
    (own,) = [one for one in analysis_of(declared).candidates if one.name == "foreground_residual"]
    assert len(own.columns) == 1


@pytest.mark.slow
def test_no_gap_where_there_is_none(three: DiagnosisContext) -> None:
    shared = data_of(three.run)
    p = [
        global_test(three.null, three.analysis.data_vector(maps), three.always, three.calibration).pvalue
        for maps in (list(simulate.maps(shared, number)) for number in range(100))
    ]
    # 13 of 100 uniform numbers or more are below 0.05 in one case of 700; and Kolmogorov-Smirnov.
    assert np.sum(np.array(p) <= 0.05) < 13
    assert kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.slow
def test_amplitude_and_index_of_drawn_patterns_are_found(three: DiagnosisContext) -> None:
    truth = 3.0  # 34 of 40 are named alone; twice as bright, half are: single patterns leave more than 48 draws tell
    shared = data_of(three.run, "foreground_residual", amplitude=truth, spectral_index=INDEX)
    pulls, named, cases = [], 0, 4
    for number in range(cases):
        found = diagnose_data(ObservedMaps(three, list(simulate.maps(shared, number)), ask), str(number))
        if [one.name for one in found.effects] != ["foreground_residual"]:
            continue
        (own,) = found.verdict["effects"]
        assert own["amplitude"] / own["sigma"] > 5.0
        named += 1
        index = (own["parameters"]["spectral_index"] - INDEX) / own["errors"]["spectral_index"]
        pulls.append([(own["amplitude"] - truth) / own["sigma"], index])
        assert "±" in found.effects[0].words.split("index")[1]
    assert named > cases // 2
    # The mean square of n pulls is 1 with an error of sqrt(2 / n): 3.5 sigma.
    assert np.all(np.mean(np.square(pulls), axis=0) < 1.0 + 3.5 * np.sqrt(2.0 / named))


@pytest.mark.slow
def test_an_index_that_cannot_be_told_is_said_not_to_be_fitted() -> None:
    analysis = small(clean=False)
    known = context(analysis, *campaign.learned(analysis, ask, 300, time_ordered=False))
    shared = data_of(known.run, "foreground_residual", amplitude=3.0, spectral_index=2.0)
    (own,) = diagnose_data(ObservedMaps(known, list(simulate.maps(shared, 0)), ask), "two").effects
    assert own.name == "foreground_residual"
    assert own.words.endswith("index 2 (not fitted)")
    assert own.errors == {}
