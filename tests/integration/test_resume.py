"""A diagnosis that is killed while it learns a model goes on where it stopped."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.datavector import campaign
from mcsim.datavector.analysis import analysis_for, data_vectors
from mcsim.datavector.kept import Kept
from mcsim.diagnosis import api, words
from mcsim.errors import RunError
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.support.npy import write_npy
from refusals import refused

MODEL = {
    "schema": 1,
    "name": "small",
    "sky": {"spectrum": "wmap7", "lmax": 24},
    "map": {"nside": 16, "splits": ["a", "b"]},
    "biposh": {"L_max": 1},
    "compute": {"workers": 1},
    "channel": [
        {
            "name": "V",
            "beam": {"kind": "gaussian", "fwhm_arcmin": 500.0},
            "noise": {"sigma0_uk": 30.0},
            "scan": {"kind": "parallel_transport"},
        }
    ],
}
LIBRARY = {name: kind for name, kind in mcsim.effects().items() if name in ("beam_width", "noise_level")}
SMALL = {"beam_orders": 1, "split_beam_orders": 1, "sky_bins": 4, "scan_L_max": 1, "scan_bins": 1, "scan_sims": 20}
SETTINGS = mcsim.DiagnosisSettings(library=LIBRARY, **SMALL)


class Killed(BaseException):
    """What no code catches."""


class Counted:
    """Simulate in this process; count the skies of each purpose, and stop after so many jobs."""

    def __init__(self, monkeypatch, stop=None):
        self.rows, self.left = [], stop
        batch = campaign.batch
        monkeypatch.setattr(api, "batch", lambda workers: batch(0))
        monkeypatch.setattr(api, "data_vectors", self)

    def __call__(self, job):
        if self.left is not None:
            self.left -= 1
            if self.left < 0:
                raise Killed
        self.rows += [(job.simulated, job.bipolar_scan, n) for n in range(job.first, job.first + job.count)]
        return campaign.data_vectors(job)


def data():
    run = config.load(MODEL)
    return list(simulate.maps(survey(replace(run, ensemble=replace(run.ensemble, seed=5))), 0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What was simulated without an interruption, and the result."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MCSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        counted = Counted(patch)
        return mcsim.diagnose(MODEL, data(), settings=SETTINGS), sorted(counted.rows)


def test_what_was_simulated_is_not_simulated_again_and_the_result_is_the_same(monkeypatch, tmp_path, whole):
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path))
    maps, rows = data(), []
    assert "  cache   " not in api.describe(config.load(MODEL), SETTINGS)
    for stop in (1, 7, 12):
        with monkeypatch.context() as patch:
            counted = Counted(patch, stop)
            with pytest.raises(Killed):
                mcsim.diagnose(MODEL, maps, settings=SETTINGS)
        rows += counted.rows
        assert list(tmp_path.glob("diagnose/*.parts/*/*.npy"))
        assert f"has {len(rows)} of these simulations" in api.describe(config.load(MODEL), SETTINGS)
    with monkeypatch.context() as patch:
        counted = Counted(patch)
        found = mcsim.diagnose(MODEL, maps, settings=SETTINGS)
    assert not list(tmp_path.glob("diagnose/*.parts"))
    assert sorted(rows + counted.rows) == whole[1]
    assert "none of them is left to do" in api.describe(config.load(MODEL), SETTINGS)
    for field in ("mean", "standard_deviation", "templates", "held_out_pvalues", "data", "residual_maps"):
        np.testing.assert_array_equal(getattr(found, field), getattr(whole[0], field))
    assert found.test == whole[0].test


def test_a_first_verdict_is_followed_by_the_whole_one_without_another_simulation(monkeypatch, tmp_path, whole):
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path))
    first = mcsim.DiagnosisSettings.quick(library=LIBRARY, **SMALL)
    assert first.of_a_simulation() == SETTINGS.of_a_simulation()
    with monkeypatch.context() as patch:
        counted = Counted(patch)
        early, late = (mcsim.diagnose(MODEL, data(), settings=one) for one in (first, SETTINGS))
    assert sorted(counted.rows) == whole[1]
    assert late.test == whole[0].test
    assert not list(tmp_path.glob("diagnose/*.parts"))
    # The first verdict has fewer simulations; those of both are worth more than they are.
    assert early.simulations < late.simulations < late.verdict["worth"]
    worth = early.verdict["worth"]
    assert worth > early.simulations
    assert early.kind == late.kind == "none"
    assert early.excess.value == pytest.approx(late.excess.value, abs=early.excess.sigma)
    assert f"is worth {worth} of a sample" in words.tested(early)


def test_with_nuisances_a_first_verdict_has_the_simulations_of_a_sample_covariance():
    assert mcsim.DiagnosisSettings.quick().without_shrinkage().sims_per_element == 10
    assert mcsim.DiagnosisSettings.quick(sims_per_element=7).without_shrinkage().sims_per_element == 7
    assert not mcsim.DiagnosisSettings.quick().without_shrinkage().shrunk


def test_the_cost_is_said_with_time_memory_and_disk():
    run = config.load(MODEL)
    whole = api.describe(run, SETTINGS).splitlines()
    few = api.describe(run, mcsim.DiagnosisSettings.quick(library=LIBRARY, **SMALL)).splitlines()
    numbers = [int(lines[0].split("at most ")[1].split()[0]) for lines in (few, whole)]
    assert numbers[0] < numbers[1]
    for lines in (few, whole):
        assert [line.split()[0] for line in lines[1:4]] == ["memory", "disk", "time"]
        # Beside a worker's, the results of all simulations, and what fits and report take.
        worker, command = (float(lines[1].split(" GB")[place].split()[-1]) for place in (0, 1))
        assert worker + 0.1 < command < worker + 0.4


def test_pieces_are_of_realizations_that_are_missing_and_of_the_same_simulations(tmp_path):
    run = config.load(MODEL)
    job = replace(api.analysis_of(run, library=LIBRARY).job(run), first=3, count=9)
    kept = Kept(tmp_path, 4)

    def missing(one):
        return [(piece.first, piece.count) for piece in kept.missing(one, kept.found(one))]

    assert missing(job) == [(3, 4), (7, 4), (11, 1)]
    kept.keep(replace(job, first=5, count=2), np.array([[5.0], [6.0]]))
    assert missing(job) == [(3, 2), (7, 4), (11, 1)]
    for piece in kept.missing(job, kept.found(job)):
        kept.keep(piece, np.arange(piece.first, piece.first + piece.count, dtype=float)[:, None])
    assert {number: row[0] for number, row in kept.found(job).items()} == {n: float(n) for n in range(3, 12)}
    # Another number of workers is the same simulation; another seed, effect, kind of row or observed sky is not.
    busy = campaign.with_effects(run, [])
    same = api.analysis_of(run, library=LIBRARY).job(replace(busy, compute=replace(run.compute, workers=3)))
    assert missing(replace(same, first=3, count=9)) == []
    wide = config.Effect(name="beam_width", channel="V", parameters={"amplitude": 0.1})
    for changed in (
        replace(job, simulated=config.to_json(campaign.seeded(run, 9))),
        replace(job, simulated=config.to_json(campaign.with_effects(run, [wide]))),
        replace(job, bipolar_scan=True),
        replace(job, slices=True),
        replace(job, nuisances=True),
        replace(job, sample_by_sample=True),
        replace(job, observed=np.ones(325, dtype=complex)),
    ):
        assert sum(count for _, count in missing(changed)) == 9


@pytest.mark.parametrize("change", [lambda _: b"", lambda _: b"no array", lambda b: b[:-1], lambda b: b[:-1] + b"\1"])
def test_a_piece_that_is_not_as_it_was_written_is_simulated_again(tmp_path, change):
    """A computer that stops leaves empty files, and a disk may turn a bit: of a number this was read without a word."""
    run = config.load(MODEL)
    job = replace(api.analysis_of(run, library=LIBRARY).job(run), first=0, count=4)
    kept = Kept(tmp_path, 2)
    for piece in kept.missing(job, {}):
        kept.keep(piece, np.ones((2, 3)))
    (path,) = tmp_path.glob("*/2-4-*.npy")
    path.write_bytes(change(path.read_bytes()))
    (again,) = kept.missing(job, kept.found(job))
    assert (again.first, again.count) == (2, 2)
    kept.keep(again, np.ones((2, 3)))
    assert list(kept.missing(job, kept.found(job))) == []


@pytest.mark.parametrize("written", [True, False])
def test_who_learns_a_model_ends_no_other_diagnosis_of_it(tmp_path, monkeypatch, written):
    """The first to learn it removes what is kept; the other said that the cache cannot be written."""
    run = config.load(MODEL)
    job = replace(api.analysis_of(run, library=LIBRARY).job(run), first=0, count=2)
    parts = Kept(tmp_path / "parts", 2)

    def write(path, rows):
        if written:
            write_npy(path, rows)
        shutil.rmtree(tmp_path / "parts")
        if not written:
            write_npy(path, rows)

    monkeypatch.setattr("mcsim.datavector.kept.write_npy", write)
    parts.keep(job, np.ones((2, 3)))
    monkeypatch.undo()
    parts.keep(job, np.ones((2, 3)))
    assert len(parts.found(job)) == 2


@pytest.mark.parametrize("nuisances", [False, True])
def test_simulations_with_files_that_have_changed_are_refused(tmp_path, nuisances):
    """Each worker reads the files itself: four times the power of the sky was kept as simulations of the model."""
    ell = np.arange(25.0)
    table = np.stack([ell, 1000.0 / (ell + 1.0) ** 2], axis=1)
    np.savetxt(tmp_path / "cl.txt", table)
    prior = [{"effect": "beam_width", "channel": "V", "width": 0.01}]
    plain = MODEL | {"sky": MODEL["sky"] | {"spectrum": str(tmp_path / "cl.txt")}, "nuisance": prior}
    analysis = api.analysis_of(config.load(plain), library=LIBRARY)
    job = replace(analysis.job(analysis.run), count=1, nuisances=nuisances)
    np.savetxt(tmp_path / "cl.txt", table * [1, 4])
    with refused(by=RunError):
        analysis_for(job)
    np.savetxt(tmp_path / "cl.txt", table)
    assert analysis_for(job).elements == analysis.elements
    np.savetxt(tmp_path / "cl.txt", table * [1, 4])
    with refused(by=RunError):
        data_vectors(job)
    np.savetxt(tmp_path / "cl.txt", table)
    assert len(data_vectors(job)) == 1


def test_what_takes_long_is_kept_in_small_pieces(tmp_path):
    assert [Kept.of(tmp_path, nside, 10).size for nside in (16, 128, 256, 512)] == [10, 10, 2, 2]
