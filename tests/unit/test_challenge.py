"""Challenges on toys: seals, draws, the best classifier, and what the score makes of records."""

import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, stats

from mcsim import config, systematics
from mcsim.benchmark import intervals, toml
from mcsim.benchmark.draws import Draw, bench, draws, judged, powers, sampler_of
from mcsim.benchmark.expected import SIGNATURES, places_right
from mcsim.benchmark.figures import confusion, scored
from mcsim.benchmark.prior import Drawn, Prior
from mcsim.benchmark.record import Geometry, Record
from mcsim.benchmark.reduced import without
from mcsim.benchmark.report import lines, write
from mcsim.benchmark.truth import MAPS, SEAL, Member, Truth, finished_cases, key_path, open_key, sealed, write_whole
from mcsim.diagnosis.analysis import Analysis, Proposal
from mcsim.diagnosis.inference import context
from mcsim.diagnosis.knowledge import Knowledge
from mcsim.diagnosis.summaries import Block, Element
from mcsim.errors import InputError

ENTRIES = 24


def toy(names, simulations=800, seed=1, common=0.0):
    """A court of effects with random templates, alike in both folds, and unit noise; ``common``: their cosine."""
    rng = np.random.default_rng(seed)
    proposals = []
    for name, channel in names:
        kind = systematics.get(name)
        proposals.append(Proposal(kind, channel, {}, kind.basis()))
    columns = sum(len(proposal.basis) for proposal in proposals)
    directions = np.linalg.qr(rng.standard_normal((ENTRIES // 2, columns)))[0]
    directions = np.sqrt(1.0 - common) * directions + np.sqrt(common) * directions[:, :1]
    templates = np.repeat(directions, 2, axis=0)
    elements = [Element(f"entry{i}", "map", ("A",), None, i % 2) for i in range(ENTRIES)]
    blocks = [Block(tuple(elements), lambda model, filtered: np.zeros(ENTRIES))]
    rows = [templates]
    for number, proposal in enumerate(proposals):
        score = Element(f"score/{proposal.label}/0", "score", ("A",))
        blocks.append(Block((score,), lambda model, filtered: np.zeros(1)))
        row = np.zeros((1, columns))
        row[0, number] = 0.5
        rows.append(row)
    t = np.concatenate(rows)
    p = len(t)
    known = Knowledge(
        rng.standard_normal((simulations, p)),
        np.zeros(p),
        t,
        np.zeros_like(t),
        np.zeros_like(t),
        np.zeros((24, p)),
        np.zeros((0, 0)),
        tuple(element for block in blocks for element in block.elements),
    )
    return context(None, Analysis(SimpleNamespace(lmax=128), tuple(proposals), tuple(blocks)), known)


NAMES = (("beam_width", "A"), ("noise_level", "A"), ("beam_ellipticity", "A"), ("beam_width", "B"), ("spectrum", None))


@pytest.fixture(scope="module")
def learned_model():
    return toy(NAMES[:4])


def member(name="beam_width", channel="A", **changes):
    values = {"parameters": {"amplitude": 0.01}, "coordinates": (0.01,), "strength": 6.0, "candidate": 0}
    return Member(name, channel, **(values | changes))


def truth(case="case-000", **changes):
    values = {"kind": "one", "members": (member(),), "without": (), "seed": 5, "sampled": True, "nonce": "ab" * 32}
    return Truth(case, **(values | changes))


# Seals


def test_a_key_that_was_changed_is_found(tmp_path):
    key = key_path(tmp_path, "case-000")
    write_whole(key, truth().text())
    case = tmp_path / MAPS / "case-000"
    case.mkdir(parents=True)
    (case / SEAL).write_text(f"{sealed(key)}  keys/case-000.json\n")
    assert finished_cases(tmp_path) == ["case-000"]
    assert open_key(tmp_path, "case-000") == truth()
    write_whole(key, truth(kind="none", members=()).text())
    with pytest.raises(InputError, match="is not the key that was sealed"):
        open_key(tmp_path, "case-000")
    key.write_text("{}")
    with pytest.raises(InputError, match="cannot be read as a key"):
        open_key(tmp_path, "case-000")


def test_no_challenge_is_said_so(tmp_path):
    with pytest.raises(InputError, match="holds no challenge"):
        finished_cases(tmp_path / "nothing")


def test_toml_loads_as_the_same_run():
    run = config.load("quickstart")
    run = replace(
        run, effects=(config.Effect(name="beam_width", channel=run.channels[0].name, parameters={"amplitude": 0.01}),)
    )
    assert config.load(tomllib.loads(toml.text(config.to_dict(run)))) == run


# Draws


def test_cases_do_not_depend_on_how_many_there_are(learned_model):
    sampler = sampler_of(bench(learned_model), Prior())
    few, many = sampler.kinds(3, 20, False), sampler.kinds(3, 400, False)
    assert many[:20] == few
    assert [sampler.draw(few, 3, case) for case in range(20)] == [sampler.draw(many, 3, case) for case in range(20)]
    assert "invented" not in many
    # 20, 45, 15 and 12 of 92; 4 sigma.
    for kind, part in (("none", 20), ("one", 45), ("two", 15), ("left_out", 12)):
        share = part / 92
        assert abs(many.count(kind) - 400 * share) < 4 * np.sqrt(400 * share * (1 - share))


def test_what_is_left_out_rotates(learned_model):
    sampler = sampler_of(bench(learned_model), Prior(none=0, one=0, two=0, left_out=1))
    kinds = sampler.kinds(1, 6, False)
    names = [sampler.draw(kinds, 1, case).without[0] for case in range(6)]
    assert sorted(names[:3]) == sorted(names[3:]) == sorted(set(sampler.names()))


def test_what_nature_has_too_little_of_is_not_drawn(learned_model, monkeypatch):
    sampler = sampler_of(bench(learned_model), Prior())
    name = sampler.names()[0]
    kind = next(one.kind for one in sampler.proposals if one.kind.name == name)
    strongest = max(
        sampler.white_length(sampler.templates[:, column])
        for proposal, columns in zip(sampler.proposals, sampler.columns, strict=True)
        for column in columns
        if proposal.kind is kind
    )
    monkeypatch.setattr(kind, "max_amplitude", 1.01 * sampler.prior.weakest / strongest)
    assert name in sampler.names()
    monkeypatch.setattr(kind, "max_amplitude", 0.99 * sampler.prior.weakest / strongest)
    assert name not in sampler.names()


def test_strengths_are_the_drawn_ones(learned_model):
    """White length of the response, by the covariance that the toy was made with; known to 5 % from 600 simulations."""
    sampler = sampler_of(bench(learned_model), Prior(none=0, one=1, two=0, left_out=0))
    kinds = sampler.kinds(1, 200, False)
    for case in range(200):
        (found,) = sampler.draw(kinds, 1, case).members
        assert 3.0 * (1 - 1e-6) < found.strength < 20.0 * (1 + 1e-6)
        columns = list(learned_model.candidates[found.candidate].columns)
        length = np.linalg.norm(learned_model.known.templates[:, columns] @ found.coordinates)
        assert length == pytest.approx(found.strength, rel=0.15)


def test_prior_refuses_what_is_none():
    with pytest.raises(InputError, match="are no range"):
        Prior(weakest=5.0, strongest=2.0)
    with pytest.raises(InputError, match="must not be negative"):
        Prior(one=-0.1)


def test_power_of_one_template_is_the_known_one():
    """One candidate of one column: the score test's power is a noncentral F's, no trials."""
    found = powers(toy(NAMES[:1], simulations=2400), 1500, 4)
    expected = np.interp(found.strengths, found.grid, found.finite)
    excess = np.sum(found.by_maximum) - expected.sum()
    # Data are 600 held-out simulations, each used two or three times: their noise is common to the draws.
    assert abs(excess) < 4.0 * np.sqrt(2.5 * np.sum(expected * (1.0 - expected)))
    assert found.limit[-1] > 0.99
    false = np.sum(found.null_maximum <= 0.05)
    low, high = stats.binom.ppf((1e-4, 1 - 1e-4), len(found.null_maximum), 0.05)
    assert low <= false <= high


def test_draws_are_judged(learned_model, tmp_path):
    records = draws(learned_model, 120, 2)
    assert [record.case for record in records] == [f"draw-{number:05d}" for number in range(120)]
    score = scored("toy", records, powers(learned_model, 300, 2))
    strong = [record for record in records if record.kind == "one" and record.strength > 6]
    # Nearly orthogonal templates, far above the threshold: only the 5 % of true sets that are refused go wrong.
    wrong = sum(not record.right for record in strong)
    assert wrong <= stats.binom.ppf(1 - 1e-4, len(strong), 0.06)
    assert sum(record.bayes != record.truth for record in strong) <= 2
    assert all(record.distances[0] >= record.distances[-1] for record in records if record.kind == "left_out")
    figures = {figure.name: figure for figure in score.figures}
    assert figures["gap removed, s >= 8"].value > 0.8
    assert abs(figures["gap removed by an effect that is not there"].value) < 0.1
    # Named or not, so that choosing what to name has no say: unit normals, of n an error of their mean of 1/sqrt(n).
    ones = [record for record in records if record.kind == "one"]
    fitted = np.array([pull for record in ones for pull in record.fitted])
    assert len(fitted) >= len(ones)
    assert abs(fitted.mean()) < 4.0 / np.sqrt(len(fitted))
    assert abs(fitted.std() - 1.0) < 4.0 / np.sqrt(2 * len(fitted))
    assert all(set(record.pulls) <= set(record.fitted) for record in records)
    write([score], tmp_path / "score")
    page = (tmp_path / "score" / "report.html").read_text()
    assert "data:image/png;base64" in page
    assert "http" not in page
    assert any("false alarms" in line for line in lines(score))


def test_an_invention_is_called_unknown(learned_model):
    """A response at right angles to every template, at ten sigmas, in 40 skies: no name, but where noise adds one."""
    here = bench(learned_model)
    rng = np.random.default_rng(8)
    left = here.null.whiten_templates(here.templates)
    basis = np.linalg.qr(left)[0]
    found = []
    for case in range(40):
        direction = rng.standard_normal(here.null.dimension)
        direction -= basis @ (basis.T @ direction)
        response = np.linalg.lstsq(here.null.whiten_templates(np.eye(len(here.templates))), direction, rcond=None)[0]
        length = np.sqrt(here.null.unbiased) * np.linalg.norm(here.null.whiten_templates(response[:, None]))
        invented = member("invented", candidate=None, response=tuple(10.0 / length * response))
        found.append(Draw(case, Drawn("invented", (invented,), ()), 10.0 / length * response))
    records = judged(here, Prior(), 0, found)
    assert all(record.distances[-1] > 9.9 for record in records)
    assert all(record.bayes is None for record in records)
    assert sum(record.verdict == "unknown" for record in records) >= 38
    assert sum(record.wrong_name for record in records) <= 1


# The best classifier


def test_pairs_have_the_evidence_of_brute_force():
    """Likelihood times prior of two amplitudes on a grid, against importance sampling; many simulations: Gaussian."""
    prior = Prior(none=0.2, one=0.5, two=0.3, left_out=0, invented=0, weakest=2.0, strongest=10.0)
    here = bench(toy(NAMES[:2], simulations=20_000, common=0.3))
    sampler = sampler_of(here, prior)
    geometry = Geometry.of(here.null, here.templates, here.candidates, here.calibration)
    bayes = geometry.bayes(sampler)
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
        x = here.null.mean + np.linalg.lstsq(here.null.whitening, y * np.sqrt(1 + 1 / here.null.count), rcond=None)[0]
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


# Without an effect


def test_an_effect_leaves_its_columns_and_entries_only(learned_model):
    fewer = without(learned_model.analysis, learned_model.known, ["beam_width"])
    assert [proposal.kind.name for proposal in fewer.analysis.proposals] == ["noise_level", "beam_ellipticity"]
    assert fewer.analysis.without == ("beam_width",)
    names = [element.name for element in fewer.known.elements]
    assert names == [element.name for element in fewer.analysis.elements]
    assert sorted({e.name for e in learned_model.known.elements} - set(names)) == [
        "score/beam_width (A)/0",
        "score/beam_width (B)/0",
    ]
    for proposal, columns in zip(fewer.analysis.proposals, fewer.analysis.columns, strict=True):
        index = learned_model.analysis.proposals.index(proposal)
        full = learned_model.known.templates[np.ix_(fewer.rows, learned_model.analysis.columns[index])]
        np.testing.assert_array_equal(fewer.known.templates[:, columns], full)
    same = without(learned_model.analysis, learned_model.known, [])
    assert same.known.templates.shape == learned_model.known.templates.shape


# Figures


def test_intervals_cover_what_they_say():
    low, high = intervals.binomial(0, 10)
    assert (low, high) == (0.0, pytest.approx(1 - 0.025**0.1))
    low, high = intervals.binomial(7, 7)
    assert (low, high) == (pytest.approx(0.025 ** (1 / 7)), 1.0)
    assert intervals.share("x", []).met is None
    assert intervals.share("x", [True] * 19 + [False], least=0.95).met is True
    gone = intervals.removed("x", [(10.0, 1.0), (20.0, 2.0), (1e-9, 3.0)], "")
    assert gone.value == pytest.approx(0.8)
    rng = np.random.default_rng(0)
    x = rng.uniform(20, 100, 400)
    delta_chi2 = [0.9 * x, x] + 15 * rng.standard_normal((2, 400))
    # The sums' errors, 15 sqrt(400) of some 24,000 each, are 1.8 % together.
    found = intervals.slope("x", delta_chi2[1], delta_chi2[0], "", 0.8, 1.0)
    assert found.value == pytest.approx(0.9, abs=4 * 0.018 * 0.9)
    assert found.low < found.value < found.high
    assert found.met is True
    s = rng.uniform(1, 8, 3000)
    hits = rng.random(3000) < stats.norm.cdf(s - 3.0)
    value, low, high = intervals.strength_at(s, hits)
    assert low < 3.0 + stats.norm.ppf(0.9) < high
    assert value == pytest.approx(4.28, abs=0.2)


def record(kind="one", verdict="effect", there=(("beam_width", "A"),), said=((("beam_width", "A"),),), **changes):
    values = {"strength": 9.0, "columns": 1, "rival": 0.2, "distances": (), "p_value": 0.001, "maximum": 0.001}
    answers = tuple(frozenset(one) for one in said)
    return Record("case", kind, frozenset(there), verdict=verdict, answers=answers, **(values | changes))


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
    figures = {figure.name: figure for figure in scored("toy", records).figures}
    assert figures["right effect, s >= 5, |rho| <= 0.7"].value == 0.5
    assert figures["truth in the set, s >= 5, |rho| > 0.9"].value == 1.0
    assert figures["unknown flagged, distance from every triple >= 8"].value == 0.5
    assert figures["points behind Bayes"].value == pytest.approx(1 / 3)
    matrix = confusion(records)
    assert matrix.counts.sum() == len(records)
    row = matrix.truths.index("beam_width")
    assert matrix.counts[row, matrix.answers.index("beam_width, other channel")] == 1
    assert matrix.counts[row, matrix.answers.index("set with the truth")] == 1


def test_every_effect_has_a_signature():
    assert set(SIGNATURES) == set(systematics.catalogue())
    assert places_right(["beam_ellipticity"], [("galactic", 2, "even"), ("ecliptic", 2, "even")])
    assert not places_right(["beam_ellipticity"], [("ecliptic", 1, "even"), (None, 0, "even")])
    assert places_right(["invented"], []) is None
