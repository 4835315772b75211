"""The search of a grammar: what is found in scores, how significant it is, and what chance finds."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from mcsim.diagnosis import unlisted
from mcsim.reconstruction.grammar import LOWEST
from mcsim.reconstruction.plugin import CONSTANT
from mcsim.reconstruction.search import ALTERNATIVES, LEVEL, MOST, RARE, Response, Search, evidence
from mcsim.reconstruction.simulated_effects import Reconstruction
from mcsim.reconstruction.structure import ALIKE, ANY, OFFSET, OPPOSITE, Structure


def plain(stage, rows):
    places = np.array(rows)[:, None]
    return Structure(stage, "", "", "any", "W1", ALIKE, None, places, np.ones(1), None, (0,))


def toy(count, seed=0):
    """A grammar of overlapping structures of Gaussian scores of 12 unequal, correlated elements, and draws of them."""
    mix = np.random.default_rng(5).normal(size=(12, 12)) + 3.0 * np.eye(12)
    chosen = tuple(plain(str(k), rows) for k, rows in enumerate([*([k] for k in range(12)), range(4), range(4, 12)]))
    return chosen, np.random.default_rng(seed).normal(size=(count, 12)) @ mix.T, mix


def test_a_pulse_is_told_from_its_mean():
    """What a function of time is beyond its constant is judged by its own size, however large the constant is."""
    simulations = np.random.default_rng(1).normal(size=(400, 9))
    keys = {"kind": f"spin {ANY}", "frame": "time"}
    whole, mean = plain("added", range(9)), plain("added", [0])
    search = Search((replace(whole, **keys), replace(mean, kind="monopole", frame="sky")), simulations)
    x = np.zeros(9)
    x[0], x[3] = 12.0, 6.0
    assert search.constants == {0: 1}
    long, short = search.evidences(x)
    assert long - short > 3.0
    x[3] = 1.0
    long, short = search.evidences(x)
    assert short > long


@pytest.mark.parametrize(
    ("stage", "mean", "more"), [("noise", "level", "degrees 0-2"), ("gain", "constant", "degrees 0-2")]
)
def test_a_pattern_is_told_from_its_mean(stage, mean, more):
    """What chance adds to a large mean from place to place is no pattern."""
    simulations = np.random.default_rng(1).normal(size=(400, 9))
    whole, level = plain(stage, range(9)), plain(stage, [0])
    search = Search((replace(whole, kind=more), replace(level, kind=mean)), simulations)
    x = np.full(9, 1.0)
    x[0] = 60.0
    long, short = search.evidences(x)
    assert search.constants == {0: 1}
    assert short > long


@pytest.mark.parametrize("acts_on", ["sky and dipole", "sky"])
def test_a_square_is_told_from_its_constant(acts_on):
    """A response that bends about another zero than that of the maps adds a monopole, too, and is a square."""
    simulations = np.random.default_rng(1).normal(size=(400, 9))
    bent = replace(plain("square", [0, 1]), kind=OFFSET, acts_on=acts_on)
    square, mean = replace(plain("square", [1]), kind="square", acts_on=acts_on), plain("added", [0])
    search = Search((bent, square, replace(mean, kind="monopole", frame="sky")), simulations)
    assert search.constants == {0: 2}
    assert bent.like(square)
    x = np.zeros(9)
    x[:2] = 8.0, 8.0
    assert np.argmax(search.evidences(x)) == 0
    x[0] = 0.0
    assert np.argmax(search.evidences(x)) == 1
    x[:2] = 8.0, 0.0
    assert np.argmax(search.evidences(x)) == 2


def test_what_is_beside_a_mean_is_not_charged_for_a_covariance_that_nobody_estimated():
    """A simulated response is known: falls beside a large mean are those of chi^2, not 1 + T/N times as large."""
    simulations = np.random.default_rng(1).normal(size=(400, 9))
    whole, mean = plain("added", range(9)), plain("added", [0])
    chosen = replace(whole, kind=f"spin {ANY}", frame="time"), replace(mean, kind="monopole", frame="sky")
    search, x = Search(chosen, simulations), simulations.mean(axis=0)
    x[[0, 3]] += 20.0, 6.0
    known = [Response(np.eye(9), np.eye(9)), Response(np.eye(1), np.eye(9)[:1])]
    for responses, inflated in ((known, 1.0), ([search.response(k, x) for k in (0, 1)], 2.0)):
        (long, short), falls, _ = search.judged([0, 1], x, responses)
        assert falls[1] == pytest.approx(400.0, rel=5.0 * np.sqrt(2.0 / 400))
        beside = (falls[0] - falls[1]) / (1.0 + (inflated - 1.0) * falls[1] / 400.0)
        assert long - short == pytest.approx(evidence(beside, 8) - np.log(RARE))


def test_a_finalist_stands_beside_its_constant():
    """A function of time far behind the best is judged in two parts like all others, and beside those of one part."""
    simulations = np.random.default_rng(1).normal(size=(400, 20))
    best, *others = (plain("added", [10 + k]) for k in range(10))
    wave = replace(plain("gain", range(9)), kind=f"spin {ANY}", frame="time")
    once = replace(plain("gain", [3]), kind="spin 1", frame="time")
    means = [replace(plain("gain", [0]), kind="constant"), plain("gain", [9])]
    search = Search((best, *others, wave, once, *means), simulations)
    assert search.constants == {10: 12}
    values = np.array([30.0, *np.zeros(9), 20.0, 21.0, 18.0, 19.0])
    assert search.finalists(values) == [0, 11, 10, 13, 12]


def test_a_pattern_has_finer_power_where_splits_see_it_alike():
    simulations = np.random.default_rng(1).normal(size=(400, 12))
    light = {"channel": None, "index": -3.0, "frame": "sky"}
    alike = replace(plain("added", range(9)), kind="degrees 0-2", **light)
    power = replace(plain("added", range(9, 12)), kind="power", **light)
    search = Search((alike, replace(alike, split="half2"), power), simulations)
    assert search.finer == {0: 2}


def test_nothing_is_found_in_data_of_the_model():
    chosen, simulations, mix = toy(400)
    search = Search(chosen, simulations)
    data = np.random.default_rng(9).normal(size=(600, 12)) @ mix.T
    found = sum(bool(search.run(one)) for one in data)
    # The threshold is known from 400 simulations: its own scatter is that of about LEVEL 400 of them.
    assert found <= 600 * LEVEL + 4.0 * np.sqrt(600 * LEVEL * (1.0 + 600 / 400))
    values = [
        max(float(evidence(np.array(f), w.size)) for f, w in zip(search._falls(one), chosen, strict=True))
        for one in data
    ]
    p = np.array([search.pvalue(value) for value in values])
    assert stats.kstest(p, "uniform").statistic < 4.0 * np.sqrt(1 / 600 + 1 / 400) * 0.5


def test_what_is_there_is_found_with_its_size():
    chosen, simulations, mix = toy(400)
    search = Search(chosen, simulations)
    covariance = mix @ mix.T
    theta = np.zeros(12)
    theta[2] = 10.0 / np.sqrt(covariance[2, 2])
    x = covariance @ theta + simulations.mean(axis=0)
    (found,) = search.run(x)
    assert found.structure == 2
    assert found.pvalue < 1e-9
    assert abs(found.delta_chi2 - 100.0) < 5.0 * 100.0 * np.sqrt(2.0 / 400)
    ((fitted, sigma),) = search.fit([chosen[2]], x)
    assert abs(fitted[0] - theta[2]) < 5.0 * theta[2] * np.sqrt(2.0 / 400)
    assert abs(sigma[0, 0] * covariance[2, 2] - 1.0) < 5.0 * np.sqrt(2.0 / 400)
    response = (x - simulations.mean(axis=0)) / 2.0
    assert np.allclose(search.amplitudes([chosen[2]], x, response[None]), [2.0])


def test_structures_are_judged_by_what_they_make_on_this_sky():
    """The response is the information; one below the scatter counts where other skies may be brighter."""
    chosen, simulations, mix = toy(400)
    place = np.array([[0]])
    gain = Structure("gain", "sky and dipole", "", "constant", "W1", ALIKE, None, place, np.ones(1), None, (0,))
    search = Search((chosen[0], gain), simulations)
    x = 5.0 * (mix @ mix.T)[0] + simulations.mean(axis=0)
    (expected,) = search._falls(x)[:1]
    for factor, falls in ((2.0, (0.5, 0.5)), (0.5, (1.0 + 4.0 * np.sqrt(2.0 / 400), 2.0))):
        responses = [one._replace(made=factor * one.made) for one in (search.response(k, x) for k in (0, 1))]
        _, found, amplitudes = search.judged([0, 1], x, responses)
        np.testing.assert_allclose(np.concatenate(amplitudes), 1.0 / factor, rtol=0.02)
        np.testing.assert_allclose(found, expected * np.array(falls), rtol=0.02)
        _, (nothing, _), (none, _) = search.judged(
            [0, 1], x, [responses[0]._replace(made=-responses[0].made), responses[1]]
        )
        assert (nothing, *none) == (0.0, 0.0)  # a response that is against the scores measures nothing
        _, average, _ = replace(search, exact=False).judged([0, 1], x, responses)
        np.testing.assert_allclose(average, expected, rtol=0.02)


@dataclass
class OnSky:
    """What structures do on a sky: other than on average."""

    search: Search
    factors: dict[int, float]  #: of what the first makes of scores, by their places
    rest: np.ndarray

    def response(self, member, rest):
        """Return a response with other factors."""
        found = self.search.response(member, rest)
        made = found.made.copy()
        for place, factor in self.factors.items():
            made[:, place] = factor * found.made[:, 0]
        return found._replace(made=made)

    def keep(self, member, amplitudes):
        """Take what a structure makes from the scores."""
        self.rest = self.rest - amplitudes @ self.response(member, self.rest).made

    def left(self, chosen):
        """Return the scores that are left."""
        return self.rest


def strong_gain():
    """Return a search for two gains, and scores of the first at a signal-to-noise ratio of 10."""
    chosen, simulations, mix = toy(400)
    gain = replace(chosen[0], stage="gain", acts_on="sky and dipole", kind="constant")
    search = Search((gain, chosen[5]), simulations)
    covariance = mix @ mix.T
    return search, 10.0 * covariance[0] / np.sqrt(covariance[0, 0]) + simulations.mean(axis=0)


def test_what_this_sky_tells_against_is_not_there():
    """However significant it is on average over skies: its error would be infinite."""
    search, x = strong_gain()
    search = replace(search, grammar=search.grammar[:1])
    assert search.run(x, OnSky(search, {}, x))[0].structure == 0
    assert search.run(x, OnSky(search, {0: -1.0}, x)) == []


@pytest.mark.parametrize(("made", "found"), [(1.0, [0, 1]), (30.0, [])])
def test_a_structure_that_leaves_more_than_there_was_is_none(made, found):
    """What it makes on this sky of scores that are not its own, the data have not."""
    search, x = strong_gain()
    assert [one.structure for one in search.run(x, OnSky(search, {5: made}, x))] == found


def test_monopoles_and_dipoles_that_a_modulation_makes_count():
    """Scores of a pattern that multiplies the sky leave them out."""
    _, simulations, _ = toy(400)
    low = Structure("added", "", "sky", LOWEST, "W1", ALIKE, None, np.array([[8], [9]]), np.ones(1), None, (0,))
    places = np.array([[0], [1], [2]])
    modulation = Structure("modulation", "sky", "sky", "degree 1", None, ALIKE, None, places, np.ones(1))
    search = Search((low, modulation), simulations)
    mean, covariance = simulations.mean(axis=0), np.cov(simulations.T)
    made = np.zeros((3, 12))
    made[:, :3] = 1e-3 * covariance[:3, :3]
    made[0, 8:10] = 30.0 * np.sqrt(np.diag(covariance)[8:10])
    x = mean + made[0]
    own, own_amplitudes = search.judged([1], x, [Response(1e-3 * np.eye(3), 1e-3 * made)])[1:]
    fall = made[0, 8:10] @ np.linalg.solve(covariance[8:10, 8:10], made[0, 8:10])
    assert own[0] == pytest.approx(fall, rel=0.05)
    assert own_amplitudes[0][0] == pytest.approx(1e3, rel=0.05)
    (amplitude,) = search.amplitudes([modulation], x, made[:1])
    assert amplitude == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(("stage", "kind", "unit"), [("noise", "level", 1.0 / CONSTANT), ("power", "power", 1.0)])
def test_large_variances_are_judged_by_their_likelihood(stage, kind, unit):
    """Of n numbers with 1 + a times their variance 2 ln L rises by n (a - ln(1 + a)), not by n a^2/2 as by a score."""
    n, a = 500, 10.0
    numbers = np.random.default_rng(2).normal(size=(400, n))
    simulations = unit * 0.5 * np.sum(numbers**2, axis=1)[:, None]
    place = np.array([[0]])
    search = Search((Structure(stage, "", "", kind, "W1", ALIKE, None, place, np.ones(1), None, (0,)),), simulations)
    (fall,) = search._falls((1.0 + a) * simulations.mean(axis=0))
    assert fall == pytest.approx(n * (a - np.log1p(a)), rel=4.0 * np.sqrt(2.0 / 400))
    assert fall < 0.4 * n * a**2 / 2.0
    (fall,) = search._falls(simulations.mean(axis=0) + 3.0 * simulations.std(axis=0))
    assert fall == pytest.approx(9.0, rel=0.2)


@pytest.mark.parametrize("more", [1.0, 3.0])
def test_noise_of_one_split_is_judged_alike_in_whichever_it_is(more):
    """More noise of the second split has a negative coordinate where splits are opposite: no less of it."""
    scores_ = np.random.default_rng(2).normal(size=(400, 1))
    place = np.array([[0]])
    search = Search(
        (Structure("noise", "", "", "level", "W1", OPPOSITE, None, place, np.ones(1), None, (0,)),), scores_
    )
    mean, size = scores_.mean(axis=0), more / CONSTANT
    first, second = (search._falls(mean + sign * size * scores_.var(axis=0)) for sign in (1.0, -1.0))
    assert second == pytest.approx(first)
    assert first < search.nulls[0].hartlap_factor * search.nulls[0].chi2(mean + size * scores_.var(axis=0))


@pytest.mark.parametrize(("stage", "first", "count"), [("noise", 60.0, 1), ("other", 12.0, 2)])
def test_what_is_beside_more_noise_is_not_looked_for(stage, first, count):
    """Scores scatter more in noise that the simulations do not have."""
    simulations = np.random.default_rng(1).normal(size=(400, 2))
    level = replace(plain(stage, [0]), kind="level")
    found = Search((level, plain("added", [1])), simulations).run(np.array([first, 11.0]))
    assert [one.structure for one in found] == [0, 1][:count]


@pytest.mark.parametrize(("second", "count"), [(7.0, 1), (12.0, 2)])
def test_what_falls_by_less_than_a_tenth_of_the_first_is_no_second(second, count):
    """It may be the square of the first: 49 beside 900, which chance does not make, and 144 is one."""
    simulations = np.random.default_rng(1).normal(size=(400, 2))
    search = Search((plain("one", [0]), plain("other", [1])), simulations)
    assert [one.structure for one in search.run(np.array([30.0, second]))] == [0, 1][:count]
    assert [one.structure for one in search.run(np.array([0.0, second]))] == [1]


def test_power_of_one_channel_is_judged_by_that_of_the_sum_of_its_splits():
    """Their products are below zero on average, where the sky is taken out of their sum: more power is more of it."""
    n, a, left = 500, 10.0, 0.3

    def scores(half_sum, half_difference):
        squares = [np.sum(one**2, axis=-1) for one in (half_sum, half_difference)]
        return np.stack([4.0 * squares[1], squares[0] - squares[1]], axis=-1)

    draws = np.random.default_rng(3).normal(size=(401, 2, n)) * np.array([left, 1.0])[:, None]
    noise = Structure("noise", "", "", "spectrum", "W1", ALIKE, None, np.array([[0]]), np.ones(1))
    power = Structure("added", "", "sky", "power", "W1", ALIKE, None, np.array([[1]]), np.ones(1))
    search = Search((noise, power), scores(draws[:400, 0], draws[:400, 1]))
    assert search.simulations[:, 1].mean() < 0.0
    mean = search.simulations.mean(axis=0)
    more = n * left**2 * a
    fall = search._falls(mean + np.array([0.0, more]))[1]
    promised = more**2 / (2.0 * n * (left**4 + 1.0))  # by the score, whose variance is that of both squares
    share = 2.0 * (a - np.log1p(a)) / a**2
    assert fall == pytest.approx(promised * share, rel=5.0 * np.sqrt(2.0 / 400))
    assert search._falls(mean - np.array([0.0, 0.5 * n * left**2]))[1] == 0.0  # nothing that is added takes power away


def test_a_choice_among_many_is_charged():
    """Odds of one among n are shared by all, and what others had been chosen in simulations counts in p-values."""
    chosen, simulations, _ = toy(400)
    among = tuple(replace(one, tried=1e4) for one in chosen)
    x = 20.0 * simulations[0]
    plain_, charged = (Search(one, simulations).evidences(x) for one in (chosen, among))
    np.testing.assert_allclose(plain_ - charged, np.log(1e4))
    search = Search(chosen, simulations)
    wider = replace(search, peaks=np.full((400, 1), search.largest.max() + 1.0))
    assert search.pvalue(float(search.largest.max()) + 0.5) < 1.0 / 400
    assert wider.pvalue(float(search.largest.max()) + 0.5) == 1.0


def test_of_many_that_the_data_choose_among_the_best_is_compared():
    chosen, simulations, _ = toy(400)
    among = tuple(replace(one, stage="any", tried=12.0) for one in chosen[:12])
    search = Search((*among, *chosen[12:]), simulations)
    values = np.arange(1.0, 15.0)
    assert search.finalists(values)[:2] == [13, 12]
    assert [k for k in search.finalists(values) if k < 12] == [11]


def test_evidence_falls_with_the_number_of_coordinates():
    falls = np.array([80.0, 80.0, 80.0])
    each = [float(evidence(falls[k : k + 1], size)[0]) for k, size in enumerate((1, 4, 30))]
    assert each == sorted(each, reverse=True)
    assert evidence(np.array([3.0]), 4)[0] == 0.0
    assert MOST >= 1
    assert ALTERNATIVES > 1.0


def test_a_structure_is_fitted_to_all_maps_of_the_first_fold(monkeypatch):
    """Of three splits the first and the third: the second one judges."""
    fitted, split = [], [SimpleNamespace(split=number) for number in range(3)]
    found = Structure(
        "added", "", "sky", "monopole", "W1", ALIKE, None, np.arange(3)[None], np.ones(3), None, (0, 1, 2)
    )
    monkeypatch.setattr(unlisted, "plugin", lambda *_: None)
    monkeypatch.setattr(Reconstruction, "simulated", lambda *_, **__: SimpleNamespace(x=np.zeros(1)))
    monkeypatch.setattr(Reconstruction, "before", SimpleNamespace(x=np.zeros(1)))
    search = SimpleNamespace(fit=lambda chosen, x: fitted.extend(chosen) or [(np.ones(1), np.eye(1))], grammar=(found,))
    data = SimpleNamespace(in_halves=lambda change: None)
    scene = SimpleNamespace(views=split, splits=("a", "b", "c"))
    made = Reconstruction(None, scene, search, np.zeros(3), None)
    made._fitted[0,] = [], [SimpleNamespace(name="unlisted_1")], np.zeros(3)
    assert unlisted.reduction_of(data, made, [0]) is None
    assert [one.views for one in fitted] == [(0, 2)]
