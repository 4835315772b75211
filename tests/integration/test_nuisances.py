"""A small instrument whose calibrations and noise are known to within a prior: maps, from beginning to end."""

import json
from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
import pytest
import tomli_w
from scipy.stats import ks_2samp

from instruments import ask, two_channels
from mcsim import config, systematics
from mcsim.datavector import campaign
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import seeded, with_effects
from mcsim.datavector.nuisances import Regression
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis import api, report, words
from mcsim.diagnosis.context import context
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.ensemble.maps import file_names
from mcsim.simulation import simulate
from mcsim.simulation.nuisance import draws, tables
from mcsim.simulation.survey import survey
from mcsim.stats.look_elsewhere import global_test
from pictures import quick_pictures

PROPOSED = ("beam_ellipticity", "calibration", "noise_level")
WITHOUT = tuple(name for name in systematics.catalogue() if name not in PROPOSED)
WIDTH, NOISE = 0.003, 0.03
MODEL = two_channels("company", sigma0_uk=60.0) | {
    "nuisance": [
        {"effect": effect, "channel": channel, "width": width}
        for channel in ("V1", "W1")
        for effect, width in (("calibration", WIDTH), ("noise_level", NOISE))
    ],
}
SIMULATIONS, SKIES = 400, 320
FILE = str(Path(__file__).parents[2] / "docs" / "howto" / "gain_step.py")


def small_analysis(run, *more):
    settings = DiagnosisSettings(including=(*PROPOSED, *more), scan_sims=60, beam_orders=2, response_modes=1 << 12)
    return analysis_of(run, without=[name for name in WITHOUT if name not in more], settings=settings)


@pytest.fixture(scope="module")
def run():
    return config.load(MODEL)


@pytest.fixture(scope="module")
def declared(run):
    analysis = small_analysis(run)
    return context(analysis, *campaign.learned(analysis, ask, SIMULATIONS, time_ordered=False))


@pytest.fixture(scope="module")
def undeclared(run, declared):
    """Only to show that it fails; responses are those of the model with nuisances, which these do not change."""
    analysis = small_analysis(replace(run, nuisances=()))
    quiet = data_vectors(replace(analysis.job(seeded(analysis.run, 13)), count=200, slices=True))
    vectors, slices = np.split(quiet, [len(analysis.elements)], axis=1)
    ensemble = replace(declared.ensemble, simulations=vectors, slices=slices, nuisances=None)
    return context(analysis, ensemble, declared.bank)


def maps_of(run, *effects, seed=77):
    return list(simulate.maps(survey(with_effects(seeded(replace(run, nuisances=()), seed), effects)), 0))


def calibration(amplitude):
    return config.Effect(name="calibration", channel="W1", parameters={"amplitude": amplitude})


ELLIPSE = config.Effect(name="beam_ellipticity", channel="W1", parameters={"amplitude": 0.5, "angle_deg": 20.0})


def test_p_is_uniform_over_the_prior_and_not_without_the_nuisances(declared, undeclared):
    job = replace(declared.analysis.job(seeded(declared.run, 12)), nuisances=True, count=SKIES)
    rows = data_vectors(job)
    p = {}
    for name, known in (("declared", declared), ("undeclared", undeclared)):
        p[name] = [global_test(known.null, x, known.always, known.calibration).pvalue for x in rows]
    # P-values are ranks among those of the simulations, a sample like that of the data.
    assert ks_2samp(p["declared"], np.arange(1.0, SIMULATIONS + 1.0) / (SIMULATIONS + 1.0)).pvalue > 1e-3
    alarms = np.mean(np.array(p["declared"]) <= 0.05)
    # Binomial, of the data and of the ranks of the simulations.
    assert abs(alarms - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 * (1.0 / SKIES + 1.0 / SIMULATIONS))
    assert np.mean(np.array(p["undeclared"]) <= 0.05) > 0.9
    # The posteriors have unit pulls: errors of the mean and width, and of the mean and covariance of the simulations.
    regression = Regression.of(declared.ensemble, declared.null)
    mean, sigma = (np.stack(one) for one in zip(*(regression.posterior(x, np.zeros(4)) for x in rows), strict=True))
    true = np.stack([draws(declared.analysis.nuisances, 12, r)[0] for r in range(SKIES)])
    pulls = (mean - true) / sigma
    assert np.all(
        np.abs(pulls.mean(axis=0)) < 4.0 * np.sqrt(1.0 / SKIES + (1.0 + declared.null.dimension) / SIMULATIONS)
    )
    assert np.all(np.abs(pulls.std(axis=0) - 1.0) < 0.15)
    assert np.all(sigma.mean(axis=0) < 0.6 * np.array([WIDTH, NOISE] * 2))


def test_an_effect_is_named_beside_nuisances_that_are_far_from_zero(run, declared, undeclared):
    drawn = tables(run, 5, 0)
    maps = maps_of(run, ELLIPSE, *drawn)
    data = ObservedMaps(declared, maps, ask)
    found = diagnose_data(data, "declared")
    assert [(one.name, one.channel) for one in found.effects] == [("beam_ellipticity", "W1")]
    # Templates are measured anew for the effect, and not for the gap: once the data were looked at it would be another.
    assert not np.array_equal(found.templates, declared.templates)
    assert found.test == global_test(declared.null, data.x, declared.always, declared.calibration)
    assert abs(found.effects[0].amplitude - 0.5) < 4.0 * found.effects[0].sigma
    for one, truth in zip(found.nuisances, drawn, strict=True):
        assert (one.name, one.channel) == (truth.name, truth.channel)
        assert abs(one.amplitude - truth.parameters["amplitude"]) < 4.0 * one.sigma
        assert one.sigma < 0.6 * one.prior_width
        assert abs(one.pull) < 4.0
    assert found.held_out.pvalue_after > 1e-3
    assert abs(found.held_out.achieved.value - found.held_out.predicted.value) < 4.0 * np.hypot(
        found.held_out.achieved.sigma, found.held_out.predicted.sigma
    )
    blind = diagnose_data(ObservedMaps(undeclared, maps, ask), "undeclared")
    assert [one.name for one in blind.effects] != ["beam_ellipticity"]
    assert blind.nuisances == ()


def test_a_calibration_far_beyond_its_prior_is_named(run, declared):
    within = diagnose_data(ObservedMaps(declared, maps_of(run, calibration(1.5 * WIDTH)), ask), "within")
    assert within.kind == "none"
    assert within.nuisances[2].amplitude == pytest.approx(1.5 * WIDTH, abs=4.0 * within.nuisances[2].sigma)
    beyond = diagnose_data(ObservedMaps(declared, maps_of(run, calibration(10.0 * WIDTH)), ask), "beyond")
    best = beyond.effects[0]
    assert [(one.name, one.channel) for one in beyond.effects] == [("calibration", "W1")]
    # Its error has the prior, which is part of the model, but for what 500 standard deviations change in the response.
    assert best.sigma > 0.5 * WIDTH
    assert best.amplitude == pytest.approx(10.0 * WIDTH, abs=4.0 * best.sigma)
    (alone,) = [one for one in beyond.candidates if (one.name, one.channel) == ("calibration", "W1")]
    assert alone.sigma == pytest.approx(best.sigma, rel=0.1)  # has the prior, too


def test_a_calibration_far_beyond_its_prior_is_no_dipole_and_no_ring_of_the_beam(run):
    # Its dipole changes products of residual and sky as this very sky has it, which no mean over skies shows.
    analysis = small_analysis(run, "dipole_residual", "beam_sidelobe")
    known = context(analysis, *campaign.learned(analysis, ask, SIMULATIONS, time_ordered=False))
    for seed, amplitude in ((77, 7.0 * WIDTH), (78, 10.0 * WIDTH)):
        found = diagnose_data(ObservedMaps(known, maps_of(run, calibration(amplitude), seed=seed), ask), "beyond")
        assert [[(one.name, one.channel) for one in own.effects] for own in found.sets] == [[("calibration", "W1")]]
        (best,) = found.effects
        assert WIDTH < best.sigma < 1.3 * WIDTH  # its prior, and what the data leave
        assert best.amplitude == pytest.approx(amplitude, abs=3.0 * best.sigma)


def test_the_command_lists_and_writes_nuisances(run, mcsim, tmp_path, monkeypatch):
    monkeypatch.setattr(api, "batch", lambda workers: campaign.batch(0))  # in this process
    monkeypatch.chdir(tmp_path)
    channel = MODEL["channel"][1]
    channels = [channel | {"scan": channel["scan"] | {"sample_period_s": 610.0}}]
    table = MODEL | {"map": {"nside": 8, "splits": ["a", "b"]}, "sky": MODEL["sky"] | {"lmax": 20}, "channel": channels}
    table["nuisance"] = MODEL["nuisance"][2:]
    (tmp_path / "model.toml").write_text(tomli_w.dumps(table))
    small = config.load("model.toml")
    (tmp_path / "data").mkdir()
    names = file_names(small)
    for name, map_uk in zip(config.map_names(small), maps_of(small, calibration(2.0 * WIDTH)), strict=True):
        healpy.write_map(tmp_path / "data" / names[name], map_uk, coord="E", column_units="uK", dtype=np.float64)

    without = [word for name in WITHOUT for word in ("--without", name)]
    code, said, _ = mcsim("diagnose", "model.toml", "data", "-o", "out", "--dry-run", *without)
    assert code == 0
    assert "nuisance: calibration of W1: 0.00 % ± 0.30 % of the gain" in said
    with quick_pictures(empty=True):
        code, said, _ = mcsim("diagnose", "model.toml", "data", "-o", "out", "--simulations", "150", *without)
    assert code == 0
    assert "nuisance      calibration of W1" in said
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    one, two = verdict["nuisances"]
    assert (one["name"], one["channel"], one["prior_width"]) == ("calibration", "W1", WIDTH)
    assert abs(one["amplitude"] - 2.0 * WIDTH) < 4.0 * one["sigma"]
    assert two["name"] == "noise_level"
    found = DiagnosisResult.open(tmp_path / "out")
    assert found.to_json() == verdict
    with quick_pictures(empty=True):
        assert "Known unknowns" in report.page(found)
    assert words.pulled(found.nuisances[0]).startswith("; pull ")
    assert mcsim("config", "model.toml")[0] == 0
    table["nuisance"] = [{"effect": "noise_level", "channel": "W1", "width": 0.5}]
    (tmp_path / "wide.toml").write_text(tomli_w.dumps(table))
    for command in (("config", "wide.toml"), ("diagnose", "wide.toml", "data", "-o", "new")):
        code, _, said = mcsim(*command)
        assert code == 2
        assert "noise_level" in said
        assert said.count("\n") == 1
    assert not (tmp_path / "new" / "verdict.json").exists()


def test_settings_without_nuisances_keep_the_verdict(run, undeclared):
    assert undeclared.ensemble.nuisances is None
    assert undeclared.calibration.held_out_combined is None
    found = diagnose_data(ObservedMaps(undeclared, maps_of(run), ask), "plain")
    assert "nuisances" not in found.to_json()


def test_a_nuisance_of_a_file_is_a_candidate(run):
    """It was none, and data beyond its prior ended in a KeyError of its name."""
    one = config.Nuisance(effect=FILE, width=(1e-3,), channel="V1")
    analysis = small_analysis(replace(run, nuisances=(one,)))
    assert ("gain_step", "V1") in {candidate.identity for candidate in analysis.candidates}
    assert "gain_step" in dict(analysis.library)
    settings, *_ = api._with_library(DiagnosisSettings(without=(FILE,)), run)
    assert settings.without == ("gain_step",)
