"""Errors and further effects where effects act, in Gaussian evidence whose scatter is known."""

from dataclasses import replace

import numpy as np
import pytest

from mcsim.datavector.candidate import Candidate
from mcsim.diagnosis.subsets import Subsets
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate
from mcsim.stats.scattered import Acting, Beside, with_drawn_scatter, with_scatter, with_tangents
from mcsim.systematics import Effect

P, SKIES = 12, 4000


@pytest.mark.parametrize(
    ("growth", "share", "variance"), [(1.0, 1.0, 1.0), (0.5, 1.0, 0.25), (2.0, 1.0, 4.0), (0.5, 0.6, 0.55), (2, 0.6, 4)]
)
def test_errors_follow_the_scatter(growth: float, share: float, variance: float) -> None:
    """Where it shrinks, only the share of it that skies which the data constrain have does so."""
    rng = np.random.default_rng(3)
    mixing = rng.normal(size=(P, P))
    model = SimulatedGaussian.from_simulations(rng.normal(size=(2000, P)) @ mixing)
    t = rng.normal(size=(P, 2))
    found = model.fit(30.0 * t[:, 0], t)
    before = np.sqrt(share) * rng.normal(size=(SKIES, P)) @ mixing
    # The response itself, the same in every sky, is no scatter.
    wide = with_scatter(model, t, found, before, 30.0 * t[:, 0] + growth * before)
    np.testing.assert_allclose(wide.errors / found.errors, np.sqrt(variance), rtol=0.05)
    np.testing.assert_array_equal(wide.amplitudes, found.amplitudes)
    np.testing.assert_allclose(_correlation(wide.covariance), _correlation(found.covariance), rtol=1e-12)


def test_pulls_have_unit_width_where_few_skies_tell_the_scatter() -> None:
    """A response that differs from sky to sky: once in the data, and once more in the mean over eight skies."""
    rng, skies, spread = np.random.default_rng(5), 8, 2.0
    model, t = SimulatedGaussian(np.zeros(P), np.eye(P), 1_000_000), np.eye(P)[:, :1]
    found, pulls = model.fit(20.0 * t[:, 0], t), []
    for _ in range(2000):
        before, change = rng.normal(size=(skies, P)), spread * rng.normal(size=(skies, P))
        wide = with_scatter(model, t, found, before, before + 20.0 * t[:, 0] + change)
        pulls.append((rng.normal() + spread * rng.normal() - change[:, 0].mean()) / wide.errors[0])
    # The error of a width of 2000 Gaussian pulls is 0.016; these have the tails of a Student t.
    assert np.std(pulls) == pytest.approx(1.0, abs=0.06)


def test_few_skies_tell_exactly_how_much_more_noise_there_is() -> None:
    """Variances before and after, of eight skies, would have errors of a half."""
    rng, growth = np.random.default_rng(6), 1.4
    model, t = SimulatedGaussian(np.zeros(P), np.eye(P), 1_000_000), np.eye(P)[:, :1]
    found, before = model.fit(20.0 * t[:, 0], t), rng.normal(size=(8, P))
    wide = with_scatter(model, t, found, before, 20.0 * t[:, 0] + growth * before)
    # The response, too, is measured in eight skies.
    expected = np.sqrt(growth**2 + (growth - 1.0) ** 2 / 8.0)
    np.testing.assert_allclose(wide.errors / found.errors, expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("growth", "spread"), [(1.6, 0.0), (1.0, 2.0)], ids=["more noise in some elements", "a response that scatters"]
)
def test_further_effects_are_not_found_in_the_scatter_of_one(growth: float, spread: float) -> None:
    """Beside an effect that makes some elements noisier the p-values of all others stay those of no effect.

    Eight skies tell by how much.
    """
    rng, count, snr, draws, skies = np.random.default_rng(7), 30, 25.0, 200, 8
    null, t = SimulatedGaussian.from_simulations(rng.normal(size=(800, count))), np.eye(count)[:, 7:14]
    factor, wide = np.where(np.arange(count) < 10, growth, 1.0), np.where(np.arange(count) < 10, spread, 0.0)
    columns = [(k,) for k in range(7)]
    effects = [type(f"effect{k}", (Effect,), {"name": f"effect{k}", "unit": "", "step": 1.0}) for k in range(7)]
    quiet = [Candidate(effect, None, own) for effect, own in zip(effects, columns, strict=True)]
    groups = null.whiten_groups(t, columns)
    calibration, found = calibrate(null, groups), []

    def with_effect(rows: np.ndarray) -> np.ndarray:
        return factor * rows + snr * t[:, 6] + wide * rng.normal(size=rows.shape)

    for _ in range(draws):
        before = rng.normal(size=(skies, count))
        loud = [*quiet[:6], replace(quiet[6], acting=Acting.of(null, t, columns, 6, (before, with_effect(before))))]
        y = null.whiten(with_effect(rng.normal(size=(1, count)))[0])
        searches = (Subsets(null, y, groups, own, calibration) for own in (quiet, loud))
        found.append([one.beside(np.array([[6]])).min() <= 0.05 for one in searches])
    ignored, charged = np.mean(found, axis=0)
    assert abs(charged - 0.05) < 3.0 * np.sqrt(0.05 * 0.95 / draws)
    assert ignored > 0.15


def test_pulls_are_of_unit_width_where_responses_bend() -> None:
    """The response to a and b is (a - a^2/100) t + (1 - a/100) b u: at a = 20 a tangent of 0.6 beside a line of 0.8."""
    rng, a, b = np.random.default_rng(6), 20.0, 0.0
    model = SimulatedGaussian.from_simulations(rng.normal(size=(20_000, P)))
    t, u = np.eye(P)[:2]
    pulls = []
    for x in rng.normal(size=(1000, P)) + (a - 0.01 * a**2) * t + (1.0 - 0.01 * a) * b * u:
        first = 50.0 - np.sqrt(2500.0 - 100.0 * x[0])  # what a fit and simulations at its amplitude converge to
        second = x[1] / (1.0 - 0.01 * first)
        lines = np.stack([(1.0 - 0.01 * first) * t - 0.01 * second * u, u], axis=1)
        found = model.fit(x, lines)
        np.testing.assert_allclose(found.amplitudes, [first, second], atol=0.2)
        exact = np.stack([(1.0 - 0.02 * first) * t - 0.01 * second * u, (1.0 - 0.01 * first) * u])
        tangents = exact[:, None] + 0.1 * rng.normal(size=(2, 4, P))  # of four skies
        pulls.append(
            (found.amplitudes - [a, b]) / np.stack([found.errors, with_tangents(model, lines, found, tangents).errors])
        )
    straight, bent = np.std(pulls, axis=0)
    np.testing.assert_allclose(straight, [0.8 / 0.6, 1.0 / 0.8], rtol=0.1)
    np.testing.assert_allclose(bent, 1.0, atol=4.0 / np.sqrt(2000.0))
    steeper = with_tangents(model, lines, found, [2.0 * lines[:, :1].T, None])
    np.testing.assert_allclose(steeper.errors / found.errors, [0.5, 1.0])


def test_slopes_that_few_skies_do_not_tell_leave_the_errors_of_a_line() -> None:
    """A straight response whose slope four skies tell to 30 %: raw slopes would make errors wrong by that much."""
    rng, skies, noise = np.random.default_rng(7), 4, 0.6
    model, t = SimulatedGaussian(np.zeros(P), np.eye(P), 1_000_000), np.eye(P)[:, :1]
    found, raw, shrunk = model.fit(20.0 * t[:, 0], t), [], []
    for _ in range(2000):
        slopes = t.T + noise * rng.normal(size=(skies, P))
        raw.append(1.0 / slopes[:, 0].mean())
        shrunk.append(with_tangents(model, t, found, [slopes]).errors[0] / found.errors[0])
    wrong = [np.mean(np.log(np.abs(one)) ** 2) for one in (raw, shrunk)]
    assert wrong[1] < 0.6 * wrong[0]
    assert abs(np.median(shrunk) - 1.0) < 0.01


def test_the_scatter_along_the_response_of_an_effect_is_that_of_its_amplitude() -> None:
    """The response is t in the mean, and its size differs from sky to sky by twice the error of the amplitude."""
    rng, t = np.random.default_rng(12), np.eye(P)[:, :2]
    model = SimulatedGaussian(np.zeros(P), np.eye(P), 1_000_000)
    before, size = rng.normal(size=(SKIES, P)), 30.0 + 2.0 * rng.normal(size=SKIES)
    across = 5.0 * rng.normal(size=SKIES)
    after = before + np.outer(size, t[:, 0]) + np.outer(across, t[:, 1])
    found = Acting.of(model, np.eye(P)[:, :3], [(0, 1), (2,)], 0, (before, after))
    assert found.own == pytest.approx(4.0, rel=5.0 * np.sqrt(2.0 / SKIES))
    assert Acting.of(model, t, [(0, 1)], 0, (before, before + 30.0 * t[:, 0])).own == pytest.approx(0.0, abs=1e-12)


def test_candidates_that_are_added_are_not_scattered_by_what_was_simulated_before() -> None:
    acting = Acting(100.0, 3.0, 0.1, np.array([0.0, 2.0]), np.array([0.0, 0.5]))
    beside = Beside.of([acting, None, None], None)
    found = beside.tolerated(np.zeros(1), np.array([[0]]), np.array([[0.5]]), np.array([[1, 2]]))
    np.testing.assert_allclose(found.variance, [[2.0, 1.0]])
    np.testing.assert_allclose(found.dof, [[2.0 * 4.0 / (0.25 * 0.5), 2e12]])


def _correlation(covariance: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.diag(covariance))
    return covariance / np.outer(size, size)


def test_without_a_change_of_the_scatter_errors_stay() -> None:
    rng = np.random.default_rng(4)
    model, t = SimulatedGaussian.from_simulations(rng.normal(size=(500, P))), rng.normal(size=(P, 1))
    found, skies = model.fit(5.0 * t[:, 0], t), rng.normal(size=(8, P))
    np.testing.assert_allclose(with_scatter(model, t, found, skies, skies + t[:, 0]).covariance, found.covariance)


def test_the_error_of_a_growth_is_that_of_many_sets_of_skies() -> None:
    """Along eleven templates, which are independent: a response that grows with the data, and scatters besides."""
    rng, model, groups = np.random.default_rng(1), SimulatedGaussian(np.zeros(P), np.eye(P), 10**9), list(range(P))
    found = []
    for _ in range(300):
        before = rng.normal(size=(40, P))
        after = 1.5 * before + 0.3 * rng.normal(size=(40, P)) + 30.0 * np.eye(P)[0]
        acting = Acting.of(model, np.eye(P), [(k,) for k in groups], 0, (before, after))
        found.append([acting.excess[1:], acting.error[1:]])
    excess, error = np.moveaxis(found, 1, 0)
    # The variance of 3300 values has a relative error of sqrt(2/3300), and a little more for their tails: 4 sigma.
    assert np.mean(error) == pytest.approx(np.var(excess), rel=0.12)


def test_less_scatter_makes_nothing_beside_it_more_significant() -> None:
    acting = Acting(100.0, 3.0, 0.1, np.array([0.0, -0.6]), np.array([0.0, 0.01]))
    found = Beside.of([acting, None], None).tolerated(np.zeros(1), np.array([[0]]), np.array([[1.0]]), np.array([[1]]))
    np.testing.assert_array_equal(found.variance, [[1.0]])


def test_a_response_that_grows_along_another_template_moves_that_amplitude() -> None:
    """At the fit the first response is t_1 + t_2/2: theta_1 = y_1 and theta_2 = y_2 - y_1/2."""
    model, t = SimulatedGaussian(np.zeros(P), np.eye(P), 1_000_000), np.eye(P)[:, :2]
    found = model.fit(20.0 * t[:, 0], t)
    bent = with_tangents(model, t, found, [(t[:, 0] + 0.5 * t[:, 1])[None], None])
    np.testing.assert_allclose(bent.errors / found.errors, [1.0, np.sqrt(1.25)], rtol=1e-9)


@pytest.mark.parametrize("slope", [0.1, 1e-2, 1e-4, 0.0])
def test_errors_at_the_peak_of_a_response_are_those_of_a_parabola(slope: float) -> None:
    """They were 100 times those of the line, or those of the line, where the response is flat."""
    model, t, a = SimulatedGaussian(np.zeros(P), np.eye(P), 1_000_000), np.eye(P)[:, :2], 20.0
    found = model.fit(a * t[:, 0], t)
    bent = with_tangents(model, t, found, [slope * t[:, :1].T, None])
    (line, _), (d, other) = found.errors, bent.errors
    # Of R(b) = b (1 + (slope - 1) (b - a)/a), which is a at a, with this slope.
    low = a - d
    assert a - low * (1.0 + (slope - 1.0) * (low - a) / a) == pytest.approx(line, rel=1e-6)
    assert other == found.errors[1]


def test_no_parabola_makes_an_error_less_than_that_of_the_line() -> None:
    """An amplitude that is less than its error tells nothing of how the response bends."""
    model, t = SimulatedGaussian(np.zeros(P), np.eye(P), 1_000_000), np.eye(P)[:, :2]
    found = model.fit(0.1 * t[:, 0], t)
    bent = with_tangents(model, t, found, [0.0 * t[:, :1].T, None])
    np.testing.assert_allclose(bent.errors, found.errors, rtol=1e-6)


def test_noise_that_a_response_multiplies_counts_with_what_it_adds_to() -> None:
    """Along the template it is tripled: a variance of nine, one and four and twice the product of both."""
    null, rng, t = SimulatedGaussian(np.zeros(P), np.eye(P), 10**9), np.random.default_rng(2), np.eye(P)[:, :1]
    noise = rng.normal(size=(P, 50))
    noise -= noise.mean(axis=1, keepdims=True)
    noise = np.linalg.qr(noise.T)[0].T  # whose covariance is exactly one
    scatter = 2.0 * t @ t.T @ noise
    found = null.with_extra_covariance(scatter).fit(10.0 * t[:, 0], t)
    assert with_drawn_scatter(null, t, found, [scatter], [noise]).errors[0] == pytest.approx(3.0, rel=1e-6)


def test_what_does_not_scatter_leaves_the_errors_of_the_fit() -> None:
    """With 30 simulations: errors of a Student t, whose squares are 2.5 times those of the weights."""
    rng = np.random.default_rng(8)
    null, t = SimulatedGaussian.from_simulations(rng.normal(size=(30, P))), rng.normal(size=(P, 2))
    found = null.fit(rng.normal(size=P), t)
    wide = with_drawn_scatter(null, t, found, [np.zeros((P, 6))])
    np.testing.assert_allclose(wide.covariance, found.covariance, rtol=1e-9)


def test_a_growth_is_unbiased() -> None:
    """Changes of twice the scatter, of either sign, along every direction of the skies but their mean."""
    skies, size = 8, 2.0
    nu = skies - 1
    directions = np.linalg.svd(np.eye(skies) - 1.0 / skies)[0][:, :nu]
    own = np.sqrt(nu) * directions @ np.full(nu, nu**-0.5)  # of variance one
    changes = size * np.sqrt(nu) * np.column_stack([np.zeros(skies), directions, -directions])
    before = np.repeat(own[:, None], changes.shape[1], axis=1)
    model, groups = SimulatedGaussian(np.zeros(2 * nu + 1), np.eye(2 * nu + 1), 10**9), list(range(2 * nu + 1))
    found = Acting.of(model, np.eye(2 * nu + 1), [(k,) for k in groups], 0, (before, before + changes))
    # Once in the data and once in the mean of the skies.
    assert np.mean(found.excess[1:]) == pytest.approx(size**2 * (1.0 + 1.0 / skies), rel=1e-6)
