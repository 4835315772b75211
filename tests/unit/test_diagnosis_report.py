"""The report of every verdict: complete, self-contained, safe; and the numbers that it alone computes."""

import json
import re
from dataclasses import fields, replace
from functools import lru_cache, partial
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import healpy
import numpy as np
import pytest
from scipy import stats

from datasets import undescribed
from mcsim import config, systematics
from mcsim.datavector import bipolar_scan, localisation
from mcsim.datavector.candidate import Candidate, numbered
from mcsim.datavector.localisation import Place
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Element
from mcsim.diagnosis import figures as plots
from mcsim.diagnosis import report, words
from mcsim.diagnosis.assemble import result_of
from mcsim.diagnosis.refine import Refined
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.selection import Selection, attribute
from mcsim.reconstruction.result import HEAD
from mcsim.stats.detection import confusion, snr_needed
from mcsim.stats.excess import HeldOut, Measured
from mcsim.stats.gaussian import SimulatedGaussian, held_out_pvalues, residual_pvalue
from mcsim.stats.look_elsewhere import calibrate
from mcsim.support import resources
from mcsim.support.numbers import p_equals
from pictures import quick_pictures
from refusals import refused

EVIL = "<script>alert('$x_')<img src=x onerror=alert(1)>"
P, N = 30, 500
VERDICTS = ("none", "effect", "mixture", "degenerate", "unknown")


def elements() -> list[Element]:
    found = [
        Element(f"beam/{half}/{s}{part}/{low}", "map", (EVIL,), f"half{half + 1}", half, (low, low + 9), s, 0, "even",
              "ecliptic", "beam", part)
        for half in (0, 1) for s, part in ((0, None), (2, "real"), (2, "imaginary")) for low in (2, 12)
    ]  # fmt: skip
    found += [
        Element(f"dipole/{axis}", "map", ("V",), "half1", 0, (1, 1), 1, frame="ecliptic", kind="dipole", component=axis)
        for axis in "xyz"
    ]
    found += [
        Element(f"sky/{low}", "cl", (EVIL, "V"), None, 0, (low, low + 9), 0, kind="sky") for low in range(2, 92, 10)
    ]
    found += [
        Element(f"score/{k}", "score", ("V",), kind="matched", component=f"component {k + 1}", effect="offset of V")
        for k in (0, 1)
    ]
    found += [Element(f"noise/{k}", "noise", ("V",), None, k, L=0, frame="ecliptic", kind="noise") for k in (0, 1)]
    return [*found, Element("mine/&<b>", "other", ("V",)), Element("square/V", "map", ("V",), kind="square")]


def proposals() -> tuple[Candidate, ...]:
    chosen = (("beam_ellipticity", EVIL), ("pointing_offset", "V"), ("point_sources", None))
    kinds = [(systematics.get(name), channel) for name, channel in chosen]
    return numbered(
        [Candidate(kind, channel, tuple(range(len(kind.parametrization.basis())))) for kind, channel in kinds]
    )


def templates(nearest_candidates: bool) -> np.ndarray:
    """Directions of about unit length; those of the first two candidates all but agree where they are twins."""
    t = np.random.default_rng(3).normal(size=(P, sum(len(one.basis) for one in proposals())))
    if nearest_candidates:
        t[:, 2:4] = t[:, :2] + 0.02 * t[:, 2:4]
    return t / np.linalg.norm(t[:, 0])


SIGNALS = {
    "none": {},
    "effect": {0: 0.3},
    "mixture": {0: 0.3, -1: 0.4},
    "degenerate": {0: 0.3, 1: 0.1},
    "unknown": {-1: 0.15},
}
"""Coordinates of the templates in the data."""

RESPONSE = 50.0
"""Standard deviations of an entry per unit of amplitude."""


@pytest.fixture(scope="module")
def diagnoses() -> dict[str, DiagnosisResult]:
    return {kind: diagnosis(kind) for kind in VERDICTS}


@lru_cache
def bench(nearest_candidates: bool) -> SimpleNamespace:
    """What the five cases have in common."""
    candidates, t = proposals(), RESPONSE * templates(nearest_candidates)
    simulations = np.random.default_rng(10).normal(size=(N, P))
    held = {"simulations": simulations, "held_out_pvalues": partial(held_out_pvalues, simulations)}
    model = SimulatedGaussian.from_simulations(simulations)
    spread = np.random.default_rng(12).normal(size=(5, 2))
    fiducial = SimpleNamespace(frame="ecliptic", parts=[SimpleNamespace(name=name) for name in (EVIL, "V")])
    context = SimpleNamespace(
        run=replace(config.load(resources.workflow("quickstart")), name=EVIL),
        analysis=SimpleNamespace(elements=tuple(elements()), model=fiducial, candidates=candidates),
        settings=DiagnosisSettings(beam_bins=(5, 2, 2, 1, 1), place_pvalue=0.0123),
        ensemble=SimpleNamespace(**held, residual_rms=1.0 + 0.1 * spread, nuisances=None),
        null=model,
        candidates=candidates,
        calibration=calibrate(model, model.whiten_groups(t, [one.columns for one in candidates]), draws=2000),
        templates=t,
    )
    context.of_model, context.frame = context, fiducial.frame
    return context


def diagnosis(kind: str) -> DiagnosisResult:
    """Through the code that makes the evidence, on constructed simulations and data."""
    context = bench(kind == "degenerate")
    t, rng = context.templates, np.random.default_rng(11)
    x = sum((value * t[:, k] for k, value in SIGNALS[kind].items()), rng.normal(size=P))
    if kind == "unknown":
        strange = rng.normal(size=P)
        x += 15.0 * (strange - t @ np.linalg.lstsq(t, strange, rcond=None)[0]) / np.sqrt(P)
    found = attribute(Selection(context.null, x, t, context.candidates, context.calibration))
    where = [Place(context.analysis.elements[0], 9.1, 1e-8), Place(context.analysis.elements[-2], 1.0, 0.7)]
    reduction = None
    if found.explanations:
        predicted, achieved = Measured(0.93, 0.04), Measured(0.907, 0.051)
        before, after = Measured(215.0, 30.0), Measured(20.0, 9.0)
        reduction = HeldOut(predicted, achieved, before, after, 0.4, "half2 (frozen on half1)")
    sky = np.random.default_rng(5).normal(size=(2, 12 * 8**2))
    sky[:, :60] = np.nan
    data = SimpleNamespace(
        context=context, x=x, places=lambda: where, residual_maps=lambda: sky, provenance=lambda: {"level": 0.05}
    )
    refined = Refined(found, t, context.candidates, t)
    return result_of(data, f"case <i>{kind}</i>", refined, reduction, ["a <b>note</b> & so"])


class Page(HTMLParser):
    """Tags that are open, all tags with attributes, and the text."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


class Pages(dict[str, str]):
    """Each drawn when a test first asks for it: another process may have the other tests."""

    def __init__(self, diagnoses: dict[str, DiagnosisResult]) -> None:
        super().__init__()
        self.diagnoses = diagnoses

    def __missing__(self, kind: str) -> str:
        with quick_pictures(empty=kind in ("none", "effect")):  # the others have all that these have
            self[kind] = report.page(self.diagnoses[kind])
        return self[kind]


@pytest.fixture(scope="module")
def pages(diagnoses) -> Pages:
    return Pages(diagnoses)


@pytest.mark.parametrize("kind", VERDICTS)
def test_page_is_sound_and_needs_nothing_else(diagnoses, pages, kind):
    assert diagnoses[kind].to_json()["verdict"] == kind
    text = pages[kind]
    page = Page(text)
    assert page.open == []
    links = [value for _, attrs in page.tags for key, value in attrs.items() if key in ("src", "href", "srcset")]
    ids = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    assert links
    assert all(link.startswith("data:image/png;base64,") or link.removeprefix("#") in ids for link in links)
    assert "http" not in text
    assert "url(" not in text
    assert all(attrs.get("alt") for tag, attrs in page.tags if tag == "img")


@pytest.mark.parametrize("kind", VERDICTS)
def test_names_from_configurations_stay_text(pages, kind):
    page = Page(pages[kind])
    assert {tag for tag, _ in page.tags}.isdisjoint({"script", "i", "b"})
    assert not any(key.startswith("on") for _, attrs in page.tags for key in attrs)
    assert EVIL in page.text
    assert "a <b>note</b> & so" in page.text


@pytest.mark.parametrize("kind", VERDICTS)
def test_first_screen_says_what_was_tested_and_found(diagnoses, pages, kind):
    header = Page(pages[kind].partition("</header>")[0].partition("<body>")[2]).text
    result = diagnoses[kind]
    for text in (words.sentence(result), words.status(result), words.tested(result), words.chi2(result)):
        assert " ".join(text.split()) in header
    assert f"{P} elements" in header
    assert f"{N} simulations" in header
    assert "measured from 1 map;" in words.tested(replace(result, elements=(), maps=("W",)))
    for effect in result.effects:
        assert effect.words in header
        assert effect.label in header
    assert (words.held_out(result) in header) == (kind in ("effect", "mixture", "degenerate"))
    assert ("91 % ± 5 %" in header) == (kind in ("effect", "mixture", "degenerate"))
    assert ("cosine" in header) == (kind == "unknown")


@pytest.mark.parametrize("faint", [False, True])
@pytest.mark.parametrize(("pvalue", "said"), [(0.03, True), (1e-4, False)])
def test_a_marginal_departure_without_a_cause_may_be_chance(diagnoses, pvalue, said, faint):
    known = diagnoses["unknown"]
    result = replace(known, test=replace(known.test, pvalue=pvalue), faint=faint, probability=0.1)
    assert ["may be chance" in words.sentence(result), "3 % of cases" in words.status(result)] == [said, said]


def test_an_unknown_gap_says_what_the_nearest_candidate_leaves(diagnoses, tmp_path):
    known = diagnoses["unknown"]
    assert 0.0 < known.nearest_pvalue < 1e-4
    assert f"what it leaves {words.residual(known.nearest_pvalue)}" in words.status(known)
    known.save(tmp_path)
    assert DiagnosisResult.open(tmp_path).nearest_pvalue == known.nearest_pvalue
    assert "leaves" not in words.status(replace(known, nearest_pvalue=None))  # of version 0.1


@pytest.mark.parametrize(("pvalue", "said"), [(1e-8, True), (0.2, False)])
def test_a_group_that_departs_by_itself_is_told_where_the_global_test_finds_nothing(diagnoses, pvalue, said):
    known = diagnoses["none"]
    result = replace(known, places=(replace(known.places[0], p=pvalue), *known.places[1:]))
    assert ("one group of numbers" in words.sentence(result)) == said
    assert (known.places[0].element.words in words.status(result)) == said
    assert ("detectable amplitude" in words.status(result)) != said


def test_global_chi2_is_near_its_degrees_of_freedom_where_the_model_is_right(diagnoses):
    test, excess = diagnoses["none"].test, diagnoses["none"].excess
    # The raw statistic is larger by (N - 1)/(N - 2 - p).
    assert excess.value + test.dimension == pytest.approx(test.chi2 * (N - 2 - P) / (N - 1))
    assert abs(excess.value) < 4.0 * excess.sigma


MARGINAL, AGREES = "marginally compatible", "agrees with the simulations"


@pytest.mark.parametrize("kind", ["effect", "mixture", "degenerate"])
@pytest.mark.parametrize("fitted", [0.9, 0.03, 0.001])
@pytest.mark.parametrize("fresh", [0.9, 0.0079, 1e-9])
def test_sentences_agree_with_the_p_values_beside_them(diagnoses, kind, fitted, fresh):
    one = diagnoses[kind]
    best = replace(one.sets[0], pvalue=fitted)
    result = replace(one, sets=(best, *one.sets[1:]), held_out=replace(one.held_out, pvalue_after=fresh))
    for text, p in ((words.status(result), fitted), (words.held_out(result), fresh)):
        assert p_equals(p) in text
        assert (AGREES in text) == (p > words.AGREES)
        assert (MARGINAL in text) == (words.DISAGREES < p <= words.AGREES)
        assert ("does not agree" in text) == (p <= words.DISAGREES)
    if kind != "degenerate":
        assert ("reservation" in words.status(result)) == (min(fitted, best.further) <= words.AGREES)


@pytest.mark.parametrize("kind", ["effect", "mixture", "degenerate"])
@pytest.mark.parametrize(("alone", "said"), [(0.5, False), (1e-50, True)])
def test_what_a_residual_passes_by_is_told(diagnoses, kind, alone, said):
    """A wrong effect of S/N 5000 passes with p = 1, as errors of 1 % of its response are tolerated."""
    one = diagnoses[kind]
    best = replace(one.sets[0], pvalue=1.0, pvalue_alone=alone)
    text = words.status(replace(one, sets=(best, *one.sets[1:])))
    assert ("tolerated, p = 10⁻⁵⁰ without)" in text or "tolerated, p = 1 × 10⁻⁵⁰ without)" in text) == said
    assert ("agrees with the simulations (p = 1)" in text) != said


def test_a_reduction_that_is_not_measured_is_not_quoted(diagnoses):
    one = diagnoses["effect"]
    vague = replace(one, held_out=replace(one.held_out, achieved=Measured(0.5, 2.0)))
    assert ["50" in words.held_out(vague), "215 ± 30" in words.held_out(vague)] == [False, True]
    # An amplitude that one half hardly knows may leave anything of the other.
    assert p_equals(vague.held_out.pvalue_after) not in words.held_out(vague)
    assert "Not measured" in words.held_out(replace(one, held_out=None))


@pytest.mark.parametrize("kind", VERDICTS)
def test_the_summary_has_about_ten_lines(diagnoses, kind, tmp_path):
    lines, many = (words.summary(replace(diagnoses[kind], sets=n * diagnoses[kind].sets), tmp_path) for n in (1, 4))
    assert 5 <= len(lines) <= 12
    assert str(tmp_path) in lines[-1]
    assert any("more set" in line for line in many[4:]) == bool(diagnoses[kind].sets)
    assert all(any(effect.words in line for line in lines) for effect in diagnoses[kind].effects)


MADE_UP = r"\b(heard|hears?|listen\w*|twins?|court|exhibits?|sitting|urn|believed|referee|atlas|gap|shrinks?)\b"


@pytest.mark.parametrize("kind", VERDICTS)
def test_pages_are_in_the_words_of_the_field(pages, kind):
    text = Page(pages[kind]).text.replace("sim-to-real gap", "")
    assert re.findall(MADE_UP, text, flags=re.IGNORECASE) == []


def test_sets_stand_side_by_side_with_what_tells_them_apart(diagnoses, pages):
    text, result = Page(pages["degenerate"]).text, diagnoses["degenerate"]
    assert len(result.sets) == 2
    assert all(one.effects[0].words in text for one in result.sets)
    (contrast,) = result.contrasts
    assert f"differ by {contrast.separation:.1f} standard deviations" in text
    assert result.elements[contrast.elements[0]].words in text


def test_best_set_is_taken_from_what_is_left(diagnoses):
    for kind in ("effect", "mixture"):
        result = diagnoses[kind]
        columns = [column for k in result.sets[0].candidates for column in result.candidates[k].columns]
        t = result.templates[:, columns] @ np.array(result.sets[0].coordinates)
        np.testing.assert_allclose(result.prediction(0), t / result.standard_deviation)
        # 30 unit normals: their square exceeds 80 once in a million.
        assert np.sum(result.z_after**2) < 80.0 < np.sum(result.z**2)


def test_ranked_candidates_have_their_amplitudes(diagnoses):
    result = diagnoses["effect"]
    first, (effect,) = result.ranked[0], result.effects
    assert (first.label, first.unit) == (effect.label, effect.unit)
    assert (first.amplitude, first.sigma) == (effect.amplitude, effect.sigma)
    assert first.pvalue < 1e-6


def test_detectable_and_separable_amplitudes_agree_in_strength(diagnoses):
    for row, proposal in zip(diagnoses["none"].candidates, proposals(), strict=True):
        assert confusion(row.strength, row.correlation) == pytest.approx(0.05)
        found = snr_needed(len(proposal.basis), 3, P, N)
        assert row.separable / row.detectable == pytest.approx(row.strength / found)


def test_settings_are_stored_and_printed(diagnoses, pages, tmp_path):
    diagnoses["none"].save(tmp_path)
    assert DiagnosisResult.open(tmp_path).settings == DiagnosisSettings(beam_bins=(5, 2, 2, 1, 1), place_pvalue=0.0123)
    text = Page(pages["none"]).text
    assert "place_pvalue 0.0123" in text
    assert "level 0.05" in text


@pytest.mark.parametrize(
    "kind", [kind if kind == "mixture" else pytest.param(kind, marks=pytest.mark.slow) for kind in VERDICTS]
)
def test_result_comes_back_from_disk_as_it_was(diagnoses, pages, tmp_path, kind):
    one = diagnoses[kind]
    one.save(tmp_path)
    again = DiagnosisResult.open(tmp_path)
    assert again.to_dataset().identical(one.to_dataset())
    assert undescribed(one.to_dataset()) == []
    assert again.to_json() == json.loads((tmp_path / "verdict.json").read_text())
    for field in fields(one):
        if field.name not in ("candidates", "residual_maps"):  # with NaN
            np.testing.assert_equal(getattr(again, field.name), getattr(one, field.name))
    with quick_pictures(empty=kind != "mixture"):
        assert report.page(again) == (pages[kind] if kind == "mixture" else report.page(one))


@pytest.mark.parametrize("made", ["", "diagnosis.zarr"])
def test_a_folder_without_a_whole_diagnosis_is_named(tmp_path, made):
    (tmp_path / made).mkdir(exist_ok=True)
    with refused(tmp_path.name):
        DiagnosisResult.open(tmp_path)


def test_effects_of_an_earlier_verdict_are_deleted_unless_they_are_used(diagnoses, tmp_path):
    """Those that the run names, or that are candidates, are; a file that somebody else wrote stays."""
    one = diagnoses["effect"]
    plain = json.loads(one.configuration) | {"effect": [{"name": str(tmp_path / "unlisted_1.py"), "channel": "V"}]}
    given = replace(one.candidates[0], name="unlisted_2")
    used = replace(one, configuration=json.dumps(plain), candidates=(given, *one.candidates[1:]))
    for k in range(1, 5):
        (tmp_path / f"unlisted_{k}.py").write_text("mine" if k == 3 else HEAD)
    used.save(tmp_path)
    assert sorted(path.stem for path in tmp_path.glob("*.py")) == ["unlisted_1", "unlisted_2", "unlisted_3"]
    one.save(tmp_path)
    assert sorted(path.stem for path in tmp_path.glob("*.py")) == ["unlisted_3"]


def test_tables_of_spectra_have_no_map_pictures(diagnoses, tmp_path):
    one = replace(diagnoses["effect"], residual_maps=None, residual_range=None)
    dipole = Place(elements()[12], 3.0, 0.1)  # of one degree, which is no range
    with quick_pictures(empty=True):
        text = Page(report.page(replace(one, places=(dipole,)))).text
    assert "longitude" not in text
    assert "1–1" not in text
    one.save(tmp_path)
    assert DiagnosisResult.open(tmp_path).residual_maps is None


@pytest.mark.slow
def test_largest_picture_leaves_the_page_small(diagnoses):
    sky = np.random.default_rng(1).normal(size=(20, 12 * bipolar_scan.NSIDE**2))
    sky[3] *= 2.0
    names, ends = tuple(f"W:{k}" for k in range(20)), np.tile([0.97, 1.03], (20, 1))
    figure = plots.residual_figure(replace(diagnoses["effect"], residual_maps=sky, maps=names, residual_range=ends))
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == plots.MAPS
    assert f"W 3: rms {np.sqrt(np.mean(sky[3] ** 2)):.2f} (simulations 0.97 to 1.03)" in titles
    # With 1 MB for all others of 42 candidates and 222 elements the page stays below 3 MB.
    assert len(report._picture(figure, "")["data"]) < 1_800_000


def test_simulations_held_out_against_refits():
    simulations = np.random.default_rng(2).normal(size=(60, 8)) @ np.random.default_rng(3).normal(size=(8, 8))
    found = held_out_pvalues(simulations, SimulatedGaussian.from_simulations(simulations))
    for i in range(5):
        others = SimulatedGaussian.from_simulations(np.delete(simulations, i, axis=0))
        y = others.whiten(simulations[i])
        assert found[i] == pytest.approx(residual_pvalue(y @ y, 8, others.dof), rel=1e-9)


def test_simulations_held_out_are_uniform():
    simulations = np.random.default_rng(4).normal(size=(2000, 20))
    found = held_out_pvalues(simulations, SimulatedGaussian.from_simulations(simulations))
    assert stats.kstest(found, "uniform").pvalue > 1e-3


def test_coarse_residuals_add_up_the_pixels_of_each_coarse_one():
    nside, rng = 64, np.random.default_rng(6)
    residual = rng.normal(size=(2, 12 * nside**2))
    found = bipolar_scan.coarse_residuals(SimpleNamespace(nside=nside), SimpleNamespace(residual=residual))
    assert healpy.npix2nside(found.shape[1]) == bipolar_scan.NSIDE
    inside = healpy.ang2pix(bipolar_scan.NSIDE, *healpy.pix2ang(nside, np.arange(residual.shape[1]))) == 2000
    np.testing.assert_allclose(found[:, 2000], residual[:, inside].sum(axis=1))


def test_standardised_maps_have_unit_variance_for_any_number_of_simulations():
    rng, count, pixels = np.random.default_rng(7), 12, 40_000
    drawn = 3.0 + 2.0 * rng.normal(size=(count + 1, 1, pixels))
    drawn[:, :, :10] = 0.0
    mean, scatter = drawn[1:].mean(axis=0), drawn[1:].std(axis=0, ddof=1)
    z = localisation.standardised(drawn[0], mean, scatter, count)
    assert np.all(np.isnan(z[:, :10]))
    # Student's t with 11 degrees of freedom over its scatter: kurtosis 3 + 6/7; five standard errors.
    assert np.nanmean(z**2) == pytest.approx(1.0, abs=5.0 * np.sqrt((2.0 + 6.0 / 7.0) / pixels))


def test_parameters_that_are_not_set_are_left_out():
    given = {"angle_deg": -3.0, "template": "", "axis": [1.0, 0.5], "kind": "dipole", "other": None}
    assert report.parameters(given) == "angle_deg = −3, axis = (1, 0.5), kind = dipole"


def test_elements_in_words():
    found = [element.words for element in elements()]
    assert found[4].startswith("residual × sky through the beam, order 2, ")
    assert found[4].endswith("half1, ℓ 2–11, imaginary")
    assert found[-6] != found[-5] == "matched filter: offset of V, component 2"
    assert found[-2] == "other, V"


def test_elements_that_are_not_tested_are_counted_and_folded(diagnoses):
    result = replace(diagnoses["none"], untested=("power of V", "power of W"))
    with quick_pictures(empty=True):
        page = report.page(result)
    said = f"2 of {P} elements are not tested"
    assert page.count(said) == 1
    assert page.index("<summary>" + said) < page.index("<li>power of V</li>")
    assert result.to_json()["untested"] == ["power of V", "power of W"]
    assert "untested" not in diagnoses["none"].to_json()
    assert [said in line for line in words.summary(result, Path("out"))].count(True) == 1


def test_no_number_is_crossed_by_the_line_of_what_was_predicted(diagnoses):
    """Wherever it is: below the bar, within it, or far beyond."""
    own = diagnoses["effect"]
    for share in (-0.2, 0.5, 1.02):
        held_out = replace(own.held_out, predicted=replace(own.held_out.predicted, value=share))
        figure = plots.excess_figure(replace(own, held_out=held_out))
        (axes,) = figure.axes
        figure.canvas.draw()
        line = axes.lines[0].get_window_extent()
        for text in axes.texts:
            assert not text.get_window_extent().overlaps(line)
            assert text.get_window_extent().x1 < figure.bbox.x1
