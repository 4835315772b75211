"""Controls of a diagnosis: perfect data at higher fidelity, which a right model describes and a wrong one does not."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import mcsim
from mcsim import cli, config
from mcsim.datavector.analysis import analysis_of, kinds_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis import controls, words
from mcsim.diagnosis.api import describe
from mcsim.diagnosis.control_result import Control, Controls
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.support.folders import default_cache_dir
from pictures import quick_pictures
from refusals import refused

PROPOSED = ("noise_level", "dipole_modulation")
WITHOUT = tuple(name for name in mcsim.effects() if name not in PROPOSED)
COUNT = 6


def settings(**changes):
    return DiagnosisSettings(
        without=WITHOUT, simulations=160, scan_sims=40, beam_orders=1, split_beam_orders=1, **changes
    )


def model(lmax, fine=32, scan="parallel_transport"):
    """Return a model whose maps of nside 8 are means of finer pixels, or are made as they are."""
    scans = {
        "parallel_transport": {"kind": "parallel_transport"},
        "hit_averaged": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 300.0, "line_of_sight": "A"},
    }
    run = {
        "name": "controlled",
        "sky": {"spectrum": "wmap7", "lmax": lmax},
        "map": {"nside": fine},
        "channel": [
            {
                "name": "V",
                "beam": {"kind": "gaussian", "fwhm_arcmin": 200.0},
                "noise": {"sigma0_uk": 40.0 * (fine / 8 if scan == "parallel_transport" else 10.0)},
                "scan": scans[scan],
            }
        ],
        "biposh": {"L_max": 2, "lmax": 16},
    }
    return config.load(run if fine == 8 else run | {"preparation": [{"kind": "degrade", "nside": 8}]})


def data_of(run):
    return list(simulate.maps(survey(replace(run, ensemble=replace(run.ensemble, seed=77))), 0))


def diagnosed(run, output, count, workers=0):
    with quick_pictures(empty=True):
        return mcsim.diagnose(run, data_of(run), output, settings=settings(controls=count), workers=workers)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Tests that run beside each other would draw each other's controls in one cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MCSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def sound(tmp_path_factory, cache):
    """A model that simulates what its pixels see, and its diagnosis with controls."""
    folder = tmp_path_factory.mktemp("sound")
    return diagnosed(model(50), folder, COUNT), folder


def test_a_right_model_describes_its_controls(sound):
    found, folder = sound
    assert not found.controls.failed
    assert found.warnings == ()
    assert found.settings.controls == COUNT
    said = json.loads((folder / "verdict.json").read_text())["controls"]
    assert [one["p_value"] for one in said["members"]] == [one.pvalue for one in found.controls.members]
    assert len(said["members"]) == COUNT
    assert said["failed"] is False
    # The pixels are finer than the model's, as is the sky; the names of the maps and their size are the same.
    assert "map.nside = 128" in said["drawn"]
    lines = words.summary(found, folder)
    assert sum(line.startswith("controls") for line in lines) == 1
    assert 'id="controls"' in (folder / "report.html").read_text()
    assert DiagnosisResult.open(folder).controls == found.controls


def test_a_model_that_lacks_sky_fails_and_says_so_first(tmp_path):
    found = diagnosed(model(18, fine=8), tmp_path, 3)
    assert found.controls.failed
    said = json.loads((tmp_path / "verdict.json").read_text())
    assert said["controls"]["failed"] is True
    first = said["warnings"][0]
    assert first.startswith("The model fails its controls")
    assert words.summary(found, tmp_path)[0] == f"warning       {first}"
    page = (tmp_path / "report.html").read_text()
    assert page.index("The model fails its controls") < page.index("<h1>")


def test_controls_are_drawn_once_and_go_on_after_a_kill(sound, client, monkeypatch):
    found, _ = sound
    drawn, diagnosed_ = [], controls.diagnose_data
    draw = controls.draw
    monkeypatch.setattr(controls, "draw", lambda *all_: (drawn.append(all_[4]), draw(*all_)))
    assert diagnosed(model(50), None, 2).controls.members == found.controls.members[:2]
    assert drawn == []

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(controls, "diagnose_data", killed)
    with pytest.raises(KeyboardInterrupt):
        diagnosed(model(50), None, COUNT + 1)
    assert drawn == [COUNT]
    monkeypatch.setattr(controls, "diagnose_data", diagnosed_)
    more = diagnosed(model(50), None, COUNT + 1).controls
    assert drawn == [COUNT]  # its maps were there already
    assert more.members[:COUNT] == found.controls.members
    monkeypatch.setattr(controls, "draw", draw)
    assert diagnosed(model(50), None, COUNT + 2, workers=client).controls.members[:-1] == more.members


def test_two_diagnoses_at_once_share_their_controls(sound, monkeypatch):
    """The slower one said that workers do not share a cache; an empty verdict, of a computer that stopped, ended it."""
    found, _ = sound
    draw, quicker = controls.draw, []

    def drawn_by_both(*all_):
        monkeypatch.setattr(controls, "draw", draw)
        quicker.append(diagnosed(model(50), None, COUNT + 4).controls)
        draw(*all_)

    monkeypatch.setattr(controls, "draw", drawn_by_both)
    assert diagnosed(model(50), None, COUNT + 4).controls == quicker[0]
    (folder,) = {path.parent for path in default_cache_dir().glob(f"controls/*/{COUNT + 3:05d}.json")}
    assert all(path.is_file() for path in folder.iterdir())  # no maps are left
    (folder / "00001.json").write_bytes(b"")
    assert diagnosed(model(50), None, COUNT).controls.members == found.controls.members


def test_finer_pixels_keep_the_noise_of_coarse_ones():
    analysis = analysis_of(model(45), WITHOUT)
    found = controls.fidelity(analysis)
    assert (found.run.map.nside, found.sample_by_sample, found.samples) == (128, False, 0)
    assert found.run.sky.lmax > 45
    own, fine = (one.channels[0].maps[0].noise_uk for one in (analysis.model.survey, found.survey))
    np.testing.assert_allclose(fine, own, rtol=1e-12)
    text = describe(model(45), settings(controls=2))
    assert "control 2 data sets with" in text
    assert re.search(r" m?s each, [0-9.]+ m?s on \d cores?,", text)


def test_a_known_scan_is_drawn_sample_by_sample(tmp_path):
    run = model(45, scan="hit_averaged")
    analysis = analysis_of(run, WITHOUT)
    found = controls.fidelity(analysis)
    assert (found.run.map.nside, found.sample_by_sample) == (run.map.nside, True)
    assert found.run.sky.lmax > 45
    assert found.samples == analysis.model.survey.making.channels[0].maps[0].moments.hits.sum()
    for by_sample in (True, False):
        controls.draw(config.to_json(found.run), "", analysis.library, by_sample, 0, str(tmp_path / str(by_sample)))
    one, other = (np.load(tmp_path / name / "maps.npy")[0] for name in ("True", "False"))
    noise = analysis.model.survey.channels[0].maps[0].noise_uk
    # The same sky and other noise: 768 pixels give its rms to 2.6 %; what the samples see within a pixel is less.
    assert np.sqrt(np.mean((one - other) ** 2 / (2.0 * noise**2))) == pytest.approx(1.0, abs=0.1)


def test_a_file_that_has_changed_is_read_again(tmp_path):
    """Four times the power of the sky is twice its maps, in the process that drew the first one, too."""
    run, rms = model(45), []
    ell = np.arange(2, 46)
    run = replace(
        run, sky=replace(run.sky, spectrum=str(tmp_path / "cl.txt")), channels=(run.channels[0].without_noise(),)
    )
    for factor in (1.0, 4.0):
        np.savetxt(tmp_path / "cl.txt", np.stack([ell, factor * 1e3 / (ell * (ell + 1))], axis=1))
        folder = tmp_path / f"{factor:g}"
        controls.draw(config.to_json(run), config.digest(run, "nuisance"), kinds_of(None), False, 0, str(folder))
        rms.append(np.std(np.load(folder / "maps.npy")))
    assert rms[1] == pytest.approx(2.0 * rms[0], rel=1e-9)


def test_controls_fail_by_one_p_value_or_by_all():
    def of(*pvalues):
        return Controls(tuple(Control(p, "none", ()) for p in pvalues), "x", 0.05, 1000)

    even = np.linspace(0.05, 0.95, 10)
    assert not of(*even).failed
    assert of(*even[1:], 9e-4).failed
    assert not of(*even[1:], 2e-3).failed
    assert of(*np.linspace(0.3, 0.5, 10)).failed
    found = of(*even[1:], 2e-3)
    assert found.false_alarms == 1
    assert found.interval == pytest.approx((0.00253, 0.445), abs=1e-3)  # Clopper and Pearson, 1 of 10
    assert of(0.5).to_json()["smallest_p_value"] == 0.5


def test_controls_that_cannot_be_drawn_are_refused(monkeypatch, capsys, tmp_path):
    with refused("controls", -1):
        mcsim.diagnose(model(50), [], settings=settings(controls=-1))
    with refused("controls", "table"):
        controls.check(3, of_maps=False)
    with refused("controls", 3):
        controls.check(3, of_maps=True, external=True)
    with refused("loud", by=TypeError):
        mcsim.diagnose(model(50), [], loud=True)
    monkeypatch.setattr("sys.argv", ["mcsim", "diagnose", "tiny", "x", "-o", "y", "--workers", "2", "--scheduler", "z"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "--workers and --scheduler exclude each other" in capsys.readouterr().err
