"""A pattern whose covariance is known from a few draws: Monte Carlo with known covariances, k sigma."""

import numpy as np
import pytest
from scipy import stats

from mcsim.stats.few_draws import _HeldOut, covariance_of_draws, scores_of_draws, without
from mcsim.stats.gaussian import SimulatedGaussian
from refusals import refused

P, DRAWS, TRIALS, N = 100, 48, 150, 20_000
KS = 1e-3
ORDER = np.arange(P)
SPECTRA = {
    "few modes": np.where(ORDER < 8, 300.0, 0.0),
    "isotropic": np.full(P, 3.0),
    "steep": 3000.0 * np.exp(-ORDER / 3.0),
    "power law": 3000.0 / (1.0 + ORDER) ** 2,
    "shallow": 1000.0 / (1.0 + ORDER),
    "weak": 30.0 / (1.0 + ORDER) ** 2,
}


def widened(rng: np.random.Generator, spectrum: np.ndarray, count: int) -> SimulatedGaussian:
    """Return unit noise, all but known, with a pattern that some draws tell."""
    noise = SimulatedGaussian(np.zeros(P), np.eye(P), N)
    draws = np.sqrt(spectrum)[:, None] * rng.normal(size=(P, count))
    draws -= draws.mean(axis=1, keepdims=True)
    return noise.with_extra_covariance(draws * np.sqrt((1.0 + 1.0 / count) / (count - 1.0)))


def pvalues(spectrum: np.ndarray, draws: int, effect: float = 0.0) -> np.ndarray:
    """Return p-values of further draws, with an effect of this S/N in a random direction."""
    rng, found = np.random.default_rng(20140317), []
    for _ in range(TRIALS):
        wide, direction = widened(rng, spectrum, draws), rng.normal(size=P)
        # The mean of the draws is part of the deviation of a further one, too.
        pattern = np.sqrt(spectrum * (1.0 + 1.0 / draws)) * rng.normal(size=P)
        found.append(wide.pvalue(pattern + rng.normal(size=P) + effect * direction / np.linalg.norm(direction)))
    return np.array(found)


@pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA)
def test_pvalues_of_further_draws_are_uniform(spectrum):
    found = pvalues(spectrum, DRAWS)
    assert stats.kstest(found, "uniform").pvalue > KS
    assert np.mean(found < 0.02) < 0.02 + 3.0 * np.sqrt(0.02 * 0.98 / TRIALS)


def test_a_second_effect_beside_a_strong_pattern_is_seen():
    """Of S/N 12 in a random direction, beside a pattern of S/N 100: by the weight of Ledoit and Wolf never."""
    assert np.mean(pvalues(SPECTRA["steep"], DRAWS, 12.0) < 0.02) > 0.9


def test_deviations_without_a_draw_are_those_of_the_others():
    draws = np.random.default_rng(1).normal(size=(5, 7))
    deviations = (draws - draws.mean(axis=1, keepdims=True)) / np.sqrt(6.0)
    others = np.delete(draws, 2, axis=1)
    expected = (others - others.mean(axis=1, keepdims=True)) / np.sqrt(5.0)
    np.testing.assert_allclose(without(deviations, 2), expected, rtol=1e-12)


def test_scores_of_held_out_draws_are_those_of_explicit_covariances():
    """With the weights of all other draws: the normal matrix, and what noise and the draw itself scatter."""
    rng, p, count = np.random.default_rng(2), 9, 6
    draws, t = 3.0 * rng.normal(size=(p, count)), rng.normal(size=(p, 3))
    deviations = (draws - draws.mean(axis=1, keepdims=True)) * np.sqrt((1.0 + 1.0 / count) / (count - 1.0))
    weight, scale, _ = _HeldOut.of(deviations).best()
    normal, covariance = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(count):
        others = without(deviations, k)
        R = scale * ((1.0 - weight) * others @ others.T + weight * np.sum(others**2) / p * np.eye(p))
        filtered = np.linalg.solve(np.eye(p) + R, t)
        score = filtered.T @ deviations[:, k] * np.sqrt(count)
        normal += t.T @ filtered / count
        covariance += (filtered.T @ filtered + np.outer(score, score)) / count
    for found, expected in zip(scores_of_draws(deviations, t), (normal, covariance), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_no_pattern_has_no_covariance_and_three_draws_are_refused():
    covariance, error = covariance_of_draws(np.zeros((4, 6)))
    assert not covariance.any()
    assert error == 0.0
    with refused(3):
        covariance_of_draws(np.ones((4, 3)))


def test_scale_and_error_are_those_of_explicit_held_out_draws():
    """The mean chi^2 of held-out draws is p, and its variance beyond that of noise is what is returned."""
    rng, p, count = np.random.default_rng(3), 9, 6
    draws = np.linspace(9.0, 0.5, p)[:, None] * rng.normal(size=(p, count))
    deviations = (draws - draws.mean(axis=1, keepdims=True)) * np.sqrt((1.0 + 1.0 / count) / (count - 1.0))
    weight, scale, error = _HeldOut.of(deviations).best()
    mean, noise = np.empty((2, count))
    for k in range(count):
        others = without(deviations, k)
        R = scale * ((1.0 - weight) * others @ others.T + weight * np.sum(others**2) / p * np.eye(p))
        inverse, z = np.linalg.inv(np.eye(p) + R), deviations[:, k] * np.sqrt(count)
        # (z + n)'A(z + n) with standard normal n.
        mean[k] = z @ inverse @ z + np.trace(inverse)
        noise[k] = 4.0 * z @ inverse @ inverse @ z + 2.0 * np.trace(inverse @ inverse)
    assert np.mean(mean) == pytest.approx(p, rel=1e-4)
    assert error == pytest.approx((np.mean(noise) + np.var(mean, ddof=1) - 2.0 * p) / (p * (p + 2.0)), rel=1e-6)
    assert error > 0.0
