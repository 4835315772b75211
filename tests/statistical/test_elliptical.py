"""Chi^2 of data whose covariance a random factor scales has uniform p-values, and Gaussian data keep theirs."""

import numpy as np
import pytest
from scipy import stats

from mcsim.datavector.halves import Halves
from mcsim.stats.elliptical import f_tail, leave_one_out, scale_variance
from mcsim.stats.excess import scatter_chi2
from mcsim.stats.gaussian import Fit, SimulatedGaussian, held_out_pvalues, residual_pvalue

SEED = 20121024


def drawn(rng: np.random.Generator, count: int, p: int, variance: float) -> np.ndarray:
    """Correlated vectors, shape (count, p), scaled by the inverse of a Gamma variable, of mean 1 and this variance."""
    z = rng.normal(size=(count, p)) @ (np.eye(p) + 0.3 * np.eye(p, k=1))
    if variance == 0.0:
        return z
    shape = 2.0 + 1.0 / variance
    return z * np.sqrt((shape - 1.0) / rng.gamma(shape, size=(count, 1)))


def test_without_a_scale_the_tails_are_fishers() -> None:
    f, d1, d2 = np.linspace(0.2, 3.0, 5), np.array([1.0, 7.0, 60.0, 200.0, 3.0]), 40.0
    np.testing.assert_allclose(f_tail(f, d1, d2), stats.f.sf(f, d1, d2), rtol=1e-10)
    np.testing.assert_allclose(f_tail(f, d1, d2, scale=1e-9), f_tail(f, d1, d2), rtol=1e-4)


def test_odds_of_a_covariance_that_grows_alike_everywhere_are_those_of_gaussian_data() -> None:
    q, growth, chi2 = 40, 3.0, np.array([20.0, 40.0, 120.0, 300.0])
    null = SimulatedGaussian(np.zeros(q + 2), np.eye(q + 2), 1_000_000_000)
    found = null.log_odds_of_scatter(chi2, 2, q * (growth - 1.0), q * (growth - 1.0) ** 2)
    exact = 0.5 * (chi2 * (1.0 - 1.0 / growth) - q * np.log(growth))
    np.testing.assert_allclose(found, exact, atol=1e-4)
    np.testing.assert_allclose(null.log_odds_of_scatter(chi2, 2, 0.0, 0.0), 0.0, atol=1e-12)


def test_student_vectors_are_exact_for_a_known_covariance() -> None:
    variance, q, chi2 = 0.02, 50, np.array([30.0, 60.0, 90.0, 120.0])
    shape = 2.0 + 1.0 / variance
    exact = stats.f.sf(chi2 / q * shape / (shape - 1.0), q, 2.0 * shape)
    np.testing.assert_allclose(residual_pvalue(chi2, q, 1_000_000_000, scale=variance), exact, rtol=1e-4)


@pytest.mark.parametrize("variance", [0.0, 0.03])
@pytest.mark.parametrize(("p", "count"), [(30, 300), (30, 60)])
def test_variance_of_the_scale_is_found(p: int, count: int, variance: float) -> None:
    rng, found = np.random.default_rng([SEED, p, count]), []
    for _ in range(300):
        simulations = drawn(rng, count, p, variance)
        white = SimulatedGaussian.from_simulations(simulations).whitening @ (simulations - simulations.mean(axis=0)).T
        a = leave_one_out(white.T)
        found.append(scale_variance(a, count - 2, p))
    error = 2.0 / p * np.sqrt(2.0 / count)
    # Half of the estimates of a variance of zero are zero, and the others half-normal: 0.4 errors on average. What few
    # simulations know of a scale is in their own scatter: it is underestimated, by p/N of it.
    mean = variance if variance else 0.4 * error * (1.0 - p / count) ** -1
    assert abs(np.mean(found) - mean) < 4.0 * np.std(found) / np.sqrt(300) + 2.0 * p / count * variance + 0.2 * error
    assert variance > 0.0 or np.std(found) < 2.0 * error / (1.0 - p / count)


@pytest.mark.parametrize("variance", [0.0, 0.01, 0.05])
def test_pvalues_are_uniform(variance: float) -> None:
    """300 ensembles of 400 simulations of 40 elements, each met by 60 data."""
    rng, p, count, ensembles, data = np.random.default_rng(SEED), 40, 400, 300, 60
    found, plain = [], []
    for _ in range(ensembles):
        null = SimulatedGaussian.from_simulations(drawn(rng, count, p, variance))
        chi2 = np.sum(null.whiten(drawn(rng, data, p, variance)) ** 2, axis=1)
        found.append(null.residual_test(chi2))
        plain.append(residual_pvalue(chi2, p, null.dof))
    for level in (0.05, 0.02, 0.005):
        # Data of one ensemble share its errors; the variance of their counts says by how much.
        counts = np.sum(np.array(found) < level, axis=1)
        sigma = np.std(counts) / np.sqrt(ensembles) / data
        assert abs(np.mean(counts) / data - level) < 4.0 * sigma + 0.05 * level
    if variance > 0.0:
        assert np.mean(np.array(plain) < 0.02) > np.mean(np.array(found) < 0.02) + 0.2 * variance


def test_simulations_against_others_are_uniform() -> None:
    simulations = drawn(np.random.default_rng(SEED), 2000, 30, 0.05)
    null = SimulatedGaussian.from_simulations(simulations)
    assert stats.kstest(held_out_pvalues(simulations, null), "uniform").pvalue > 1e-3


@pytest.mark.parametrize("growth", [1.0, 1.2, 2.0])
def test_scatter_that_effects_add(growth: float) -> None:
    """More noise, and a response that differs from sky to sky: chi^2 of residuals grows and scatters as forecast."""
    rng, p, skies = np.random.default_rng(SEED), 60, 8
    null = SimulatedGaussian(np.zeros(p), np.eye(p), 1_000_000)
    t, spread, noisy = np.eye(p)[:, :1], 0.2, np.where(np.arange(p) < 20, growth, 1.0)
    forecasts = []
    for _ in range(400):
        before = rng.normal(size=(skies, p))
        after = noisy * before + 10.0 * t[:, 0] + spread * rng.normal(size=(skies, p))
        forecasts.append(np.array(scatter_chi2(null, t, before, after)))
    added = (noisy**2 - 1.0 + spread**2 + ((noisy - 1.0) ** 2 + spread**2) / skies)[1:]
    q, (trace, square) = p - 1, np.mean(forecasts, axis=0)
    errors = 4.0 * np.std(forecasts, axis=0) / np.sqrt(len(forecasts))
    assert abs(trace - added.sum()) < errors[0]
    # The second has half of the squared error of the first, and is never below the least that is possible.
    assert (
        -errors[1]
        < square - np.sum(added**2)
        < errors[1] + np.var([one[0] for one in forecasts]) + added.sum() ** 2 / q
    )
    # Residuals have the p-values that they should have, with the two known, or from eight skies each time.
    x = noisy * rng.normal(size=(20_000, p)) + spread * rng.normal(size=(20_000, p))
    x -= np.sqrt(((noisy - 1.0) ** 2 + spread**2) / skies) * rng.normal(size=x.shape)
    chi2, few = np.sum(x[:, 1:] ** 2, axis=1), np.array(forecasts)[np.arange(len(x)) % len(forecasts)].T
    for one in ((added.sum(), np.sum(added**2)), few):
        pvalues = residual_pvalue(chi2, q, null.dof, one[0], 0.0, one[1])
        for level in (0.05, 0.02):
            assert abs(np.mean(pvalues < level) - level) < 4.0 * np.sqrt(level / len(x)) + 0.25 * level
    plain = residual_pvalue(chi2, q, null.dof, added.sum())
    assert growth < 2.0 or np.mean(plain < 0.02) > 0.06


def test_a_response_without_scatter_adds_nothing() -> None:
    rng = np.random.default_rng(SEED)
    null, t = SimulatedGaussian(np.zeros(9), np.eye(9), 1000), np.eye(9)[:, :1]
    before = rng.normal(size=(8, 9))
    assert scatter_chi2(null, t, before, before + 5.0 * t[:, 0]) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_what_remains_of_rightly_described_noise_is_uniform():
    """Data of a fifth more noise, frozen at what the other half says: two thirds had p below 0.05."""
    rng = np.random.default_rng(SEED)
    p, a, skies, draws = 80, 0.2, 24, 300
    t = np.zeros((p, 1))
    t[::4] = 12.0  # variances, which say how large the noise is; all other elements only scatter more
    simulations = rng.normal(size=(800, p))
    first, second = np.arange(p // 2), np.arange(p // 2, p)
    used, fresh = (SimulatedGaussian.from_simulations(simulations[:, rows]) for rows in (first, second))
    pvalues: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(draws):
        halves = Halves((t * a)[:, 0] + (1.0 + a) * rng.normal(size=p), used, fresh, first, second)
        z = rng.normal(size=(skies, p))

        def pair(frozen: Fit, z: np.ndarray = z) -> tuple[np.ndarray, np.ndarray]:
            return z, t @ frozen.amplitudes + (1.0 + frozen.amplitudes[0]) * z

        for told in (False, True):
            found = halves.reduction(t, lambda frozen: t @ frozen.amplitudes, skies=pair if told else None)
            pvalues[told].append(found.pvalue_after)
    assert np.mean(np.array(pvalues[False]) < 0.05) > 0.4
    assert stats.kstest(pvalues[True], "uniform").pvalue > 0.01
