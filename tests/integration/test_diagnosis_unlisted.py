"""After an unknown gap it is said what is missing, with its size, and what it removes."""

import json
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import healpy
import numpy as np
import pytest

from instruments import ask, data_of, learned_small, scored
from mcsim import systematics
from mcsim.diagnosis import report, unlisted, words
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.reconstruction import simulated_scores
from mcsim.simulation import simulate
from mcsim.sphere import real
from pictures import quick_pictures


@pytest.fixture(scope="module")
def small():
    return learned_small()


def test_a_described_pattern_has_its_size(small):
    """A quadrupole of one channel: by which of two channels, nothing tells, but by how much they differ."""
    data = data_of(small.run)
    maps = list(simulate.maps(data, 1))
    pattern = real.field(np.array([0, 0, 0, 0, 0.3, -0.5, 2.0, 0.4, 0.6]), *healpy.pix2vec(16, np.arange(12 * 16**2)))
    seen = healpy.alm2map(healpy.almxfl(healpy.map2alm(pattern, 40), data.channels[0].response.factors[0].real), 16)
    maps[:2] = [one + 2.0 * seen for one in maps[:2]]
    model = small.analysis.model
    scene = simulated_scores.scene_for(small.analysis.job(small.run))

    search = simulated_scores.search_of(small.analysis, scene, scored)
    (first, *_), _ = unlisted.structures_of(ObservedMaps(small, maps, ask), scene, search, scored)
    assert (first.stage, first.frame, first.index) == ("added", "sky", None)
    size = float(np.std(2.0 * seen))
    assert first.relative_error < 0.1
    assert abs(first.rms_uk / size - 1.0) < 4.0 * first.relative_error
    noise = [sum(part.precision for part in model.parts if part.channel == k) for k in (0, 1)]
    expected = float(np.sum((2.0 * seen) ** 2 / (1.0 / noise[0] + 1.0 / noise[1])))
    assert abs(1.0 / first.relative_error**2 - expected) < 4.0 * np.sqrt(4.0 * expected)


def test_an_unlisted_effect_is_described_written_and_shrinks(small, tmp_path, monkeypatch):
    """A gain that follows the year, which the library of this instrument does not have.

    It multiplies sky and dipole. That of the sky alone is twice its error here: whether it is told is chance.
    """
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    shared = data_of(small.run, "gain_drift", "W1", amplitude=1.5e-3, phase_deg=40.0)
    data = ObservedMaps(small, list(simulate.maps(shared, 0)), ask)
    before = diagnose_data(data, "drift")
    assert before.kind == "unknown"
    assert before.unlisted is None
    found = unlisted.reconstructed(before, data, scored)
    first = found.unlisted[0]
    assert (first.stage, first.frame, first.kind, first.channel) == ("gain", "time", "year 1", "W1")
    assert "sky and dipole" in (first.acts_on, (first.rival or {}).get("acts_on"))
    assert first.pvalue < 1e-4
    assert "annual gain drift" in first.cause
    assert found.unlisted_held_out.achieved.value > 0.5
    # The rms of what the gain makes of the dipole and the sky, within the error of the amplitude and of the shape.
    clean = data_of(small.run)
    rows = [np.array(list(simulate.maps(one, 0))) for one in (shared, clean)]
    expected = float(np.sqrt(np.mean((rows[0] - rows[1])[2:] ** 2)))
    assert abs(first.rms_uk / expected - 1.0) < 4.0 * first.relative_error
    found.save(tmp_path / "out")
    opened = DiagnosisResult.open(tmp_path / "out")
    assert (opened.unlisted, opened.unlisted_held_out) == (found.unlisted, found.unlisted_held_out)
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert verdict["unlisted"][0]["file"] == "unlisted_1.py"
    assert verdict["unlisted_shrink"]["achieved"] == found.unlisted_held_out.achieved.value
    kind = systematics.get(str(tmp_path / "out" / "unlisted_1.py"))
    made, times, site = kind(amplitude=1.0), np.linspace(0.0, 3e7, 50), data_of(small.run).channels[1].site
    theta, phi = (np.full(50, angle) for angle in healpy.vec2dir(site.dipole_uk))
    of_dipole = made.signal(times, theta, phi, np.zeros(50), site)
    wave = made.gain(times, site) if "sky" in first.acts_on else of_dipole / np.linalg.norm(site.dipole_uk)
    truth = 1.5e-3 * np.cos(2.0 * np.pi * times / 31558149.8 - np.deg2rad(40.0))
    assert np.sqrt(np.mean((wave - truth) ** 2)) < 4.0 * first.relative_error * np.sqrt(np.mean(truth**2))
    lines = words.summary(found, tmp_path / "out")
    assert sum(line.startswith("missing") for line in lines) == len(found.unlisted) + 1
    assert first.sentence in words.unlisted(found)
    with quick_pictures(empty=True):
        assert first.says in report.page(found)


@pytest.mark.parametrize("hiding", [[], ["noise level of V1"]])
def test_nothing_beside_nuisances_has_a_note(hiding, monkeypatch):
    """Of some nuisances maps cannot be rid: nothing found beside them is no finding."""

    @dataclass(frozen=True)
    class Result:
        notes: tuple[str, ...] = ("first",)
        nuisances: tuple[()] = ()
        unlisted: tuple[()] | None = None
        unlisted_held_out: None = None

    for name, value in (("scene_for", None), ("search_of", None), ("structures_of", ((), None))):
        monkeypatch.setattr(unlisted, name, lambda *_, value=value: value)
    nuisances = [SimpleNamespace(title="calibration of W1", subtractable=True)]
    nuisances += [SimpleNamespace(title=title, subtractable=False) for title in hiding]
    analysis = SimpleNamespace(run=None, nuisances=nuisances, job=lambda _: None, settings=None)
    found = unlisted.reconstructed(Result(), SimpleNamespace(context=SimpleNamespace(analysis=analysis)), None)
    assert found.unlisted == ()
    notes = (unlisted.HIDDEN.format(" and ".join(hiding)),) if hiding else ()
    assert found.notes == ("first", *notes)
