"""Challenges on toys: seals, draws, the best classifier, and what the score makes of records."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, stats

from mcsim import config, systematics
from mcsim.benchmark.bayes import BayesClassifier
from mcsim.benchmark.case import Drawn, Member, Prior, Record
from mcsim.benchmark.models import linear_model, simulated
from mcsim.benchmark.report import lines, write
from mcsim.benchmark.sampler import CaseSampler
from mcsim.benchmark.score import Draw, _is_named, draws, judge, powers
from mcsim.benchmark.summary import Score, confusion
from mcsim.datavector.analysis import Analysis, Job
from mcsim.datavector.campaign import batch, reduced
from mcsim.datavector.candidate import Candidate, TemplateBank, numbered
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Block, Element
from mcsim.diagnosis.context import context
from mcsim.errors import InputError
from mcsim.stats.intervals import pulls
from mcsim.stats.look_elsewhere import global_test
from mcsim.systematics.signatures import SIGNATURES, any_place_right
from refusals import refused

ENTRIES = 24

SENSITIVITY = 100.0
"""Response to an amplitude of 1 over the noise of an element: effects show at amplitudes within their bounds."""


def toy(names, simulations=800, seed=1, common=0.0):
    """Learn effects with random templates, alike in both folds, and unit noise; ``common``: their cosine."""
    rng = np.random.default_rng(seed)
    kinds = [(systematics.get(name), channel) for name, channel in names]
    candidates = numbered(
        [Candidate(kind, channel, tuple(range(len(kind.parametrization.basis())))) for kind, channel in kinds]
    )
    columns = sum(len(candidate.columns) for candidate in candidates)
    directions = np.linalg.qr(rng.standard_normal((ENTRIES // 2, columns)))[0]
    directions = np.sqrt(1.0 - common) * directions + np.sqrt(common) * directions[:, :1]
    templates = SENSITIVITY * np.repeat(directions, 2, axis=0)
    elements = [Element(f"entry{i}", "map", ("A",), None, i % 2) for i in range(ENTRIES)]
    blocks = [Block(tuple(elements), lambda filtered: np.zeros(ENTRIES))]
    rows = [templates]
    for number, candidate in enumerate(candidates):
        score = Element(f"score/{candidate.label}/0", "score", ("A",), candidate=candidate.name)
        blocks.append(Block((score,), lambda filtered: np.zeros(1)))
        row = np.zeros((1, columns))
        row[0, number] = 0.5 * SENSITIVITY
        rows.append(row)
    t = np.concatenate(rows)
    p = len(t)
    described = tuple(element for block in blocks for element in block.elements)
    ensemble = NullEnsemble(
        rng.standard_normal((simulations, p)), np.zeros(p), described, np.zeros((24, p)), *np.zeros((4, 0, 0))
    )
    model = SimpleNamespace(lmax=128, sky_power=np.ones(129), settings=DiagnosisSettings())
    labels = tuple(label for candidate in candidates for label in candidate.labels)
    bank = TemplateBank(t, np.zeros_like(t), np.zeros_like(t), labels, *np.ones((2, t.shape[1])))
    return context(Analysis(model, candidates, tuple(blocks)), ensemble, bank)


NAMES = (("beam_width", "A"), ("noise_level", "A"), ("beam_ellipticity", "A"), ("beam_width", "B"), ("spectrum", None))


@pytest.fixture(scope="module")
def learned():
    return toy(NAMES[:4])


@pytest.fixture(scope="module")
def linear(learned):
    return linear_model(learned)


def member(name="beam_width", channel="A", **changes):
    values = {"parameters": {"amplitude": 0.01}, "coordinates": (0.01,), "strength": 6.0, "candidate": 0}
    return Member(name, channel, **(values | changes))


# Draws


def test_cases_do_not_depend_on_how_many_there_are(linear):
    sampler = CaseSampler(Prior(), linear)
    few, many = sampler.kinds(3, 20), sampler.kinds(3, 400)
    assert many[:20] == few
    assert [sampler.draw(few, 3, case) for case in range(20)] == [sampler.draw(many, 3, case) for case in range(20)]
    assert "invented" not in many
    # 20, 45, 15 and 12 of 92; 4 sigma.
    for kind, part in (("none", 20), ("one", 45), ("two", 15), ("left_out", 12)):
        share = part / 92
        assert abs(many.count(kind) - 400 * share) < 4 * np.sqrt(400 * share * (1 - share))


def test_more_effects_than_can_be_drawn_are_refused():
    model = linear_model(toy((("beam_width", "A"),)))
    sampler = CaseSampler(Prior(none=0, one=0, two=1, left_out=0), model)
    with refused(2, 1):
        sampler.draw(sampler.kinds(1, 1), 1, 0)
    sampler = CaseSampler(Prior(none=0, one=0, two=0, left_out=1, weakest=1e90, strongest=1e91), model)
    with refused(1, 1e90, 0):
        sampler.draw(sampler.kinds(1, 1), 1, 0)


def test_fresh_data_leave_all_simulations_to_the_covariance(learned):
    fresh = np.random.default_rng(3).standard_normal((7, learned.ensemble.simulations.shape[1]))
    for names in ((), ("beam_width",)):
        model = linear_model(learned, names, fresh)
        assert model.null.n_sims == len(learned.ensemble.simulations)
        np.testing.assert_array_equal(model.data, fresh[:, model.rows])


def test_the_data_of_draws_are_other_simulations_for_each_seed():
    """None is made twice, nor with a seed that people choose."""
    run, asked = config.load("quickstart"), []
    known = SimpleNamespace(run=run, analysis=SimpleNamespace(job=lambda one: Job("", one.ensemble.seed, 0, 0)))

    def ask(jobs):
        asked.extend((job.simulated, n) for job in jobs for n in range(job.first, job.first + job.count))
        return [np.zeros((job.count, 3)) for job in jobs]

    assert [len(simulated(known, 25, seed, ask)) for seed in (1, 2)] == [25, 25]
    assert len(set(asked)) == 50
    assert min(seed for seed, _ in asked) >= 2**40


def test_what_is_left_out_rotates(linear):
    sampler = CaseSampler(Prior(none=0, one=0, two=0, left_out=1), linear)
    kinds = sampler.kinds(1, 6)
    names = [sampler.draw(kinds, 1, case).without[0] for case in range(6)]
    assert sorted(names[:3]) == sorted(names[3:]) == sorted(set(sampler.names))


def test_an_effect_that_cannot_be_strong_enough_is_not_drawn(linear, monkeypatch):
    library, prior = linear, Prior()
    name = CaseSampler(prior, library).names[0]
    same = [index for index, candidate in enumerate(library.candidates) if candidate.name == name]
    columns = [column for index in same for column in library.candidates[index].columns]
    strongest = max(library.null.expected_snr(library.templates[:, column]) for column in columns)
    for factor in (1.01, 0.99):
        kind = library.candidates[same[0]].effect
        largest = factor * prior.weakest / strongest
        monkeypatch.setattr(kind, "parametrization", replace(kind.parametrization, max_amplitude=largest))
        assert (name in CaseSampler(prior, library).names) is (factor > 1)


def test_strengths_are_the_drawn_ones(learned, linear):
    """Length of the response, by the covariance that the toy was made with; known to 5 % from 600 simulations."""
    sampler = CaseSampler(Prior(none=0, one=1, two=0, left_out=0), linear)
    kinds = sampler.kinds(1, 200)
    for case in range(200):
        (found,) = sampler.draw(kinds, 1, case).members
        assert 3.0 * (1 - 1e-6) < found.strength < 20.0 * (1 + 1e-6)
        columns = list(learned.candidates[found.candidate].columns)
        length = np.linalg.norm(learned.bank.matrix[:, columns] @ found.coordinates)
        assert length == pytest.approx(found.strength, rel=0.15)


def test_drawn_effects_are_possible():
    """Also where the isotropic direction asks for a parameter beyond its bounds."""
    linear = linear_model(toy((("beam_sidelobe", "A"), ("beam_width", "A"))))
    sampler = CaseSampler(Prior(), linear)
    for case in range(30):
        for one in sampler.members(np.random.default_rng(case), 2):
            effect = linear.candidates[one.candidate].effect(**one.parameters)
            assert effect.within_bounds() is effect


@pytest.mark.parametrize("wrong", [{"weakest": 5.0, "strongest": 2.0}, {"weakest": 0.0}, {"one": -0.1}])
def test_a_prior_that_is_none_is_refused(wrong):
    with pytest.raises(InputError):
        Prior(**wrong)
    for name in ("weakest", "strongest", "two"):
        for value in (float("inf"), 1e300, float("nan"), "20"):
            with refused(name, value):
                Prior(**{name: value})
    with pytest.raises(InputError):
        Prior(none=0, one=0, two=0, left_out=0)


def test_power_of_one_template_is_the_known_one():
    """One candidate of one column: the score test's power is a noncentral F's, no trials."""
    model = linear_model(toy(NAMES[:1], simulations=2400))
    found = powers(model, 1500, 4)
    expected = np.interp(found.strengths, found.grid, found.finite)
    excess = np.sum(found.by_maximum) - expected.sum()
    # Data are 600 held-out simulations, each used two or three times: their noise is common to the draws.
    assert abs(excess) < 4.0 * np.sqrt(2.5 * np.sum(expected * (1.0 - expected)))
    assert found.limit[-1] > 0.99
    quiet = [global_test(model.null, x, model.groups, model.calibration) for x in model.data]
    np.testing.assert_array_equal(found.null_gap, [one.pvalue for one in quiet])
    false = sum(one.maximum <= 0.05 for one in quiet)
    low, high = stats.binom.ppf((1e-4, 1 - 1e-4), len(quiet), 0.05)
    assert low <= false <= high


@pytest.mark.slow
def test_draws_are_judged(learned, linear, tmp_path):
    with batch(0) as call:
        records = draws(learned, 80, 2, Prior(), call)
    assert [record.case for record in records] == [f"draw-{number:05d}" for number in range(80)]
    found = Score("toy", records, powers(linear, 300, 2))
    strong = [record for record in records if record.kind == "one" and record.strength > 6]
    # Nearly orthogonal templates, far above the threshold: only the 5 % of true sets that are refused go wrong.
    wrong = sum(not record.right for record in strong)
    assert wrong <= stats.binom.ppf(1 - 1e-4, len(strong), 0.06)
    assert sum(record.bayes != record.truth for record in strong) <= 2
    assert all(record.distances[0] >= record.distances[-1] for record in records if record.kind == "left_out")
    figures = {metric.name: metric for metric in found.metrics}
    assert figures["excess chi^2 removed, S/N >= 8"].value > 0.8
    assert abs(figures["excess chi^2 removed by an effect that does not act"].value) < 0.1
    # Named or not, so that choosing what to name has no say: unit normals, of n an error of their mean of 1/sqrt(n).
    ones = [record for record in records if record.kind == "one"]
    fitted = np.array([pull for record in ones for pull in record.fitted])
    assert len(fitted) >= len(ones)
    assert abs(fitted.mean()) < 4.0 / np.sqrt(len(fitted))
    assert abs(fitted.std() - 1.0) < 4.0 / np.sqrt(2 * len(fitted))
    assert all(set(record.pulls) <= set(record.fitted) for record in records)
    write(found, tmp_path / "score")
    page = (tmp_path / "score" / "report.html").read_text()
    assert "data:image/png;base64" in page
    assert "http" not in page
    assert any("false alarms" in line for line in lines(found))


def test_an_out_of_library_effect_is_called_unknown(linear):
    """A response at right angles to every template, at ten sigmas, in 40 skies: no name, but where noise adds one."""
    here = linear
    rng = np.random.default_rng(8)
    left = here.null.whiten_templates(here.templates)
    basis = np.linalg.qr(left)[0]
    found = []
    for case in range(40):
        direction = rng.standard_normal(here.null.dimension)
        direction -= basis @ (basis.T @ direction)
        response = np.linalg.lstsq(here.null.whiten_templates(np.eye(len(here.templates))), direction, rcond=None)[0]
        length = np.sqrt(here.null.hartlap_factor) * np.linalg.norm(here.null.whiten_templates(response[:, None]))
        invented = member("invented", candidate=None, response=tuple(10.0 / length * response))
        found.append(Draw(case, Drawn(kind="invented", members=(invented,)), 10.0 / length * response))
    records = judge(linear, Prior(), 0, found)
    assert all(record.distances[-1] > 9.9 for record in records)
    assert all(record.bayes is None for record in records)
    assert sum(record.verdict == "unknown" for record in records) >= 38
    assert sum(record.wrong_name for record in records) <= 1


# The Bayes classifier


@pytest.mark.slow
def test_pairs_have_the_marginal_likelihood_of_brute_force():
    """Likelihood times prior of two amplitudes on a grid, against importance sampling; many simulations: Gaussian."""
    prior = Prior(none=0.2, one=0.5, two=0.3, left_out=0, invented=0, weakest=2.0, strongest=10.0)
    here = linear_model(toy(NAMES[:2], simulations=20_000, common=0.3))
    bayes = BayesClassifier(CaseSampler(prior, here))
    white = here.null.whiten_templates(here.templates)
    unit = white / np.linalg.norm(white, axis=0)
    noise = np.random.default_rng(3).standard_normal(here.null.dimension)
    s = np.concatenate([-np.linspace(10, 2, 1201), np.linspace(2, 10, 1201)])
    density = 1.0 / (2.0 * np.abs(s) * np.log(5.0))

    def area(values, axis=-1):
        half = len(s) // 2
        first, second = np.split(values, [half], axis=axis)
        return integrate.simpson(first, x=s[:half], axis=axis) + integrate.simpson(second, x=s[half:], axis=axis)

    for a, b in ((4.0, 3.0), (5.0, 0.0), (0.0, 0.0), (3.0, -2.5)):
        y = noise + a * unit[:, 0] + b * unit[:, 1]
        x = here.null.mean + np.linalg.lstsq(here.null.whitening, y * np.sqrt(1 + 1 / here.null.n_sims), rcond=None)[0]
        square = s[:, None] ** 2 + s[None, :] ** 2 + 2 * s[:, None] * s[None, :] * (unit[:, 0] @ unit[:, 1])
        both = s[:, None] * (unit[:, 0] @ y) + s[None, :] * (unit[:, 1] @ y) - 0.5 * square
        pair = area(area(np.exp(both) * density[:, None] * density[None, :]))
        ones = [area(np.exp(s * (unit[:, i] @ y) - 0.5 * s**2) * density) for i in (0, 1)]
        weights = np.array([0.2, 0.25 * ones[0], 0.25 * ones[1], 0.3 * pair])
        names = [frozenset(), *(frozenset([NAMES[i]]) for i in (0, 1)), frozenset(NAMES[:2])]
        found = bayes.probabilities(x)
        # 256 draws of a density that varies by a few: 3 %.
        for name, expected in zip(names, weights / weights.sum(), strict=True):
            assert found.get(name, 0.0) == pytest.approx(expected, abs=0.03)


def test_pairs_have_the_prior_that_they_are_drawn_with():
    """The rarer a first effect, the more often is a second another one: of 3000 pairs 500 were to be of two widths."""
    sampler = CaseSampler(Prior(), linear_model(toy((NAMES[0], NAMES[3], NAMES[4]))))
    draw, count = np.random.default_rng(5), 3000
    drawn = [tuple(sorted(one.candidate for one in sampler.members(draw, 2))) for _ in range(count)]
    pairs = BayesClassifier(sampler)._pairs
    assert sum(pairs.values()) == pytest.approx(1.0, abs=1e-12)
    assert pairs[0, 1] == pytest.approx(1.0 / 6.0, abs=1e-12)
    for pair, expected in pairs.items():
        sigma = np.sqrt(expected * (1.0 - expected) / count)
        assert drawn.count(pair) / count == pytest.approx(expected, abs=4.0 * sigma), pair


# Without an effect


def test_an_effect_that_is_left_out_takes_only_its_own_columns_and_elements(learned):
    known = learned.analysis, learned.ensemble, learned.bank
    analysis, ensemble, bank, rows = reduced(*known, ["beam_width"])
    assert [candidate.name for candidate in analysis.candidates] == ["noise_level", "beam_ellipticity"]
    assert analysis.without == ("beam_width",)
    names = [element.name for element in ensemble.elements]
    assert names == [element.name for element in analysis.elements]
    assert sorted({e.name for e in learned.ensemble.elements} - set(names)) == [
        "score/beam_width (A)/0",
        "score/beam_width (B)/0",
    ]
    before = {candidate.label: candidate for candidate in learned.analysis.candidates}
    for candidate in analysis.candidates:
        full = learned.bank.matrix[np.ix_(rows, before[candidate.label].columns)]
        np.testing.assert_array_equal(bank.matrix[:, candidate.columns], full)
    np.testing.assert_array_equal(reduced(*known, [])[2].matrix, learned.bank.matrix)


# Figures


def test_pulls_are_those_of_constrained_components():
    assert pulls([1.0, 0.0, 3.0], (0.5, 2.0, 4.0), [0.5, 0.0, 2.0]) == (1.0, -0.5)


def record(kind="one", verdict="effect", there=(("beam_width", "A"),), said=((("beam_width", "A"),),), **changes):
    values = {"strength": 9.0, "columns": 1, "weakest": 9.0, "rival": 0.2, "distances": ()}
    values |= {"p_value": 0.001, "maximum": 0.001}
    answers = tuple(frozenset(one) for one in said)
    values |= {"case": "case", "kind": kind, "truth": frozenset(there), "verdict": verdict, "answers": answers}
    return Record(**(values | changes))


def test_what_counts_as_right():
    other = ((("noise_level", "A"),),)
    records = [
        record(bayes=frozenset([("beam_width", "A")])),
        record(said=((("beam_width", "B"),),), bayes=frozenset([("beam_width", "A")])),
        record("none", "none", (), (), bayes=frozenset(), p_value=0.4),
        record("left_out", "unknown", said=(), distances=(12.0, 11.0, 10.0)),
        record("left_out", "effect", said=other, distances=(12.0, 11.0, 10.0)),
        record("one", "degenerate", said=(*other, (("beam_width", "A"),)), rival=0.95),
    ]
    assert [one.right for one in records] == [True, False, True, True, False, False]
    assert [one.wrong_name for one in records] == [False, True, False, False, True, False]
    pair = {"there": (("beam_width", "A"), ("gain_drift", "B")), "said": ((("beam_width", "A"), ("gain_drift", "B")),)}
    part = {**pair, "said": ((("beam_width", "A"),),)}
    pairs = [record("two", **pair), record("two", **part), record("two", **part, weakest=4.0)]
    pairs += [record("two", **part, rival=0.8)]
    figures = {figure.name: figure for figure in Score("toy", [*records, *pairs]).metrics}
    assert figures["both of two effects, S/N >= 5 each, |rho| <= 0.7"].value == 0.5
    figures = {figure.name: figure for figure in Score("toy", records).metrics}
    assert figures["right effect, S/N >= 5, |rho| <= 0.7"].value == 0.5
    assert figures["right effect, S/N >= 5, |rho| <= 0.7, Bayes"].value == 1.0
    assert figures["truth in the set, S/N >= 5, |rho| > 0.9"].value == 1.0
    assert figures["unknown, S/N >= 8 beyond every triple"].value == 0.5
    assert figures["right answers, Bayes less diagnosis"].value == pytest.approx(1 / 3)
    matrix = confusion(records)
    assert matrix.counts.sum() == len(records)
    row = matrix.truths.index("beam_width")
    assert matrix.counts[row, matrix.answers.index("beam_width, other channel")] == 1
    assert matrix.counts[row, matrix.answers.index("set with the truth")] == 1


def test_every_effect_has_a_signature():
    assert set(SIGNATURES) == set(systematics.catalogue())
    assert any_place_right(["beam_ellipticity"], [("galactic", 2, "even"), ("ecliptic", 2, "even")])
    assert not any_place_right(["beam_ellipticity"], [("ecliptic", 1, "even"), (None, 0, "even")])
    assert any_place_right(["invented"], []) is None


def test_an_effect_is_named_only_with_its_settings():
    kind = systematics.get("beam_sidelobe")
    ours = Candidate(kind, "W1", (0,), {"calibrated": "dipole"})
    for settings, channel, named in (("dipole", "W1", True), ("none", "W1", False), ("dipole", "V1", False)):
        effect = {"name": kind.name, "channel": channel, "parameters": {"calibrated": settings, "angle_deg": 3.0}}
        assert _is_named([effect], ours) == named
    assert not _is_named([], ours)
