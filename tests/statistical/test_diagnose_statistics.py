"""The exact tests are exact, detection has its power, and shrink is what was forecast: Monte Carlo, k sigma."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import special, stats
from scipy.linalg import solve_triangular

from mcsim.datavector.localisation import places
from mcsim.datavector.summaries import Element
from mcsim.stats.detection import confusion, detectable, log_marginals, power, snr_needed, snr_to_separate
from mcsim.stats.excess import excess, expected_fall, expected_fall_of_draw, held_out
from mcsim.stats.gaussian import SimulatedGaussian, nested_pvalue, residual_pvalue
from mcsim.stats.look_elsewhere import calibrate, global_test, scan_pvalues

SEED = 20121024
# Of a uniform sample a Kolmogorov-Smirnov probability is below this once in a thousand seeds.
KS = 1e-3


def drawn_null(rng: np.random.Generator, p: int, count: int) -> SimulatedGaussian:
    """Null of ``count`` simulations of p independent unit normals: Bartlett's scatter instead of the simulations."""
    n = count - 1
    root = np.tril(rng.normal(size=(p, p)), -1) + np.diag(np.sqrt(rng.chisquare(n - np.arange(p))))
    whitening = np.sqrt(n) * solve_triangular(root, np.eye(p), lower=True)
    return SimulatedGaussian(rng.normal(size=p) / np.sqrt(count), whitening, count)


@pytest.fixture(scope="module")
def few_simulations() -> dict[str, np.ndarray]:
    """1200 vectors of 12, each with its own 20 simulations of a common covariance: a chi^2 test is far off."""
    rng = np.random.default_rng(SEED)
    p, count, draws = 12, 20, 1200
    root = np.tril(rng.normal(size=(p, p))) + 2.0 * np.eye(p)
    t = rng.normal(size=(p, 5))
    truth = np.array([3.0, -1.0, 0.0, 0.0, 0.0])
    found: dict[str, list] = {
        name: [] for name in ("omnibus", "one", "three", "residual", "further", "student", "pull")
    }
    for _ in range(draws):
        fiducial = SimulatedGaussian.from_simulations(rng.normal(size=(count, p)) @ root.T)
        noise = root @ rng.normal(size=p)
        y = fiducial.whiten(noise)
        found["omnibus"].append(residual_pvalue(y @ y, p, count - 1))
        found["one"].append(fiducial.fit(noise, t[:, :1]).nested_pvalue)
        found["three"].append(fiducial.fit(noise, t[:, 2:]).nested_pvalue)
        x = noise + t @ truth
        two, all_of_them = fiducial.fit(x, t[:, :2]), fiducial.fit(x, t)
        found["residual"].append(two.pvalue)
        found["further"].append(nested_pvalue(two.chi2 - all_of_them.chi2, two.chi2, 3, p - 2, count - 1))
        scale = two.errors / stats.t.std(two.dof)
        found["student"].append(stats.t.cdf((two.amplitudes - truth[:2]) / scale, two.dof))
        found["pull"].append((two.amplitudes - truth[:2]) / two.errors)
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize("name", ["omnibus", "one", "three", "residual", "further"])
def test_probabilities_are_uniform(name, few_simulations):
    assert stats.kstest(few_simulations[name], "uniform").pvalue > KS


def test_amplitudes_are_student(few_simulations):
    draws = few_simulations["student"]
    for column in draws.T:
        assert stats.kstest(column, "uniform").pvalue > KS
    pulls = few_simulations["pull"]
    # The excess kurtosis of this t is 6/5: the standard error of the width is 0.026, of the mean 0.029.
    assert np.all(np.abs(pulls.std(axis=0) - 1.0) < 0.1)
    assert np.all(np.abs(pulls.mean(axis=0)) < 0.14)


@pytest.mark.parametrize(("p", "count", "draws"), [(20, 200, 600), (100, 1000, 300)])
def test_gap_is_uniform(p, count, draws):
    """Two dozen candidates of one to three columns, half of them alike; the calibration has a scatter of its own."""
    rng = np.random.default_rng(SEED + p)
    t = rng.normal(size=(p, 40))
    t[:, 20:] += 2.0 * t[:, :1]
    groups = [(i,) for i in range(12)] + [(i, i + 1) for i in range(12, 30, 2)] + [(31, 32, 33), (35, 36, 37)]
    fiducial = drawn_null(rng, p, count)
    calibration = calibrate(fiducial, fiducial.whiten_groups(t, groups), seed=SEED)
    found = []
    for _ in range(draws):
        fiducial = drawn_null(rng, p, count)
        one = global_test(fiducial, rng.normal(size=p), fiducial.whiten_groups(t, groups), calibration)
        found.append([one.pvalue, one.maximum])
    low, high = stats.binom.interval(0.999, draws, 0.05)
    # The first one is ranked among draws, whatever the second one is: each is looked at.
    for pvalues in np.transpose(found):
        assert stats.kstest(pvalues, "uniform").pvalue > KS
        assert low <= np.sum(pvalues < 0.05) <= high


def test_atlas_is_calibrated_within_and_beyond_the_ranks():
    """400 ensembles of 39 simulations of 60 correlated numbers, each met by 100 data.

    Simulations that know themselves have p <= 0.05 in nearly twice as many data, and with all 60 numbers as trials
    p <= 0.01 in a third of them.
    """
    rng = np.random.default_rng(SEED)
    mixing = np.exp(-np.abs(np.subtract.outer(np.arange(60), np.arange(60))) / 5.0)
    found = []
    for _ in range(400):
        simulations = rng.normal(size=(39, 60)) @ mixing
        found.append(scan_pvalues(rng.normal(size=(100, 60)) @ mixing, simulations)[1].min(axis=1))
    smallest = np.concatenate(found)
    # Data of one ensemble share its ranks: a level a errs by sqrt(1/(39 a))/sqrt(400), beside Poisson's error. The
    # smallest rank is 1/40; 0.01 lies beyond it, where the fitted trials err by less.
    for level in (0.1, 0.05, 0.01):
        sigma = np.sqrt(1.0 / (level * 40_000) + 1.0 / (39 * level) / 400)
        assert abs(np.mean(smallest <= level) / level - 1.0) < 4.0 * sigma


def test_groups_of_numbers_depart_as_often_as_they_say():
    """Simulations are compared with others that do not know them, as data are: 0.24 of data had p <= 0.1 before."""
    rng, count, sims = np.random.default_rng(SEED), 200, 25
    elements = [
        Element(f"{L}/{k}", "biposh", ("W1",), L=L, M=0, parity="even", frame="ecliptic")
        for L, k in product(range(150), range(2))
    ]
    size, found = len(elements), []
    for _ in range(count):
        ranked = places(rng.normal(size=size), rng.normal(size=(sims, size)), elements)
        found.append(min(one.p for one in ranked))
    # Of 25 ranks 2 are at most 0.1 of 26.
    low, high = 2.0 / 26.0, 0.1
    rate = np.mean(np.array(found) <= 0.1)
    assert low - 4.0 * np.sqrt(low / count) < rate < high + 4.0 * np.sqrt(high * 0.9 / count)


def test_power_is_that_of_drawn_ensembles():
    rng = np.random.default_rng(SEED)
    p, count, threshold, draws = 15, 60, 0.01, 1500
    for columns in (1, 3):
        strength = snr_needed(columns, 5, p, count, alpha=0.05)
        assert power(strength, columns, threshold, p, count) == pytest.approx(0.9, abs=1e-4)
        t = np.eye(p)[:, :columns]
        x = strength * np.sqrt(1 + 1 / count) * t[:, 0]
        hits = sum(
            drawn_null(rng, p, count).fit(x + rng.normal(size=p), t).nested_pvalue < threshold for _ in range(draws)
        )
        assert abs(hits - 0.9 * draws) < 4.0 * np.sqrt(0.09 * draws)


def test_detectable_amplitude_is_unbiased():
    """Averaged over scatters, the amplitude found from S is that of the true covariance within 1 %."""
    rng = np.random.default_rng(SEED)
    p, count = 40, 400
    t = np.eye(p)[:, :1] * 0.5
    found = [detectable(drawn_null(rng, p, count), t, 20) for _ in range(60)]
    # The relative scatter of one is 1/sqrt(2 (n - p)) = 0.037, of their mean 0.005.
    expected = snr_needed(1, 20, p, count) * np.sqrt(1.0 + 1.0 / count) / 0.5
    assert np.mean(found) == pytest.approx(expected, rel=0.02)
    assert expected > 4.305 / 0.5


@pytest.mark.parametrize("cosine", [0.0, 0.7, -0.95])
def test_confusion_is_that_of_drawn_scores(cosine):
    rng = np.random.default_rng(SEED)
    strength, draws = snr_to_separate(cosine), 20_000
    assert confusion(strength, cosine) == pytest.approx(0.05, abs=1e-6)
    noise = rng.normal(size=(draws, 2)) @ np.linalg.cholesky([[1.0, cosine], [cosine, 1.0]]).T
    scores = np.abs(strength * np.array([1.0, cosine]) + noise)
    wrong = np.sum(scores[:, 1] > scores[:, 0])
    assert abs(wrong - 0.05 * draws) < 4.0 * np.sqrt(0.0475 * draws)


def test_posterior_is_calibrated():
    """Of effects drawn from the prior, the probability given to the favourite is the fraction that is right.

    By 100 simulations of 20 elements: with a Gaussian likelihood those above 0.9 are right too seldom, by 15 sigma.
    """
    rng = np.random.default_rng(SEED)
    p, count, draws = 20, 100, 2000
    t = rng.normal(size=(p, 9))
    t[:, 4] = t[:, 0] + 0.5 * rng.normal(size=p)
    groups = [(0,), (1, 2), (3,), (4,), (5, 6, 7), (8,)]
    strengths, prior = np.linspace(1.0, 7.0, 25), np.array([0.4, *[0.1] * 6])
    exact = SimulatedGaussian(np.zeros(p), np.eye(p), 10**9).whiten_groups(t, groups)
    fiducial, right = [], []
    for _ in range(draws // 5):
        found = drawn_null(rng, p, count)
        candidates = found.whiten_groups(t, groups)
        truth = rng.choice(7, size=5, p=prior)
        x = rng.normal(size=(5, p))
        for row, index in zip(x, truth, strict=True):
            if index:
                basis = exact.basis[:, exact.start[index - 1] : exact.start[index]]
                direction = rng.normal(size=basis.shape[1])
                row += rng.choice(strengths) * basis @ direction / np.linalg.norm(direction)
        probability = special.softmax(log_marginals(found, x, candidates, strengths) + np.log(prior), axis=1)
        fiducial.append(probability.max(axis=1))
        right.append(probability.argmax(axis=1) == truth)
    confidence, hit = np.concatenate(fiducial), np.concatenate(right)
    sigma = np.sqrt(np.sum(confidence * (1 - confidence)))
    assert abs(np.sum(hit) - np.sum(confidence)) < 4.0 * sigma
    for part in (confidence < 0.6, confidence > 0.9):
        sigma = np.sqrt(np.sum((confidence * (1 - confidence))[part]))
        assert abs(np.sum(hit[part]) - np.sum(confidence[part])) < 4.0 * sigma


@pytest.fixture(scope="module", params=[(0.0, 12.0), (12.0, 12.0), (25.0, 0.0)])
def frozen_fits(request) -> dict[str, np.ndarray]:
    """Twelve amplitudes fitted to 40 data and frozen for 30 others, whose gap is that of two of them; 600 times.

    Where effects are all that is there the noise that both gaps have is most of the error: pulls are 2.5 wide without.
    """
    strength, unexplained = request.param
    rng = np.random.default_rng(SEED)
    count, p, columns = 500, 30, 12
    t_fit, t_test = rng.normal(size=(40, columns)), rng.normal(size=(p, columns))
    t_fit /= np.linalg.norm(t_fit, axis=0)
    t_test /= np.linalg.norm(t_test, axis=0)
    truth = strength * np.where(np.arange(columns) == 0, 1.0, 0.5 * (np.arange(columns) == 1))
    found: dict[str, list] = {
        name: [] for name in ("drop", "sigma", "forecast", "forecast_sigma", "fraction", "pull", "before", "after")
    }
    signal = t_test @ truth
    # What no candidate explains keeps the gap of the case without an effect well away from zero.
    other = np.linalg.qr(np.column_stack([t_test, rng.normal(size=p)]))[0][:, columns] * unexplained
    for _ in range(600):
        best = drawn_null(rng, 40, count).fit(t_fit @ truth + rng.normal(size=40), t_fit)
        before, after = drawn_null(rng, p, count), drawn_null(rng, p, count)
        after = SimulatedGaussian(after.mean + t_test @ best.amplitudes, after.whitening, count)
        x = signal + other + rng.normal(size=p)
        forecast = expected_fall(before, t_test, best.amplitudes, best.covariance)
        shrink = held_out(before, after, x, forecast, "others")
        left = signal - t_test @ best.amplitudes
        expected = 1.0 - (left @ left + other @ other) / (signal @ signal + other @ other)
        found["forecast"].append(forecast.value)
        found["forecast_sigma"].append(forecast.sigma)
        found["drop"].append(shrink.before.value - shrink.after.value)
        found["sigma"].append(shrink.achieved.sigma)
        found["fraction"].append(shrink.achieved.value)
        found["pull"].append((shrink.achieved.value - expected) / shrink.achieved.sigma)
        found["before"].append(shrink.before.value)
        found["after"].append(shrink.pvalue_after)
    return {name: np.array(values) for name, values in found.items()} | {"gap": signal @ signal + other @ other}


def test_forecast_drop_is_the_drop(frozen_fits):
    difference = frozen_fits["drop"] - frozen_fits["forecast"]
    assert abs(difference.mean()) < 4.0 * difference.std() / np.sqrt(len(difference))


def falls_of_draws(brightness: float, columns: int, strength: float) -> np.ndarray:
    """Fall of chi^2 by what was fitted, less the forecast, and the error of this, shape (trials, 2 signs of noise, 2).

    A response that scatters by 0.3 of itself: 40 data are fitted by it and other templates, and 30 others see the same
    draw. The whole of it may be brighter or fainter, lognormally distributed.
    """
    rng = np.random.default_rng(SEED)
    fitted, p, count, draws = 40, 30, 500, 48
    templates = rng.normal(size=(fitted + p, columns))
    templates *= strength / np.linalg.norm(templates, axis=0)
    t, sideways = templates[:, 0], rng.normal(size=(fitted + p, 2))
    root = 0.3 * np.column_stack([t, strength * sideways / np.linalg.norm(sideways, axis=0)])
    found = []
    for _ in range(140):
        learning, before = drawn_null(rng, fitted, count), drawn_null(rng, p, count)
        bright = np.exp(brightness * rng.normal(size=draws + 1) - brightness**2 / 2.0)
        scatter = bright[1:] * (t[:, None] + root @ rng.normal(size=(3, draws)))
        scatter = (scatter - scatter.mean(axis=1, keepdims=True)) / np.sqrt(draws - 1.0)
        drawn = (t + np.sqrt(draws) * scatter.T) ** 2
        shares = drawn[:, fitted:].sum(axis=1) / drawn[:, :fitted].sum(axis=1)
        signal, noise = bright[0] * (t + root @ rng.normal(size=3)), rng.normal(size=fitted + p)
        learned = learning.with_extra_covariance(scatter[:fitted])
        for x in (signal + noise, signal - noise):
            frozen = learned.fit(x[:fitted], templates[:fitted]).amplitudes
            errors = learning.fit(x[:fitted], templates[:fitted]).covariance
            moved = replace(before, mean=before.mean + templates[fitted:] @ frozen)
            after = moved.with_extra_covariance(scatter[fitted:])
            seen = excess(learning, x[:fitted])
            forecast = expected_fall_of_draw(after, templates[fitted:], errors, seen, shares)
            shrink = held_out(before, after, x[fitted:], forecast, "others")
            found.append([shrink.before.value - shrink.after.value - forecast.value, forecast.sigma])
    return np.reshape(found, (-1, 2, 2))


@pytest.mark.parametrize("brightness", [0.0, 0.6])
def test_forecast_drop_of_what_draws_is_the_drop(brightness):
    differences, errors = falls_of_draws(brightness, 1, 15.0)[:, 0].T
    assert abs(np.mean(differences)) < 4.0 * np.std(differences) / np.sqrt(len(differences))
    # Forecasts of the mean drop: the noise of the data that measure it is not in their error.
    assert 0.7 < 1.0 / np.std(np.divide(differences, errors)) < 1.2


def test_errors_of_what_was_fitted_are_forecast_to_cost_what_they_do():
    """Those of sixteen amplitudes 20, 12 times the error of the mean over both signs of the noise."""
    differences = falls_of_draws(0.0, 16, 8.0)[..., 0].mean(axis=1)
    assert abs(np.mean(differences)) < 4.0 * np.std(differences) / np.sqrt(len(differences))


def test_gap_is_the_squared_distance(frozen_fits):
    gaps = frozen_fits["before"]
    assert abs(gaps.mean() - frozen_fits["gap"]) < 4.0 * gaps.std() / np.sqrt(len(gaps))


def test_errors_of_the_achieved_fraction_are_right(frozen_fits):
    pulls = frozen_fits["pull"]
    # The gap is in the denominator: pulls are skew by some tenths, which a Gaussian's 0.03 of the width leaves aside.
    assert abs(pulls.std() - 1.0) < 0.12
    assert abs(pulls.mean()) < 0.2


def test_gap_has_its_variance():
    rng = np.random.default_rng(SEED)
    p, count, draws = 20, 120, 2500
    for length in (0.0, 10.0):
        x = length * np.sqrt(1 + 1 / count) * np.eye(p)[0]
        values = np.array([excess(drawn_null(rng, p, count), x + rng.normal(size=p)).value for _ in range(draws)])
        d = count - p
        sigma = np.sqrt(2.0 * ((p + length**2) ** 2 + (p + 2.0 * length**2) * (d - 2)) / (d - 4))
        # Standard errors of the mean, and of the width with an excess kurtosis of about 1.
        assert abs(values.mean() - length**2) < 4.0 * sigma / np.sqrt(draws)
        assert abs(values.std() / sigma - 1.0) < 4.0 * np.sqrt(3.0 / (4.0 * draws))
