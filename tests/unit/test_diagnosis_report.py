"""The report of every verdict: complete, self-contained, safe; and the numbers that it alone computes."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from html.parser import HTMLParser
from types import SimpleNamespace

import healpy
import numpy as np
import pytest
import xarray as xr
from scipy import stats

from mcsim import config, systematics
from mcsim.diagnosis import figures as plots
from mcsim.diagnosis import inference, report, report_arrays
from mcsim.diagnosis.analysis import Proposal
from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.inference import Diagnosis
from mcsim.diagnosis.refine import Refined
from mcsim.diagnosis.selection import attribute
from mcsim.diagnosis.summaries import Element
from mcsim.diagnosis.validation import Measured, Prediction, Shrink
from mcsim.diagnosis.verdict import detectable_of, effects_of, verdict_of
from mcsim.diagnosis.view import ReportView, entry_words
from mcsim.diagnosis.where import Place
from mcsim.stats.detection import confusion, snr_needed
from mcsim.stats.gaussian import null, residual_pvalue, whitened_templates
from mcsim.stats.look_elsewhere import calibrate
from mcsim.support import resources

EVIL = "<script>alert('$x_')<img src=x onerror=alert(1)>"
P, N = 30, 500
VERDICTS = ("none", "effect", "mixture", "degenerate", "unknown")


def elements() -> list[Element]:
    found = [
        Element(f"beam/{EVIL}:half{half + 1}/m{s}{part}/{low}-{low + 9}", "map", (EVIL,), f"half{half + 1}", half,
              (low, low + 9), s, 0, "even", "ecliptic")
        for half in (0, 1) for s, part in ((0, "re"), (2, "re"), (2, "im")) for low in (2, 12)
    ]  # fmt: skip
    found += [
        Element(f"dipole/V:half1/{axis}", "map", ("V",), "half1", 0, (1, 1), 1, frame="ecliptic") for axis in "xyz"
    ]
    found += [
        Element(f"sky/{low}-{low + 9}", "cl", (EVIL, "V"), None, 0, (low, low + 9), 0) for low in range(2, 92, 10)
    ]
    found += [Element(f"score/pointing_offset (V)/{k}", "score", ("V",)) for k in (0, 1)]
    found += [Element(f"noise/V/0-0.25/pixels{k}", "noise", ("V",), None, k, L=0, frame="ecliptic") for k in (0, 1)]
    return [*found, Element("mine/&<b>", "other", ("V",)), Element("square/V", "map", ("V",))]


def proposals() -> list[Proposal]:
    chosen = (("beam_ellipticity", EVIL), ("pointing_offset", "V"), ("point_sources", None))
    return [Proposal(systematics.get(name), channel, {}, systematics.get(name).basis()) for name, channel in chosen]


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
def diagnoses() -> dict[str, Diagnosis]:
    with pytest.MonkeyPatch.context() as patch:
        sky = np.random.default_rng(5).normal(size=(2, 12 * 8**2))
        sky[:, :60] = np.nan
        patch.setattr(report_arrays, "residual_maps", lambda model, maps: sky)
        return {kind: diagnosis(kind) for kind in VERDICTS}


@lru_cache
def bench(nearest_candidates: bool) -> SimpleNamespace:
    """What the five cases have in common."""
    proposed, t = proposals(), RESPONSE * templates(nearest_candidates)
    simulations = np.random.default_rng(10).normal(size=(N, P))
    model = null(simulations)
    columns = np.split(np.arange(t.shape[1]), np.cumsum([len(one.basis) for one in proposed])[:-1])
    candidates = tuple(
        Candidate(one.kind.name, one.channel, tuple(int(c) for c in own), unit=one.kind.unit)
        for one, own in zip(proposed, columns, strict=True)
    )
    return SimpleNamespace(
        run=replace(config.load(resources.workflow("quickstart")), name=EVIL),
        analysis=SimpleNamespace(elements=elements(), proposals=proposed),
        known=SimpleNamespace(simulations=simulations),
        null=model,
        candidates=candidates,
        calibration=calibrate(
            model, whitened_templates(model, t, [candidate.columns for candidate in candidates]), draws=2000
        ),
        templates=t,
        detectable=detectable_of(model, t, candidates, proposed),
    )


def diagnosis(kind: str) -> Diagnosis:
    """Through the code that makes the evidence, on constructed simulations and data."""
    context = bench(kind == "degenerate")
    t, proposed, rng = context.templates, context.analysis.proposals, np.random.default_rng(11)
    x = sum((value * t[:, k] for k, value in SIGNALS[kind].items()), rng.normal(size=P))
    if kind == "unknown":
        strange = rng.normal(size=P)
        x += 15.0 * (strange - t @ np.linalg.lstsq(t, strange, rcond=None)[0]) / np.sqrt(P)
    found = attribute(context.null, x, t, context.candidates, context.calibration)
    where = [Place(context.analysis.elements[0], 9.1, 1e-8, 8.0), Place(context.analysis.elements[-2], 1.0, 0.7, 1.2)]
    shrink = None
    if found.explanations:
        shrink = (
            Prediction(Measured(200.0, 20.0), Measured(0.93, 0.04)),
            Shrink(Measured(215.0, 30.0), Measured(20.0, 9.0), Measured(0.907, 0.051), 0.4),
            "half2 (frozen on half1)",
        )
    notes = ["a <b>note</b> & so"]
    name = f"case <i>{kind}</i>"
    verdict = verdict_of(name, found, context.candidates, proposed, where, shrink, context.detectable, notes)
    survey = SimpleNamespace(config=SimpleNamespace(map=SimpleNamespace(frame="ecliptic")))
    fiducial = SimpleNamespace(survey=survey, parts=[SimpleNamespace(name=name) for name in (EVIL, "V")])
    shown = report_arrays.report_arrays(
        fiducial, [], context.known.simulations, context.null, found, context.candidates, proposed
    )
    evidence = inference.dataset(context, x, Refined(found, t, (), ()), where, verdict)
    return Diagnosis(verdict, evidence.merge(shown, combine_attrs="no_conflicts"), found)


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


@pytest.fixture(scope="module")
def pages(diagnoses) -> Iterator[dict[str, str]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "DOTS_PER_INCH", 30)
        yield {kind: report.page(one) for kind, one in diagnoses.items()}


@pytest.mark.parametrize("kind", VERDICTS)
def test_page_is_sound_and_needs_nothing_else(diagnoses, pages, kind):
    assert diagnoses[kind].verdict["verdict"] == kind
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
def test_first_screen_says_the_verdict(diagnoses, pages, kind):
    header = Page(pages[kind].partition("</header>")[0].partition("<body>")[2]).text
    verdict = diagnoses[kind].verdict
    assert " ".join(diagnoses[kind].sentence.replace("+-", "±").split()) in header
    for effect in verdict["effects"]:
        assert report.measured(effect["amplitude"], effect["sigma"]) in header
        assert effect["unit"] in header
    assert ("90.7 ± 5.1 % of the gap" in header) == (kind in ("effect", "mixture", "degenerate"))
    assert ("cosine" in header) == (kind == "unknown")


def test_explanations_stand_side_by_side_with_what_tells_them_apart(diagnoses, pages):
    text = Page(pages["degenerate"]).text
    sets = [diagnoses["degenerate"].verdict["effects"], *diagnoses["degenerate"].verdict["alternatives"]]
    assert len(sets) == 2
    assert all(report.measured(one[0]["amplitude"], one[0]["sigma"]) in text for one in sets)
    (contrast,) = ReportView(diagnoses["degenerate"].verdict, diagnoses["degenerate"].evidence).contrasts
    assert f"differ by {contrast['separation']:.1f} sigmas" in text
    assert contrast["entries"][0]["words"] in text


def test_best_explanation_is_taken_from_what_is_left(diagnoses):
    for kind in ("effect", "mixture"):
        view = ReportView(diagnoses[kind].verdict, diagnoses[kind].evidence)
        np.testing.assert_allclose(view.prediction(0), view.evidence["explained"].values, atol=1e-12)
        # 30 unit normals: their square exceeds 80 once in a million.
        assert np.sum(view.left**2) < 80.0 < np.sum(view.z**2)
        _, _, (before, after) = view.blocks
        assert np.nanmax(np.abs(before)) == np.abs(view.z).max()
        assert np.nanmax(np.abs(after)) == np.abs(view.left).max()


def test_ranked_candidates_have_their_amplitudes(diagnoses):
    view = ReportView(diagnoses["effect"].verdict, diagnoses["effect"].evidence)
    first = view.ranked[0]
    (effect,) = diagnoses["effect"].verdict["effects"]
    assert (first.accepted, first.unit) == (True, effect["unit"])
    assert (first.amplitude, first.sigma) == (effect["amplitude"], effect["sigma"])
    assert first.p < 1e-6
    assert not any(row.accepted for row in view.ranked[1:])


def test_detectable_amplitude_and_isolating_amplitude_agree_in_strength(diagnoses):
    view = ReportView(diagnoses["none"].verdict, diagnoses["none"].evidence)
    assert [row["label"] for row in view.nearest_candidates] == view.labels
    for row, proposal in zip(view.nearest_candidates, proposals(), strict=True):
        assert confusion(row["strength"], row["cosine"]) == pytest.approx(0.05)
        found = snr_needed(len(proposal.basis), 3, P, N)
        assert row["isolated"] / row["detectable"] == pytest.approx(row["strength"] / found)


def test_report_is_a_function_of_what_is_stored(diagnoses, pages, tmp_path):
    one = diagnoses["degenerate"]
    one.save(tmp_path)
    with xr.open_zarr(tmp_path / "evidence.zarr", consolidated=False) as evidence:
        again = report.page(Diagnosis(one.verdict, evidence.load(), one.attribution))
    assert again == pages["degenerate"]
    report.write(one, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == again


def test_evidence_without_maps_has_no_map_pictures(diagnoses):
    one = diagnoses["effect"]
    text = report.page(replace(one, evidence=one.evidence.drop_vars("residual_map")))
    assert "longitude" not in Page(text).text


def test_largest_picture_leaves_the_page_small(diagnoses):
    one = diagnoses["effect"]
    sky = np.random.default_rng(1).normal(size=(20, 12 * report_arrays.NSIDE**2))
    sky[3] *= 2.0
    maps = xr.Dataset({"residual_map": (("map", "pixel"), sky)}, coords={"map": [f"W:{k}" for k in range(20)]})
    view = ReportView(one.verdict, one.evidence.drop_dims("map").merge(maps))
    figure = plots.residual_figure(view)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == plots.MAPS
    assert f"W:3: rms {np.sqrt(np.mean(sky[3] ** 2)):.2f}" in titles
    # With 1 MB for all others of 42 candidates and 222 entries the page stays below 3 MB.
    assert len(report._picture(figure, "").data) < 1_800_000


@pytest.mark.parametrize("kind", VERDICTS)
def test_first_screen_fits_its_picture(diagnoses, kind, tmp_path):
    figure = plots.first_screen(diagnoses[kind])
    figure.savefig(tmp_path / "first.png", dpi=60)
    box, whole = figure.get_tightbbox(), figure.bbox_inches
    assert box.x0 >= -0.01
    assert box.y0 >= -0.01
    assert box.x1 <= whole.x1 + 0.01
    assert box.y1 <= whole.y1 + 0.01


def test_simulations_held_out_against_refits():
    simulations = np.random.default_rng(2).normal(size=(60, 8)) @ np.random.default_rng(3).normal(size=(8, 8))
    found = report_arrays.held_out(simulations, null(simulations))
    for i in range(5):
        others = null(np.delete(simulations, i, axis=0))
        y = others.whiten(simulations[i])
        assert found[i] == pytest.approx(residual_pvalue(y @ y, 8, others.dof), rel=1e-9)


def test_simulations_held_out_are_uniform():
    simulations = np.random.default_rng(4).normal(size=(2000, 20))
    assert stats.kstest(report_arrays.held_out(simulations, null(simulations)), "uniform").pvalue > 1e-3


def test_residual_maps_are_in_units_of_noise(monkeypatch):
    nside, rng = 64, np.random.default_rng(6)
    precision = rng.uniform(1.0, 4.0, 12 * nside**2)
    residual = np.sqrt(precision) * rng.normal(size=precision.size)
    blind = healpy.query_disc(nside, (0.0, 0.0, 1.0), 0.3)
    residual[blind] = 0.0
    part = SimpleNamespace(precision=precision)
    monkeypatch.setattr(report_arrays, "wiener_filter", lambda model, maps: SimpleNamespace(residual=residual[None]))
    (coarse,) = report_arrays.residual_maps(SimpleNamespace(nside=nside, parts=[part]), [])
    assert healpy.npix2nside(coarse.size) == report_arrays.NSIDE
    assert np.isnan(coarse[0])
    # Variance of 3,000 unit normals, five sigmas.
    assert np.nanvar(coarse) == pytest.approx(1.0, abs=5 * np.sqrt(2 / np.isfinite(coarse).sum()))
    ring = healpy.ang2pix(report_arrays.NSIDE, *healpy.pix2ang(nside, np.arange(precision.size)))
    seen = (ring == 2000) & (residual != 0.0)
    assert coarse[2000] == pytest.approx(residual[seen].sum() / np.sqrt(precision[seen].sum()))


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.10034, 0.0098, "0.1003 ± 0.0098"),
        (123.4, 12.0, "123 ± 12"),
        (-2.5e-7, 3e-8, "(−2.50 ± 0.30) × 10⁻⁷"),
        (-0.00001, 0.0039, "0.0000 ± 0.0039"),
        (0.3, 0.0, "0.3"),
        (float("nan"), 1.0, "–"),
    ],
)
def test_values_are_written_to_the_digits_of_their_errors(value, sigma, text):
    assert report.measured(value, sigma) == text


def test_parameters_that_are_not_set_are_left_out():
    given = {"angle_deg": -3.0, "template": "", "axis": [1.0, 0.5], "kind": "dipole", "other": None}
    assert report.parameters(given) == "angle_deg = −3, axis = (1, 0.5), kind = dipole"


def test_tiny_probabilities_are_powers_of_ten():
    assert report.probability(1.04e-8) == "1 × 10⁻⁸"
    assert report.number(float("inf")) == "∞"


def test_entries_in_words():
    words = [entry_words({**vars(element), "ell": element.ell}) for element in elements()]
    assert "beam, order 2, imaginary, " in words[4]
    assert "half1, ℓ 2–11" in words[4]
    assert words[-3] == "noise variance, V, 0-0.25, pixels1"
    assert words[-6] != words[-5] == "matched to pointing_offset (V), component 2"


def test_an_amplitude_at_the_edge_of_the_possible_has_an_error():
    kind = systematics.get("spectrum")
    errors = np.array([0.2, 0.02, 0.02, 0.02, 0.02, 0.02])
    less_than_nothing = SimpleNamespace(amplitudes=np.array([-1.1, 0, 0, 0, 0, 0]), covariance=np.diag(errors**2))
    explanation = SimpleNamespace(members=(0,), fit=less_than_nothing)
    proposal = Proposal(kind, None, {}, kind.basis())
    (found,) = effects_of(explanation, [Candidate("spectrum", None, tuple(range(6)))], [proposal])
    assert found["amplitude"] == pytest.approx(0.99)
    # One error up is -0.9.
    assert found["sigma"] == pytest.approx((0.99 - 0.9) / 2.0, rel=1e-3)


def test_what_data_do_not_tell_is_no_part_of_an_error():
    kind = systematics.get("spectrum")
    errors = np.array([0.02, 0.02, 0.02, 0.02, 0.02, 0.4])
    fitted = SimpleNamespace(amplitudes=np.array([0.3, 0, 0, 0, 0, 1.0]), covariance=np.diag(errors**2))
    proposal = Proposal(kind, None, {}, kind.basis())
    explanation = SimpleNamespace(members=(0,), fit=fitted)
    (found,) = effects_of(explanation, [Candidate("spectrum", None, tuple(range(6)))], [proposal])
    assert found["amplitude"] == pytest.approx(0.3)
    assert found["sigma"] == pytest.approx(0.02)
