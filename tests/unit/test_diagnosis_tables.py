"""Tables of measured spectra: named where an effect is in them, silent where none is, refused where they cannot be."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table
from scipy.stats import kstest

from mcsim import bipolar, config, systematics
from mcsim.datavector import campaign, responses
from mcsim.datavector import spectra_table as tables
from mcsim.datavector.analysis import Job
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.spectra_table import read_spectra
from mcsim.datavector.summaries import Element
from mcsim.diagnosis import api, report
from mcsim.diagnosis.context import context
from mcsim.diagnosis.measured_spectra import MeasuredSpectra
from mcsim.diagnosis.naming import slices_of
from mcsim.diagnosis.verdict import _unrefined, diagnose_data
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotate_biposh
from mcsim.stats.gaussian import SimulatedGaussian
from refusals import refused

PROPOSED = ("beam_ellipticity", "beam_width", "dipole_modulation", "quadrupole_modulation")
SKIES = 10
"""Behind the mean of every table here."""
BINS = [(2, 10), (11, 16), (17, 22), (23, 28), (29, 34), (35, 40)]
RUN = config.load(
    {
        "schema": 1,
        "name": "small",
        "sky": {"spectrum": "wmap7", "lmax": 40},
        "map": {"nside": 16},
        "channel": [
            {
                "name": "W1",
                "beam": {"kind": "gaussian", "fwhm_arcmin": 350.0},
                "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 61.0, "line_of_sight": "B"},
            }
        ],
    }
)
MODES = [(0, 0, 0), (2, 0, 0), (2, 0, 2), (2, 1, 0), (2, 2, 0)]


def measured(run, seed=77):
    """Table of the mean of SKIES skies, made of a_lm products by the formula of the coefficients."""
    shared = survey(replace(run, ensemble=replace(run.ensemble, seed=seed, paired=False)))
    total = np.mean([simulate.realize(shared, r)["biposh"][0] for r in range(SKIES)], axis=0)
    modes = list(shared.estimator.modes)
    ell = np.arange(41)
    rows = []
    for L, M, d in MODES:
        mode = bipolar.Mode(L, M, d)
        spectrum = ell * (ell + 1) / (2 * np.pi) * bipolar.bennett_factor(mode, 40) * total[modes.index(mode)]
        for low, high in BINS:
            value = np.nanmean(spectrum[low : high + 1])
            rows.append((L, M, d, low, high, value.real, value.imag if M else np.nan))
    found = Table(rows=rows, names=["L", "M", "d", "ell_min", "ell_max", "value", "value_imag"])
    found["value"].unit = found["value_imag"].unit = "uK2"
    found.meta = {"normalisation": "Bennett", "scaling": "l(l+1)/2pi", "frame": "ecliptic", "realizations": SKIES}
    return found


def read(folder, table, run=RUN):
    path = folder / "table.ecsv"
    table.write(path, format="ascii.ecsv", overwrite=True)
    return read_spectra(path, run)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """What tables of these rows are judged with."""
    spectra = read(tmp_path_factory.mktemp("small"), measured(RUN))
    run = tables.estimator_for(RUN, spectra)
    analysis = tables.analysis_of_spectra(
        run, spectra, [name for name in systematics.catalogue() if name not in PROPOSED]
    )
    ensemble, bank = campaign.learned(analysis, lambda jobs: [spectra(job) for job in jobs], 300)
    return context(analysis, ensemble.of_mean(SKIES), bank)


def judged(small, folder, table):
    spectra = read(folder, table)
    return diagnose_data(MeasuredSpectra(small, spectra, lambda jobs: [spectra(job) for job in jobs]), "table")


@pytest.mark.slow
def test_an_ellipticity_is_named_and_its_gap_shrinks(small, tmp_path):
    truth = config.Effect(name="beam_ellipticity", channel="W1", parameters={"amplitude": 0.3})
    found = judged(small, tmp_path, measured(with_effects(RUN, [truth])))
    verdict = found.verdict
    assert verdict["gap"]["p_value"] < 1e-3
    (best,) = verdict["effects"]
    assert (best["name"], best["channel"]) == ("beam_ellipticity", "W1")
    assert abs(best["amplitude"] - 0.3) < 4 * best["sigma"]
    shrink = verdict["shrink"]
    assert shrink["achieved"] > 0.5
    assert abs(shrink["achieved"] - shrink["predicted"]) < 4 * np.hypot(shrink["sigma"], shrink["sigma_predicted"])
    assert "alternate bins" in verdict["shrink"]["data"]
    first = verdict["where"][0]
    assert first["measured"] == "measured spectrum"
    assert (first["statistic"], first["frame"], first["L"], first["M"]) == ("biposh", "ecliptic", 2, 0)
    assert "BipoSH L = 2, M = 0, d = 0, real" in report.page(found)


@pytest.mark.slow
def test_tables_of_the_model_have_no_gap(small, tmp_path):
    verdicts = [judged(small, tmp_path, measured(RUN, seed)).verdict for seed in range(100, 108)]
    # Eight draws of a uniform number: three or more below 0.05 once in 170 cases.
    assert np.sum([verdict["gap"]["p_value"] <= 0.05 for verdict in verdicts]) < 3
    assert "none" in [verdict["verdict"] for verdict in verdicts]


@pytest.mark.parametrize(("stated", "needed"), [("inverse_covariance", "none"), (None, "inverse_covariance")])
def test_a_table_of_maps_that_were_filtered_otherwise_is_refused(stated, needed, tmp_path):
    """They have another response and scatter: spectra of the model itself were a gap of p = 1e-65."""
    noisy = replace(RUN.channels[0], noise=config.Noise(sigma0_uk=20.0))
    table, run = measured(RUN), replace(RUN, channels=(noisy,), biposh=replace(RUN.biposh, filter=needed))
    if stated is not None:
        table.meta["filter"] = stated
    with refused("table.ecsv", "none", "inverse_covariance"):
        read(tmp_path, table, run)
    table.meta["filter"] = needed
    assert len(read(tmp_path, table, run).rows)


@pytest.mark.parametrize(("skies", "along", "across", "known"), [
    (24, 0.1, 0.1, True), (24, 1.0, 0.1, False), (24, 0.1, 1.5, False), (384, 1.0, 1.5, True),
])  # fmt: skip
def test_a_response_is_known_from_as_many_skies_as_its_scatter_asks_for(skies, along, across, known):
    """Of 20 standard deviations in one of 60 numbers; over the errors of the data, along it and in each of the others.

    Averaged over 24 skies, a table of 25 had amplitudes 0.8 +- 0.2 of their errors too small, one of 1,600 no name.
    """
    rng = np.random.default_rng(2)
    null = SimulatedGaussian.from_simulations(rng.normal(size=(100_000, 60)))
    size = np.where(np.arange(60) == 0, along, across)
    changes = 20.0 * (np.arange(60) == 0) + size * rng.normal(size=(skies, 60))
    data = SimpleNamespace(context=SimpleNamespace(null=null))
    assert MeasuredSpectra._is_known(data, changes) == known


def test_more_skies_are_simulated_once_for_all_effects(small, tmp_path):
    """The pairs of one sky differ by the effect alone."""
    spectra, asked = read(tmp_path, measured(RUN)), []

    def ask(jobs):
        asked.extend((job.first, job.count, "beam_width" in job.simulated) for job in jobs)
        return [spectra(job) for job in jobs]

    data = MeasuredSpectra(small, spectra, ask)
    found = [config.Effect(name="beam_width", channel="W1", parameters={"amplitude": 1e-6})]
    object.__setattr__(data, "_is_known", lambda changes: len(changes) >= 48)
    for _ in range(2):
        before, after = data.pair_extended(found, 8)
        assert len(before) == len(after) == 48
        assert np.abs(after - before).max() < 1e-3 * small.ensemble.spread.max()
    assert sum(count for _, count, acts in asked if not acts) == 24
    assert sum(count for _, count, acts in asked if acts) == 2 * 48


def test_the_mean_of_skies_scatters_as_the_tests_take_it_to(small):
    raw = small.ensemble.simulations
    back = replace(small.ensemble, simulations=np.random.default_rng(1).normal(size=raw.shape)).of_mean(50)
    scale = back.simulations.std(axis=0) ** 2 * (1 + 1 / len(raw))
    # C (1/R + 1/N), C measured with 300 simulations: 8 % each, 5 sigma.
    np.testing.assert_allclose(scale, 1 / 50 + 1 / len(raw), rtol=0.4)
    np.testing.assert_allclose(np.mean(scale), 1 / 50 + 1 / len(raw), rtol=0.1)


def test_simulations_held_out_of_a_mean_are_of_single_skies():
    """Each has the scale of its own sky, of variance 0.1, where that of a mean of 25 skies has a 25th of it."""
    draw, none = np.random.default_rng(3), np.zeros((0, 0))
    scale = draw.chisquare(20, size=(1000, 1)) / 20
    elements = tuple(Element(str(number), "cl", ("W1",)) for number in range(20))
    rows = np.sqrt(scale) * draw.normal(size=(1000, 20))
    mean = NullEnsemble(rows, np.zeros(20), elements, np.zeros((2, 20)), none, none, none, none).of_mean(25)
    assert kstest(mean.held_out_pvalues(mean.gaussian), "uniform").pvalue > 1e-3


def test_power_spectra_are_those_of_the_pair(tmp_path):
    spectra = read(tmp_path, measured(RUN))
    run = tables.estimator_for(RUN, spectra)
    cl = simulate.realize(survey(run), 3)["cl"][0]
    ell = np.arange(41)
    expected = [np.mean((ell * (ell + 1) / (2 * np.pi) * cl)[a : b + 1]) for a, b in BINS]
    np.testing.assert_allclose(spectra(Job("", config.to_json(run), 3, 1))[0, : len(BINS)], expected, rtol=1e-12)
    assert [element.statistic for element in spectra.elements[: len(BINS)]] == ["cl"] * len(BINS)
    assert [element.fold for element in spectra.elements[: len(BINS)]] == [0, 1, 0, 1, 0, 1]


def test_where_the_maps_end_is_part_of_what_a_number_is(tmp_path):
    """Simulations of tables whose maps end elsewhere are other numbers, and kept in the cache by these names."""
    table = measured(RUN)
    whole = read(tmp_path, table)
    table.meta["lmax"] = 37
    cut = read(tmp_path, table)
    run = tables.estimator_for(RUN, whole)
    one, other = (spectra(Job(config.to_json(run), config.to_json(run), 0, 1)) for spectra in (whole, cut))
    assert not np.allclose(one, other)
    assert {element.name for element in whole.elements}.isdisjoint(element.name for element in cut.elements)


@pytest.mark.parametrize("changes", [{}, {"table_skies": 50}])
def test_responses_are_averaged_over_skies_that_are_simulated_without_effects(changes):
    settings = DiagnosisSettings.quick(**changes)
    analysis = SimpleNamespace(of_maps=False, settings=settings)
    assert responses.skies(analysis, None) == settings.noisy_skies == 12


def test_the_cost_of_a_table_is_that_of_its_numbers(tmp_path):
    """Of 8 bytes each: tables have no bipolar scan, and nothing that is not listed is looked for in them."""
    read(tmp_path, measured(RUN))
    settings = DiagnosisSettings(without=tuple(set(systematics.catalogue()) - set(PROPOSED)), simulations=300)
    text = api.describe(RUN, settings, tmp_path / "table.ecsv")
    count, size = (int(text.split(word)[0].split()[-1]) for word in (" simulations before", "\n"))
    assert f"disk    {8e-6 * count * size:.1f} MB" in text
    assert "unknown" not in text


def test_other_frames_are_those_of_rotated_coefficients(tmp_path):
    spectra = read(tmp_path, measured(RUN))
    views = list(spectra.views())
    # d = 2 lacks M > 0 and is not turned.
    assert len(views) == 2 * len(BINS)
    at = {(row.mode, row.ell_min, row.imaginary): value for row, value in zip(spectra.rows, spectra.value, strict=True)}
    family = [bipolar.Mode(2, M, 0) for M in range(3)]
    for element, matrix in views:
        low = element.ell[0]
        own = np.array([at[mode, low, False] + 1j * at.get((mode, low, True), 0.0) for mode in family])
        turned = rotate_biposh(own[:, None], [(2, M, 0) for M in range(3)], "ecliptic", element.frame)
        assert matrix @ spectra.value == pytest.approx(turned[0, 0].real, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"frame": "galactic"}, ("galactic", "ecliptic", "map.frame")),
        ({"frame": ""}, ("frame", "ecliptic")),
        ({"realizations": 0}, ("realizations", 0)),
        ({"normalisation": "mine"}, ("normalisation", "mine", "Bennett", "Hajian-Souradeep")),
    ],
)
def test_headers_that_do_not_fit_are_refused(tmp_path, change, named):
    table = measured(RUN)
    table.meta |= change
    with refused(*named):
        read(tmp_path, table)


@pytest.mark.parametrize(
    ("column", "value", "named"),
    [
        ("ell_max", 50, (50, 40, "biposh.lmax", "sky.lmax")),
        ("M", 3, ("L0M3d0",)),
        ("ell_min", 11, ("twice",)),
        ("value", np.nan, ("L0M0d0", "nan")),
        ("ell_min", 2.5, ("ell_min", "integers")),
        ("value", "none", ("value", "'none'", "row 1", "uK2")),
    ],
)
def test_rows_that_do_not_fit_are_refused(tmp_path, column, value, named):
    table = measured(RUN)
    unit = table[column].unit
    table[column] = [value, *table[column][1:]]
    table[column].unit = unit
    if value == 11:
        table["ell_max"][0] = 16
    with refused(*named):
        read(tmp_path, table)


def test_an_unknown_pair_is_refused(tmp_path):
    table = measured(RUN)
    table["pair"] = "V1,V1"
    with refused("V1,V1", "W1,W1"):
        read(tmp_path, table)


def test_numbers_in_another_unit_are_refused(small, tmp_path):
    table = measured(RUN)
    table["value"] *= 1e-6
    with refused("C_l", "1e-06", "factor", 25, "unit"):
        judged(small, tmp_path, table)


def test_a_mean_of_more_skies_than_it_says_is_refused(small, tmp_path):
    table = measured(RUN)
    spectra = read(tmp_path, table)
    quiet = small.null.mean + 0.01 * (spectra.value - small.null.mean)
    with refused(10, "realizations", "unit"):
        diagnose_data(MeasuredSpectra(small, replace(spectra, value=quiet), lambda jobs: []), "quiet")


def test_errors_that_the_model_does_not_have_are_noted(small, tmp_path):
    spectra = read(tmp_path, measured(RUN))
    spread = small.ensemble.simulations.std(axis=0)
    first = np.arange(len(spread)) == 0
    for factor, noted in ((1.0, 0), (3.0, 1), (np.nan, 0), (np.where(first, np.nan, 3.0), 1)):
        found = MeasuredSpectra(small, replace(spectra, error=factor * spread), lambda jobs: [])
        assert len(found.notes()) == noted
        assert sum("table's errors" in note for note in _unrefined(found).result("errors").notes) == noted


def test_halves_of_a_table_are_bins_whatever_the_splits_of_the_maps(small, tmp_path):
    spectra = read(tmp_path, measured(RUN))
    model = small.analysis.model
    run = replace(small.run, map=replace(small.run.map, splits=("half1", "half2")))
    split = replace(small.analysis, model=replace(model, survey=replace(model.survey, config=run)))
    for known in (small, replace(small, analysis=split)):
        parts = slices_of(MeasuredSpectra(known, spectra, lambda jobs: []))
        (found,) = (one for one in parts._divisions(small.candidates[0], small.templates[:, 0]) if one.kind == "halves")
        assert found.words == ("every other bin", "the bins between")


def test_correlated_bins_are_freed_of_what_others_predict(small, tmp_path):
    folds = np.array([element.fold for element in small.analysis.elements])
    rng = np.random.default_rng(5)
    drawn = rng.normal(size=(300, len(folds)))
    used, fresh = np.flatnonzero(folds == 0)[0], np.flatnonzero(folds == 1)[0]
    drawn[:, fresh] += drawn[:, used]
    correlated = replace(small, ensemble=replace(small.ensemble, simulations=drawn))
    spectra = replace(read(tmp_path, measured(RUN)), value=drawn[0])
    found = MeasuredSpectra(correlated, spectra, lambda jobs: [])
    turn, words = found.halves()
    assert "1 of them" in words
    left = np.corrcoef(drawn @ turn.T, rowvar=False)
    assert abs(left[used, fresh]) < 1e-12
    np.testing.assert_array_equal(turn[folds == 0], np.eye(len(folds))[folds == 0])


@pytest.mark.slow
def test_a_few_power_spectra_alone_are_judged(tmp_path):
    table = measured(RUN)
    few = table[(table["L"] == 0) & (table["ell_max"] < BINS[-1][1])]
    few["value"] *= 1.0 + 0.3 * np.arange(len(few))
    spectra = read(tmp_path, few)
    run = tables.estimator_for(RUN, spectra)
    # Coma is not seen at all, and the spectrum has more components than there are numbers.
    proposed = ("beam_coma", "beam_width", "spectrum")
    analysis = tables.analysis_of_spectra(
        run, spectra, [name for name in systematics.catalogue() if name not in proposed]
    )

    def ask(jobs):
        return [spectra(job) for job in jobs]

    ensemble, bank = campaign.learned(analysis, ask, 60)
    learned = context(analysis, ensemble.of_mean(SKIES), bank)
    found = diagnose_data(MeasuredSpectra(learned, spectra, ask), "few")
    assert found.verdict["verdict"] != "none"
    assert "beam_coma" not in [effect["name"] for effect in found.verdict["effects"]]
    assert "<h1>" in report.page(found)
