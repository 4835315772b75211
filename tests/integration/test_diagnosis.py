"""A small instrument from beginning to end: no gap, a gap that is explained, a simulator that is broken, bad data."""

import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import healpy
import numpy as np
import pytest
from scipy.stats import kstest

import mcsim
from instruments import ask, data_of, learned_small, two_channels
from mcsim import config, systematics
from mcsim.datavector import bipolar_scan, campaign, localisation
from mcsim.datavector.analysis import analysis_of, data_vectors, on_request
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.shared_sky import shared_sky
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.diagnosis import api, inference, words
from mcsim.diagnosis.context import context
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.ensemble.maps import POINTING, file_names, write_map
from mcsim.errors import InputError
from mcsim.reconstruction.result import HEAD
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey
from mcsim.stats.look_elsewhere import global_test
from mcsim.systematics import Parametrization
from pictures import quick_pictures
from refusals import refused

MODEL = two_channels("small")


@dataclass(frozen=True, kw_only=True)
class Louder(systematics.get("noise_level")):
    """An effect that is in no catalogue."""

    name = "louder"
    parametrization = Parametrization()


@pytest.fixture(scope="module")
def small():
    return learned_small()


def test_both_folds_have_every_range_of_the_sky(small):
    sky = [element for element in small.analysis.elements if element.name.startswith("sky/")]
    even, odd = ([element.ell for element in sky if element.fold == fold] for fold in (0, 1))
    assert even == odd
    # The numbers are of different degrees, so that their noise, the sky itself, is independent.
    rows = {element.name: row for row, element in enumerate(small.analysis.elements)}
    for element in sky[: len(even)]:
        pair = small.ensemble.simulations[:, [rows[element.name], rows[element.name.replace("even", "odd")]]]
        assert abs(np.corrcoef(pair.T)[0, 1]) < 4.0 / np.sqrt(len(pair))


def test_no_gap_where_there_is_none(small):
    shared = data_of(small.run)
    groups = small.null.whiten_groups(small.templates, [c.columns for c in small.candidates])
    skies = [list(simulate.maps(shared, r)) for r in range(40)]
    p = [global_test(small.null, small.analysis.data_vector(maps), groups, small.calibration).pvalue for maps in skies]
    # 40 draws of a uniform number: 7 or more below 0.05 once in 300 cases; and Kolmogorov-Smirnov.
    assert np.sum(np.array(p) <= 0.05) < 7
    assert kstest(p, "uniform").pvalue > 1e-3
    found = diagnose_data(ObservedMaps(small, skies[int(np.argsort(p)[20])], ask), "null")
    assert found.verdict["verdict"] == "none"
    assert found.verdict["effects"] == []


def test_ellipticity_seen_sample_by_sample_is_named_and_shrinks(small, tmp_path):
    truth = 0.25
    shared = data_of(small.run, "beam_ellipticity", "W1", amplitude=truth, angle_deg=20.0)
    maps = [map_uk for _, map_uk in sampled.maps(shared, 0)]
    found = diagnose_data(ObservedMaps(small, maps, ask), "ellipse")
    verdict = found.verdict
    assert verdict["gap"]["p_value"] < 1e-3
    best = verdict["effects"][0]
    assert (best["name"], best["channel"]) == ("beam_ellipticity", "W1")
    # The referee's pixels are not modelled here (no offset was learned): 3 sigma leave room for that.
    assert abs(best["amplitude"] - truth) < 3 * best["sigma"]
    assert verdict["shrink"]["achieved"] > 0.5
    assert abs(verdict["shrink"]["achieved"] - verdict["shrink"]["predicted"]) < 4 * verdict["shrink"]["sigma"]
    # It is the same in both halves, which measure it independently.
    halves = next(one for one in best["consistency"] if one["by"] == "halves")
    assert halves["slices"] == ["half1", "half2"]
    assert all(
        abs(a - best["amplitude"]) < 4 * sigma for a, sigma in zip(halves["amplitude"], halves["sigma"], strict=True)
    )
    assert "contradicted" not in verdict
    found.save(tmp_path)
    assert DiagnosisResult.open(tmp_path).effects == found.effects


def mean_squares(learned, name=None, channel=None, skies=20, **parameters):
    """Mean square of the standardised residual of every map, shape (sky, map)."""
    shared, ensemble = data_of(learned.run, name, channel, **parameters), learned.ensemble
    count, rows = len(ensemble.bipolar_scan), []
    for realization in range(skies):
        filtered = wiener_filter(learned.analysis.model, list(simulate.maps(shared, realization)))
        x = bipolar_scan.coarse_residuals(learned.analysis.model, filtered)
        z = localisation.standardised(x, ensemble.residual_mean, ensemble.residual_scatter, count)
        rows.append(np.nanmean(z**2, axis=1))
    return np.array(rows)


@pytest.mark.parametrize("masked", [False, True])
def test_residual_maps_of_the_model_have_unit_rms(small, masked, tmp_path):
    learned, pixels = small, 3072
    if masked:
        path = tmp_path / "mask.fits"
        seen = np.abs(healpy.pix2vec(16, np.arange(3072))[2]) < 0.55
        healpy.write_map(path, seen.astype(float), dtype=np.float64)
        run = replace(small.run, map=replace(small.run.map, mask=str(path), mask_frame="ecliptic"))
        analysis = analysis_of(run, without=list(systematics.catalogue()))
        ensemble, _ = campaign.learned(analysis, ask, 180, time_ordered=False)
        learned = SimpleNamespace(run=run, analysis=analysis, ensemble=ensemble)
        pixels = int(seen.sum())
        # Less than the noise: the filter takes what sky and noise have in common, behind a mask too.
        filtered = wiener_filter(analysis.model, list(simulate.maps(data_of(run), 0)))
        x = bipolar_scan.coarse_residuals(analysis.model, filtered)[:, seen]
        noise = np.sqrt([part.precision[seen] for part in analysis.model.parts])
        assert 0.8 < np.sqrt(np.mean((x / noise) ** 2)) < 1.0
    found = mean_squares(learned)
    error = np.std(found.mean(axis=1), ddof=1) / np.sqrt(len(found))
    if not masked:  # independent pixels
        assert error < 2.0 * np.sqrt(2.0 / (pixels * found.size))
    # The scatter of the simulations has an error like that of as many skies.
    assert abs(found.mean() - 1.0) < 4.0 * error * np.sqrt(1.0 + len(found) / len(learned.ensemble.bipolar_scan))
    low, high = np.quantile(learned.ensemble.residual_rms, [0.025, 0.975], axis=0)
    outside = np.sum((np.sqrt(found) < low) | (np.sqrt(found) > high), axis=0)
    # 7 or more of 20 outside of the range of 95 %: once in 30,000.
    assert np.all(outside < 7)


def test_an_effect_stands_out_in_the_residual_maps_of_its_channel(small):
    names = [part.name.partition(":")[0] for part in small.analysis.model.parts]
    found = mean_squares(small, "noise_level", "W1", skies=4, amplitude=0.2).mean(axis=0)
    for name, value in zip(names, found, strict=True):
        # Noise of W1 is 1.2 times larger, and little of it gets into the sky that V1 is compared with.
        expected = 1.2**2 if name == "W1" else 1.0
        assert abs(value - expected) < 5.0 * expected * np.sqrt(2.0 / 3072 / 4) + 0.02


def test_a_broken_simulator_shrinks_nothing(small):
    maps = list(simulate.maps(data_of(small.run, "beam_ellipticity", "W1", amplitude=0.25), 0))
    analysis = []

    def working(jobs):
        analysis.append(jobs)
        return ask(jobs)

    works = diagnose_data(ObservedMaps(small, maps, working), "works").verdict
    # The last simulations are those of the shrink: the effect at its frozen amplitude.
    last = analysis[-1]
    assert config.from_json(last[0].simulated).effects

    def broken(jobs):
        if jobs[0].simulated != last[0].simulated:
            return working(jobs)
        quiet = replace(config.from_json(jobs[0].simulated), effects=())
        return ask([replace(job, simulated=config.to_json(quiet)) for job in jobs])

    breaks = diagnose_data(ObservedMaps(small, maps, broken), "breaks").verdict
    assert works["effects"] == breaks["effects"]
    assert works["shrink"]["achieved"] > 0.5
    assert abs(breaks["shrink"]["achieved"]) < 1e-6
    assert breaks["shrink"]["predicted"] == works["shrink"]["predicted"]


def test_an_amplitude_that_cannot_be_simulated_is_no_explanation(small):
    maps = list(simulate.maps(data_of(small.run, "beam_ellipticity", "W1", amplitude=0.25), 0))

    def refusing(jobs):
        if any(effect.name == "beam_ellipticity" for effect in config.from_json(jobs[0].simulated).effects):
            raise InputError("no such amplitude")
        return ask(jobs)

    found = diagnose_data(ObservedMaps(small, maps, refusing), "refused").verdict
    assert ("beam_ellipticity", "W1") not in [(effect["name"], effect["channel"]) for effect in found["effects"]]


def test_no_shrink_is_said_of_what_cannot_be_simulated_again(small):
    maps = list(simulate.maps(data_of(small.run, "beam_ellipticity", "W1", amplitude=0.25), 0))
    simulated = []

    def remembering(jobs):
        simulated.append(jobs[0].simulated)
        return ask(jobs)

    works = diagnose_data(ObservedMaps(small, maps, remembering), "works").verdict
    last = simulated[-1]

    def refusing(jobs):
        if jobs[0].simulated == last:
            raise InputError("no such amplitude")
        return ask(jobs)

    found = diagnose_data(ObservedMaps(small, maps, refusing), "refused").verdict
    assert found["effects"] == works["effects"]
    assert works["shrink"] is not None
    assert found["shrink"] is None


def test_pixels_that_the_data_lack_are_no_gap(small):
    maps = list(simulate.maps(data_of(small.run), 3))
    holed = [map_uk.copy() for map_uk in maps]
    for number, map_uk in enumerate(holed):
        map_uk[100 + 31 * number :: 150] = healpy.UNSEEN  # 20 of 3072
    whole, lacking = (float(y @ y) for y in (small.null.whiten(small.analysis.data_vector(m)) for m in (maps, holed)))
    # Zeros there would make chi^2 fall out of its distribution by tens of its width, sqrt(2 p).
    assert abs(lacking - whole) < np.sqrt(2 * small.null.dimension)


@pytest.mark.parametrize("kind", ["parallel transport", "mask"])
def test_nothing_is_asked_that_has_no_answer(kind, tmp_path):
    run = config.load(MODEL)
    if kind == "mask":
        path = tmp_path / "mask.fits"
        height = healpy.pix2vec(16, np.arange(3072))[2]
        healpy.write_map(path, (np.abs(height) < 0.55).astype(float), dtype=np.float64)
        run = replace(run, map=replace(run.map, mask=str(path), mask_frame="ecliptic"))
    else:
        still = config.ScanParallelTransport()
        run = replace(
            run,
            map=replace(run.map, splits=()),
            channels=tuple(replace(channel, scan=still) for channel in run.channels),
        )
    analysis = analysis_of(run)
    first = next(iter(campaign.plan(analysis, 4, time_ordered=False).values()))
    answers = data_vectors(first)[:, : len(analysis.elements)]
    dead = [
        element.name
        for element, spread in zip(analysis.elements, np.ptp(answers, axis=0), strict=True)
        if spread == 0.0
    ]
    assert dead == []


def test_orders_are_proposed_where_a_run_leaves_some_out(small):
    """And in no other channel."""
    ellipse = {"fwhm_major_arcmin": 380.0, "fwhm_minor_arcmin": 330.0}
    cut, whole = (config.BeamEllipticalGaussian(**ellipse, m_max=m_max) for m_max in (0, None))
    for beam, expected in ((cut, ["beam_noncircularity (V1)"]), (whole, [])):
        run = replace(small.run, channels=(replace(small.run.channels[0], beam=beam), small.run.channels[1]))
        analysis = analysis_of(run, without=[name for name in systematics.catalogue() if name != "beam_noncircularity"])
        assert [candidate.label for candidate in analysis.candidates] == expected


def test_the_library_is_an_argument_that_workers_share(small):
    analysis = analysis_of(small.run, library={"louder": Louder})
    assert {candidate.identity for candidate in analysis.candidates} == {("louder", "V1"), ("louder", "W1")}
    run = with_effects(small.run, [config.Effect(name="louder", channel="W1", parameters={"amplitude": 0.5})])
    rows = [data_vectors(replace(analysis.job(simulated), count=1))[0] for simulated in (small.run, run)]
    assert rows[0].shape == (len(analysis.elements),)
    matched = [element.candidate == "louder" and element.channels == ("W1",) for element in analysis.elements]
    assert rows[1][matched] > rows[0][matched]


def test_effects_on_request_are_proposed_when_they_are_named(small):
    others = [name for name, kind in systematics.catalogue().items() if kind.proposed and name != "noise_level"]
    both = ("orbital_dipole", "spin_synchronous_offset")
    for including, expected in (((), {"noise_level"}), (both, {"noise_level", *both})):
        settings = DiagnosisSettings(including=including)
        analysis = analysis_of(small.run, without=others, settings=settings)
        assert {candidate.name for candidate in analysis.candidates} == expected
    for effect in ({"name": both[0], "amplitude": 0.2}, {"name": both[1], "amplitude": 50.0}):
        parameters = {"amplitude": effect["amplitude"], "phase_deg": 45.0}
        run = with_effects(small.run, [config.Effect(name=effect["name"], channel="W1", parameters=parameters)])
        rows = [data_vectors(replace(analysis.job(simulated), count=1))[0] for simulated in (small.run, run)]
        matched = [element.candidate == effect["name"] and element.channels == ("W1",) for element in analysis.elements]
        # Cosine and sine, of which the effect has as much.
        change = rows[1][matched] - rows[0][matched]
        assert change.shape == (2,)
        assert np.all(change > 0.0)


@pytest.mark.parametrize(
    ("name", "amplitude", "rivals"), [("noise_level", 0.3, ["louder"]), ("beam_ellipticity", 0.25, [])]
)
def test_an_effect_on_request_is_named_beside_what_it_cannot_be_told_from(small, name, amplitude, rivals):
    """Unless it is asked for it is no candidate, and nothing else changes."""
    library = (*small.analysis.library, ("louder", type("OnRequest", (Louder,), {"proposed": False})))
    known = replace(small, analysis=replace(small.analysis, library=library))
    assert [one.identity for one in on_request(known.analysis)] == [("louder", "V1"), ("louder", "W1")]
    shared = data_of(small.run, name, "W1", amplitude=amplitude)
    found = diagnose_data(ObservedMaps(known, list(simulate.maps(shared, 1)), ask), name)
    named = [[(one.name, one.channel) for one in effects.effects] for effects in found.sets]
    assert sorted(named) == sorted([(one, "W1")] for one in [name, *rivals])
    assert found.kind == ("degenerate" if rivals else "effect")
    assert len(found.candidates) == len(small.candidates) + len(rivals)


def test_rivals_are_sought_of_what_the_data_leave_to_be_named(small, monkeypatch):
    """Of several sets one may be left alone when the others fall away."""
    left, asked, agreeing = [], [], inference.agreeing
    monkeypatch.setattr(inference, "agreeing", lambda *own: left.append(agreeing(*own)) or left[-1])
    monkeypatch.setattr(inference, "with_rivals", lambda data, refined, found: asked.append(found))
    shared = data_of(small.run, "beam_ellipticity", "W1", amplitude=0.25)
    diagnose_data(ObservedMaps(small, list(simulate.maps(shared, 1)), ask), "ellipticity")
    assert [id(one) for one in asked] == [id(found) for found, _ in left]


def test_the_cost_of_a_diagnosis_counts_the_effects_on_request(small):
    least = DiagnosisSettings(simulations=400, without=tuple(n for n in systematics.catalogue() if n != "noise_level"))

    def size(settings):
        return int(api.describe(small.run, settings).splitlines()[0].split()[-1])

    asked = {"without": tuple(n for n in least.without if n != "gain_spin")}
    assert size(replace(least, **asked)) == size(least)
    assert size(replace(least, **asked, including=("gain_spin",))) == size(least) + 4
    # Of a library that is given all effects are proposed; the level of the noise has a matched filter in each channel.
    library = {"gain_spin": systematics.get("gain_spin")}
    assert size(DiagnosisSettings(simulations=400, library=library)) == size(least) - 2 + 4
    assert size(DiagnosisSettings(simulations=400, only=("noise_level",))) == size(least)
    assert size(DiagnosisSettings(simulations=400, only=("noise_level", "gain_spin"))) == size(least) + 4
    with refused("gain_spinn", "gain_spin"):
        api.describe(small.run, replace(least, including=("gain_spinn",)))
    with refused("gain_spin", "--with", "--without"):
        api.describe(small.run, replace(least, including=("gain_spin",), without=("gain_spin",)))


def test_an_effect_that_is_asked_for_is_not_left_out_in_silence(small, tmp_path):
    """Neither one whose hook fails, nor one that cannot act in this model."""
    broken = tmp_path / "broken.py"
    broken.write_text(
        "import numpy as np\n"
        "from dataclasses import dataclass\n"
        "from mcsim.systematics import Effect\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Broken(Effect):\n"
        "    'A gain that is no number.'\n"
        "    name, scope, unit, step = 'broken', 'channel', 'fraction', 1e-3\n"
        "    cause, signature, source = 'None.', 'None.', 'None'\n"
        "    def gain(self, time_s, site):\n"
        "        return np.nan * time_s\n"
    )
    with refused("broken", "gain", "finite"):
        api.describe(small.run, DiagnosisSettings(including=(str(broken),)))
    with refused("mapmaking_convergence", "differencing"):
        api.describe(small.run, DiagnosisSettings(including=("mapmaking_convergence",)))
    with refused("mapmaking_convergence", "differencing"):
        api.describe(small.run, DiagnosisSettings(only=("mapmaking_convergence",)))
    with refused("library", "--without"):
        api.describe(small.run, DiagnosisSettings(without=tuple(systematics.catalogue())))


def test_a_diagnosis_knows_the_library_that_it_is_given(tmp_path, monkeypatch):
    """And names an effect that is in no catalogue; ``without`` is read in that library too."""
    monkeypatch.setattr(api, "batch", lambda workers: campaign.batch(0))  # in this process
    run = config.load(two_channels("tiny", lmax=20, nside=8, fwhm_arcmin=700.0))
    louder = config.Effect(name="louder", channel="W1", parameters={"amplitude": 0.4})
    seeded = replace(run, ensemble=replace(run.ensemble, seed=78))
    maps = list(simulate.maps(survey(with_effects(seeded, [louder]), library={"louder": Louder}), 0))
    settings = DiagnosisSettings(library={"louder": Louder}, simulations=240, scan_sims=40, time_ordered_skies=2)
    with quick_pictures(empty=True):
        found = mcsim.diagnose(run, maps, tmp_path / "out", settings=settings)
    assert {(one.name, one.channel) for one in found.candidates} == {("louder", "V1"), ("louder", "W1")}
    assert found.to_json()["verdict"] == "effect"
    assert [(one["name"], one["channel"]) for one in found.to_json()["effects"]] == [("louder", "W1")]
    assert type(found).open(tmp_path / "out").settings == found.settings
    assert words.PIXEL_MEANS not in found.notes
    # The reference of this instrument departs from the default route by more than its noise.
    for dense in (False, True):
        (folder := tmp_path / str(dense)).mkdir()
        for name, file in file_names(run).items():
            write_map(folder / file, maps[config.map_names(run).index(name)], run.map.frame, [POINTING[dense]])
        again = mcsim.diagnose(run, folder, settings=settings)
        assert (again.notes[:1] == (words.PIXEL_MEANS,)) is not dense
        assert (again.test.pvalue == found.test.pvalue) is dense
        assert [(one.name, one.channel) for one in again.effects] == [("louder", "W1")]
    for changes, named in (
        ({"without": ("noise_level",)}, ("noise_level",)),
        ({"library": {"other": Louder}}, ("other", "louder")),
        ({"library": {"louder": "louder"}}, ("louder", "mcsim.Effect")),
    ):
        with refused(*named):
            mcsim.diagnose(run, maps, settings=replace(settings, **changes))


def test_columns_and_matched_filters_know_their_candidate(small):
    known = {candidate.name for candidate in small.candidates}
    assert [label[:2] for label in small.bank.labels] == [c.identity for c in small.candidates for _ in c.columns]
    for element in small.analysis.elements:
        assert (element.candidate in known) if element.kind == "matched" else element.candidate is None


def test_maps_by_the_default_route_have_the_mean_of_the_simulations(small):
    offset = 0.7 * small.ensemble.spread
    ensemble = replace(small.ensemble, offset=offset, slice_offset=np.ones(len(small.ensemble.slice_elements)))
    moved = context(small.analysis, ensemble, small.bank)
    x = small.ensemble.reference[0]
    assert moved.null.chi2(x + offset) == pytest.approx(small.null.chi2(x))
    assert moved.of_pixel_means.null.chi2(x) == pytest.approx(small.null.chi2(x))
    known = small.ensemble.extended.gaussian.mean
    np.testing.assert_allclose(moved.of_pixel_means.ensemble.extended.gaussian.mean, known, rtol=1e-12)


def test_maps_of_another_order_are_noticed(small):
    """Of pixels, where a file does not say that it is NESTED, and of splits."""
    maps = list(simulate.maps(data_of(small.run), 0))

    def notes(observed):
        return " ".join(ObservedMaps(small, observed, ask).exchanged)

    nested = [healpy.reorder(one, r2n=True) for one in maps]
    assert "NESTED" in notes(nested)
    found = diagnose_data(ObservedMaps(small, nested, lambda jobs: pytest.fail("nothing is simulated")), "nested")
    assert found.kind == "unknown"
    assert "NESTED" in found.orders[0]
    assert found.verdict["notes"][0] == found.orders[0]
    assert found.orders[0] in words.sentence(found)
    assert "V1:half1 as V1:half2" in notes([maps[i] for i in (1, 0, 3, 2)])
    assert notes([maps[i] for i in (1, 0, 2, 3)]).endswith("exchanged: V1:half2 as V1:half1, V1:half1 as V1:half2.")
    assert "NESTED" not in notes(maps)
    # Maps that are alike fit in any order, and where nothing departs none is said.
    for changed in ({"alpha": 1e-300}, {"odds_cut": 1e300}):
        model = replace(small.analysis.model, settings=replace(small.settings, **changed))
        known = replace(small, analysis=replace(small.analysis, model=model))
        other = ObservedMaps(known, [maps[i] for i in (1, 0, 3, 2)], ask)
        assert other.exchanged == []
    # What is left out is filled, and departs from no model.
    seen = [np.where(np.arange(one.size) % 20 == k, healpy.UNSEEN, one) for k, one in enumerate(maps)]
    assert notes([seen[i] for i in (1, 0, 3, 2)]) == ""


def test_a_beam_that_no_effect_changes_has_no_single_name(small):
    run = replace(
        small.run,
        channels=(small.run.channels[0], replace(small.run.channels[1], beam=config.BeamGaussian(fwhm_arcmin=500.0))),
    )
    maps = list(simulate.maps(data_of(run), 0))
    found = diagnose_data(ObservedMaps(small, maps, ask), "wide").verdict
    # No effect of this library widens a beam: whatever is said, it is no single confident name.
    assert found["verdict"] in ("unknown", "mixture", "degenerate")


def test_the_verdict_is_json_and_the_evidence_opens(small, tmp_path, monkeypatch):
    found = diagnose_data(ObservedMaps(small, list(simulate.maps(data_of(small.run), 0)), ask), "saved")
    found.save(tmp_path / "out", "page")
    assert json.loads((tmp_path / "out" / "verdict.json").read_text())["schema"] == 1
    assert (tmp_path / "out" / "report.html").read_text() == "page"
    found.save(tmp_path / "out")  # whose report is none of this call
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["diagnosis.zarr", "verdict.json"]
    # A description that a nuisance of the run is stays, one that nothing uses does not; "~" is the home.
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("unlisted_1.py", "unlisted_2.py"):
        (tmp_path / "out" / name).write_text(HEAD)
    run = {**json.loads(found.configuration), "nuisance": [{"effect": str(tmp_path / "out" / "unlisted_1.py")}]}
    replace(found, configuration=json.dumps(run)).save("~/out")
    assert [path.name for path in (tmp_path / "out").glob("*.py")] == ["unlisted_1.py"]
    assert DiagnosisResult.open("~/out").kind == found.kind


def test_responses_on_the_observed_sky_have_the_mean_of_those_on_any(small):
    """One sky's response scatters about the mean of many, by the strength of its own multipoles, but is not biased."""
    analysis, run = small.analysis, small.run
    effect = config.Effect(name="beam_ellipticity", channel="W1", parameters={"amplitude": 0.1})
    members = next(c.columns for c in small.candidates if c.identity == ("beam_ellipticity", "W1"))
    expected = small.null.whiten_templates(small.bank.matrix[:, members[:1]] * 0.1)[:, 0]
    ratios = []
    for realization in range(12):
        observed = shared_sky(analysis.model, list(simulate.maps(data_of(run, seed=5), realization)))
        after = np.concatenate(ask(campaign.constrained_jobs(analysis, [effect], observed, range(8))))
        before = np.concatenate(ask(campaign.constrained_jobs(analysis, [], observed, range(8))))
        response = small.null.whiten_templates(np.mean(after - before, axis=0)[:, None])[:, 0]
        ratios.append(response @ expected / (expected @ expected))
    scatter = np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    assert abs(np.mean(ratios) - 1.0) < 4.0 * scatter
    assert scatter < 0.03
