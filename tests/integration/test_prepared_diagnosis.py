"""Diagnosis of maps that were prepared: what the model declares is done to its simulations, and its limits are said."""

import json
from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.config.preparation import Rotate
from mcsim.datavector import campaign
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis import api, report, words
from mcsim.diagnosis.api import describe
from mcsim.ensemble import plan
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from pictures import quick_pictures

PROPOSED = ("beam_ellipticity", "noise_level", "dipole_modulation")
WITHOUT = tuple(name for name in mcsim.effects() if name not in PROPOSED)
SETTINGS = DiagnosisSettings(without=WITHOUT, scan_sims=50, beam_orders=2)
FINE, COARSE = 16, 8
MASK = (np.abs(healpy.pix2vec(COARSE, np.arange(12 * COARSE**2))[2]) > 0.25).astype(float)


def model(lmax=44, steps=True):
    channels = [
        {
            "name": name,
            "frequency_ghz": frequency,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 450.0},
            "noise": {"sigma0_uk": 300.0},
            "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 121.0, "line_of_sight": line},
        }
        for name, frequency, line in (("V1", 61.0, "A"), ("W1", 94.0, "B"))
    ]
    run = {
        "name": "prepared",
        "sky": {"spectrum": "wmap7", "lmax": lmax},
        "map": {"nside": FINE if steps else COARSE, "mask": MASK},
        "biposh": {"L_max": 2, "lmax": 16},
        "channel": channels,
        "preparation": [
            {"kind": "degrade", "nside": COARSE},
            {"kind": "subtract_dipole", "mask": MASK},
        ],
    }
    if not steps:
        del run["preparation"]
    return config.load(run)


def data(run, *effects, seed=99):
    """Return maps of another seed and of all the sky that the fine pixels hold, prepared by the public function."""
    made = replace(
        run,
        preparation=(),
        map=replace(run.map, mask=None),
        sky=replace(run.sky, lmax=3 * FINE - 1),
        ensemble=replace(run.ensemble, seed=seed),
        effects=effects,
    )
    return mcsim.prepare(list(simulate.maps(survey(made), 0)), run)


def diagnosed(run, maps, folder=None, simulations=240):
    with quick_pictures(empty=True):
        return mcsim.diagnose(run, maps, folder, settings=replace(SETTINGS, simulations=simulations))


@pytest.fixture(autouse=True)
def here(monkeypatch):
    """Simulate in this process."""
    monkeypatch.setattr(api, "batch", lambda workers: campaign.batch(0))


@pytest.fixture(scope="module")
def maps():
    """Prepared maps without an effect."""
    return data(model())


@pytest.mark.slow
def test_prepared_maps_of_the_model_agree_with_it_and_an_effect_is_found(maps, tmp_path):
    run = model()
    found = diagnosed(run, maps, tmp_path)
    assert found.test.pvalue > 0.01
    assert found.warnings == ()
    assert "warnings" not in json.loads((tmp_path / "verdict.json").read_text())
    noise = config.Effect(name="noise_level", channel="W1", parameters={"amplitude": 0.3})
    louder = diagnosed(run, data(run, noise))
    assert [(effect.name, effect.channel) for effect in louder.effects] == [("noise_level", "W1")]
    assert abs(louder.effects[0].amplitude - 0.3) < 4.0 * louder.effects[0].sigma


@pytest.mark.slow
def test_noise_in_common_to_prepared_maps_is_told():
    """What it does is simulated in the pixels in which maps are made, not in those of prepared maps."""
    run = model()
    made = survey(replace(run, preparation=(), map=replace(run.map, mask=None)))
    sky = np.array(simulate.maps(made.without_noise, 0))
    noise = np.array(simulate.maps(made, 0)) - sky
    v1, w1 = (one.noise_uk for one in made.maps)
    noise[1] = 0.8 * w1 / v1 * noise[0] + 0.6 * noise[1]
    found = diagnosed(run, mcsim.prepare(list(sky + noise), run))
    assert found.kind == "unknown"
    (sentence,) = found.orders
    correlation, sigma = map(float, sentence.rpartition("correlation ")[2].rstrip(").").split(" ± "))
    assert abs(correlation - 0.8) < 3.0 * sigma < 0.4


@pytest.mark.slow
def test_a_model_that_lacks_power_of_the_sky_is_told_so(maps, tmp_path):
    """Without the steps and the power above l = 20. Nothing of the verdict is asked, so few simulations will do."""
    bare = diagnosed(model(20, steps=False), maps, tmp_path, 200)
    assert len(bare.warnings) == 1
    assert "set sky.lmax to" in bare.warnings[0]
    assert json.loads((tmp_path / "verdict.json").read_text())["warnings"] == list(bare.warnings)
    assert words.summary(bare, tmp_path)[0].startswith("warning")
    with quick_pictures(empty=True):
        assert "Warning: sky.lmax = 20" in report.page(bare)
    assert mcsim.diagnosis.result.DiagnosisResult.open(tmp_path).warnings == bare.warnings
    assert describe(model(20, steps=False), SETTINGS).splitlines()[-1] == f"warning: {bare.warnings[0]}"
    assert "warning" not in describe(model(), SETTINGS)


def test_the_cost_of_a_preparation_is_said():
    run = model()
    smooth = config.preparation.Smooth(fwhm_arcmin=300.0)
    smoothed = replace(run, preparation=(smooth, *run.preparation))
    assert "prepare 0 further transforms" in plan.describe(config.to_dict(run))
    # Two channels, map and control, four transforms each.
    assert "prepare 16 further transforms" in plan.describe(config.to_dict(smoothed))
    text = describe(run, SETTINGS)
    assert f"nside {FINE} to {COARSE}" in text
    assert "further transforms" not in plan.describe(config.to_dict(model(steps=False)))


TOML = """
schema = 1
name = "cli"
[sky]
spectrum = "wmap7"
lmax = {lmax}
[map]
nside = 32
[[channel]]
name = "V"
beam = {{ kind = "gaussian", fwhm_arcmin = 240.0 }}
noise = {{ sigma0_uk = 30.0 }}
scan = {{ kind = "parallel_transport" }}
[[preparation]]
kind = "degrade"
nside = 8
[biposh]
lmax = 16
"""


def test_commands_prepare_maps_and_refuse_too_little_sky(mcsim, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "enough.toml").write_text(TOML.format(lmax=60))
    (tmp_path / "low.toml").write_text(TOML.format(lmax=18))
    healpy.write_map("V.fits", np.arange(12.0 * 32**2), dtype=np.float64, column_units="uK")
    code, said, _ = mcsim("prepare", "enough.toml", "V.fits", "-o", "out")
    assert (code, said.strip()) == (0, f"wrote {Path('out/V.fits')}")
    assert np.array_equal(healpy.read_map("out/V.fits"), healpy.ud_grade(healpy.read_map("V.fits"), 8))
    assert mcsim("predict", "enough.toml")[0] == 0
    for command in (("predict", "low.toml"), ("run", "low.toml"), ("diagnose", "low.toml", "out", "-o", "verdict")):
        code, _, said = mcsim(*command)
        assert code == 2
        assert said.count("\n") == 1
        assert "set sky.lmax to" in said
    assert {path.name for path in tmp_path.iterdir()} == {"V.fits", "enough.toml", "low.toml", "out"}


def test_a_direction_is_told_in_the_frame_that_it_is_in():
    """An effect acts on maps as they are made: its ecliptic direction was called galactic, as turned maps are."""
    run = model(lmax=16, steps=False)
    turning = (Rotate(frame="galactic"),)
    run = replace(run, map=replace(run.map, mask=None, splits=("half1", "half2")), preparation=turning)
    there = {"amplitude": 40.0, "lon_deg": 40.0, "lat_deg": 20.0}
    acting = (config.Effect(name="dipole_residual", channel="V1", parameters=there),)
    made = replace(run, ensemble=replace(run.ensemble, seed=9), effects=acting)
    proposed = ("dipole_residual", "monopole_residual")
    without = tuple(name for name in mcsim.effects() if name not in proposed)
    settings = DiagnosisSettings(without=without, scan_sims=50, beam_orders=1, simulations=120)
    found = mcsim.diagnose(run, list(simulate.maps(survey(made), 0)), settings=settings).sets[0].effects[0]
    toward = healpy.ang2vec(found.parameters["lon_deg"], found.parameters["lat_deg"], lonlat=True)
    assert np.rad2deg(np.arccos(toward @ healpy.ang2vec(40.0, 20.0, lonlat=True))) < 15.0
    assert found.words.endswith("(ecliptic)")
