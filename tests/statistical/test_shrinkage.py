"""A covariance from few simulations: its eigenvalues, what it is worth, and uniform p-values with it."""

import numpy as np
import pytest
from scipy.stats import kstest

from mcsim.stats import look_elsewhere
from mcsim.stats.gaussian import SimulatedGaussian, held_out_pvalues
from mcsim.stats.look_elsewhere import calibrate, calibrate_in_folds
from mcsim.stats.shrinkage import FOLDS, _whitening, posterior_means, shrunk_eigenvalues
from refusals import refused

P, N = 24, 72


def root(seed=0, p=P):
    """A few strong correlations among elements of different scale, the rest weak: as in data vectors."""
    rng = np.random.default_rng(seed)
    loadings = np.where(rng.random((p, 5)) < 0.3, rng.normal(size=(p, 5)), 0.0)
    covariance = np.eye(p) + loadings @ loadings.T
    scale = 10.0 ** rng.uniform(-3.0, 3.0, p)
    return np.linalg.cholesky(scale[:, None] * covariance * scale)


def test_eigenvalues_are_those_of_the_truth_along_the_sample_vectors():
    """The estimate is to be u'Cu for every sample eigenvector u; sample eigenvalues are far from it."""
    rng, p, n = np.random.default_rng(1), 120, 240
    truth = np.repeat([1.0, 3.0, 10.0], p // 3)
    draws = rng.normal(size=(n, p)) * np.sqrt(truth)
    values, vectors = np.linalg.eigh(draws.T @ draws / n)
    best = np.sum(vectors**2 * truth[:, None], axis=0)
    found = shrunk_eigenvalues(values, n)
    assert np.sqrt(np.mean((found / best - 1.0) ** 2)) < 0.1
    assert np.sqrt(np.mean((values / best - 1.0) ** 2)) > 0.5
    # Simulations without end: the sample eigenvalues.
    np.testing.assert_allclose(shrunk_eigenvalues(truth[:80:40], 10**9), truth[:80:40], rtol=0.01)


def test_correlations_are_expected_to_be_what_most_of_them_are():
    """Most true values are zero: a measured one is as large as it looks only far beyond its error."""
    rng, count = np.random.default_rng(6), 20_000
    truth = np.where(rng.random(count) < 0.05, rng.normal(0.0, 0.3, count), 0.0)
    errors = np.where(np.arange(count) % 2, 0.05, 0.02)
    measured = truth + errors * rng.normal(size=count)
    found = posterior_means(measured, errors)

    # The best there is: the same formula with the true shares.
    def normal(width):
        variance = errors**2 + width**2
        return np.exp(-0.5 * measured**2 / variance) / np.sqrt(variance)

    some = 0.05 * normal(0.3) / (0.05 * normal(0.3) + 0.95 * normal(0.0))
    best = some * measured * 0.09 / (0.09 + errors**2)
    loss, least = (np.mean((one - truth) ** 2) for one in (found, best))
    # 1.011 of it, with a standard deviation of 0.003 from set to set.
    assert loss < 1.025 * least
    cut = np.where(np.abs(measured) > 4.0 * errors, measured, 0.0)
    assert loss < 0.85 * np.mean((cut - truth) ** 2)


def test_classes_of_correlations_make_few_simulations_worth_more():
    """Eight copies of one kind of data that are correlated weakly: the correlations of all say what each is."""
    kinds, copies, rounds = 12, 8, 6
    p = kinds * copies
    kind, copy = np.tile(np.arange(kinds), copies), np.repeat(np.arange(copies), kinds)
    pairs = np.minimum.outer(kind, kind) * kinds + np.maximum.outer(kind, kind)
    stated, true = np.zeros((rounds, 2)), np.zeros((rounds, 2))
    for number in range(rounds):
        rng = np.random.default_rng(number)
        loadings = np.where(rng.random((kinds, 4)) < 0.5, rng.normal(size=(kinds, 4)), 0.0)
        own = np.eye(kinds) + loadings @ loadings.T
        own /= np.sqrt(np.outer(np.diag(own), np.diag(own)))
        truth = np.kron(np.full((copies, copies), 0.15) + 0.85 * np.eye(copies), own)
        simulations = rng.normal(size=(2 * p, p)) @ np.linalg.cholesky(truth).T
        for column, known in enumerate((None, 2 * pairs + (copy[:, None] == copy))):
            null = SimulatedGaussian.from_simulations(simulations, shrink=True, classes=known)
            inner = null.whitening @ truth @ null.whitening.T
            # Share of the squared signal-to-noise ratio of an average template, and what the worth says of it.
            true[number, column] = np.trace(inner) ** 2 / np.sum(inner**2) / p
            stated[number, column] = (null.dof - p - 3.0) / (null.dof - 1.0)
    assert np.all(true[:, 1] > true[:, 0] + 0.1)
    # One set of simulations states it to 0.075 without classes and 0.04 with them.
    np.testing.assert_allclose(stated.mean(axis=0), true.mean(axis=0), atol=3.0 * 0.075 / np.sqrt(rounds))


def test_pvalues_are_uniform_and_the_worth_is_that_of_a_sample_covariance(monkeypatch):
    """Four data of each of 250 ensembles; templates are tested at once, as in a diagnosis."""
    monkeypatch.setattr(look_elsewhere, "SCATTERS", 40)  # each for ten draws, not two: the number of draws counts here
    rng, mixing = np.random.default_rng(2), root()
    templates = mixing @ rng.normal(size=(P, 6))
    omnibus, combined, worth, kept = [], [], [], []
    for number in range(250):
        simulations = rng.normal(size=(N, P)) @ mixing.T
        null = SimulatedGaussian.from_simulations(simulations, shrink=True)
        data = rng.normal(size=(4, P)) @ mixing.T
        chi2 = np.sum(null.whiten(data) ** 2, axis=1)
        omnibus += list(null.residual_test(chi2))
        worth.append(null.dof)
        # Signal-to-noise squared of optimal weights, over that of the true covariance.
        weights = null.whitening.T @ null.whiten_templates(templates)
        signal = np.sum(weights * templates, axis=0) ** 2 / np.sum((mixing.T @ weights) ** 2, axis=0)
        kept.append(np.mean(signal / np.sum(np.linalg.solve(mixing, templates) ** 2, axis=0)))
        if number < 60:
            groups = null.whiten_groups(templates, [[0], [1], [2], [3], [4, 5]])
            calibration = calibrate_in_folds(calibrate(null, groups, draws=400), null, groups)
            smallest = null.nested_test(groups.delta_chi2(null.whiten(data)), chi2[:, None], groups.sizes).min(axis=1)
            combined += list(calibration.combine(null.residual_test(chi2), smallest))
    for pvalues in (omnibus, combined):
        assert kstest(pvalues, "uniform").pvalue > 1e-3
        below = np.mean(np.array(pvalues) < 0.05)
        assert abs(below - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / len(pvalues))
    # A sample covariance of N keeps 1 - P/(N - 1) of the squared signal-to-noise ratio.
    n = float(np.median(worth))
    assert n > 1.3 * N
    assert np.mean(kept) > 1.0 - P / n - 0.03
    assert np.mean(kept) > 1.0 - P / (N - 1.0) + 0.05


@pytest.mark.slow
def test_the_smallest_pvalue_is_uniform_where_templates_are_known_better_than_data(monkeypatch):
    """Weak correlations, which the target leaves out, and templates of few elements: 10,000 data of 40 ensembles.

    By the worth alone p-values of the templates are too large (distance 0.04 from uniform).
    """
    monkeypatch.setattr(look_elsewhere, "SCATTERS", 40)
    rng, p = np.random.default_rng(5), 60
    loadings = 0.3 * np.where(rng.random((p, 5)) < 0.3, rng.normal(size=(p, 5)), 0.0)
    mixing = np.linalg.cholesky(np.eye(p) + loadings @ loadings.T)
    templates = np.where(rng.random((p, 15)) < 0.15, rng.normal(size=(p, 15)), 0.0) + 0.02 * rng.normal(size=(p, 15))
    found = []
    for number in range(40):
        null = SimulatedGaussian.from_simulations(rng.normal(size=(5 * p, p)) @ mixing.T, shrink=True)
        groups = null.whiten_groups(templates, [[column] for column in range(15)])
        calibration = calibrate_in_folds(calibrate(null, groups, draws=2000, seed=number), null, groups)
        white = null.whiten(rng.normal(size=(250, p)) @ mixing.T)
        scores = null.nested_test(groups.delta_chi2(white), np.sum(white**2, axis=1)[:, None], groups.sizes)
        found.append((calibration.power, calibration.global_pvalue(scores.min(axis=1))))
    powers, pvalues = zip(*found, strict=True)
    assert np.mean(powers) > 1.03
    # The power of each ensemble has an error of 1/sqrt(300), which moves the distribution by 0.02 at most.
    assert kstest(np.concatenate(pvalues), "uniform").statistic < 1.63 / np.sqrt(1e4) + 3.0 * 0.02 / np.sqrt(40)


def test_simulations_are_tested_with_the_covariance_of_the_others():
    simulations = np.random.default_rng(3).normal(size=(N, P)) @ root().T
    null = SimulatedGaussian.from_simulations(simulations, shrink=True)
    found = held_out_pvalues(simulations, null)
    z = simulations / simulations.std(axis=0)
    scale = np.linalg.norm(null.whitening * simulations.std(axis=0)) / np.linalg.norm(_whitening(z, np.eye(P), None))
    for i in range(0, N, 7):
        out = np.arange(N) % FOLDS == i % FOLDS
        others = scale * _whitening(z[~out], np.eye(P), None)
        white = others @ (z[i] - z[~out].mean(axis=0)) / np.sqrt(1.0 + 1.0 / (~out).sum())
        assert found[i] == pytest.approx(float(null.residual_test(white @ white)), rel=1e-6)
        # Templates keep lengths and angles, in the coordinates of all and of the others.
        turned = null.folds[i % FOLDS].turn @ null.whitening[:, :2]
        own = others[:, :2] / simulations.std(axis=0)[:2]
        np.testing.assert_allclose(turned.T @ turned, own.T @ own, rtol=1e-6)


@pytest.mark.parametrize("count", [P + 5, 10 * P])
def test_many_simulations_need_no_shrinkage_and_too_few_are_refused(count):
    simulations = np.random.default_rng(4).normal(size=(count, P)) @ root().T
    if count < P + 7:
        with refused(count, P + 7):
            SimulatedGaussian.from_simulations(simulations, shrink=True)
        return
    found, plain = (SimulatedGaussian.from_simulations(simulations, shrink=one) for one in (True, False))
    assert found.dof > 0.8 * plain.dof
    data = np.random.default_rng(5).normal(size=(50, P)) @ root().T
    ratio = np.sum(found.whiten(data) ** 2, axis=1) / np.sum(plain.whiten(data) ** 2, axis=1)
    assert np.abs(ratio - 1.0).max() < 0.4
