"""Estimates that are taken for numbers of one size."""

import numpy as np
import pytest

from mcsim.stats.empirical_bayes import shrunk


def test_what_is_hardly_measured_is_small_and_the_rest_stays():
    """The error of both together is that which the covariance says."""
    rng, truth_size = np.random.default_rng(4), 3.0
    axes = np.linalg.qr(rng.normal(size=(8, 8)))[0]
    covariance = (axes * np.array([0.1, 0.1, 0.2, 0.5, 1.0, 2.0, 50.0, 400.0])) @ axes.T
    before, after, said = [], [], []
    for _ in range(400):
        truth = truth_size * rng.normal(size=8)
        estimates = rng.multivariate_normal(truth, covariance)
        found, error = shrunk(estimates, covariance)
        before.append(np.sum((estimates - truth) ** 2))
        after.append(np.sum((found - truth) ** 2))
        said.append(np.trace(error))
        assert axes[:, :3].T @ found == pytest.approx(axes[:, :3].T @ estimates, rel=0.3, abs=0.3)
    assert np.mean(before) == pytest.approx(np.trace(covariance), rel=0.2)
    assert np.mean(after) < 0.08 * np.mean(before)
    assert np.mean(said) == pytest.approx(np.mean(after), rel=0.15)


def test_one_bad_number_does_not_hide_the_size_of_the_others():
    found, error = shrunk(np.array([1.0, -1.0, 1.0, 1e4]), np.diag([0.01, 0.01, 0.01, 1e8]))
    np.testing.assert_allclose(found, [1.0, -1.0, 1.0, 0.0], atol=0.02)
    assert np.all(np.diag(error) < 5.0)


def test_faint_numbers_keep_the_size_of_the_whole():
    """Along itself the estimate is as large as before."""
    estimates, covariance = np.array([0.5, -0.7, 0.6]), np.diag([1.0, 1.0, 4.0])
    found, _ = shrunk(estimates, covariance)
    precision = np.linalg.inv(covariance)
    assert found @ precision @ estimates == pytest.approx(found @ precision @ found)


def test_exact_and_absent_numbers_stay_as_they_are():
    estimates = np.array([1.0, -2.0, 0.5])
    found, error = shrunk(estimates, np.zeros((3, 3)))
    np.testing.assert_allclose(found, estimates)
    np.testing.assert_array_equal(error, 0.0)
    found, error = shrunk(np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(found, 0.0)
    assert np.all(np.isfinite(error))
