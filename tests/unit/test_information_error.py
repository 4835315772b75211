"""Errors of means over pairs of random probes, against many sets of probes."""

import numpy as np
import pytest

from mcsim.information.fisher import variance_of_mean


def sets_of_pairs(n: int, size: int, sets: int) -> np.ndarray:
    """(x'y)^2 of all pairs of n Gaussian vectors, shape (sets, n, n), which no probe has with itself."""
    draws = np.random.default_rng(11).standard_normal((sets, n, size))
    return (draws @ draws.swapaxes(1, 2)) ** 2 * ~np.eye(n, dtype=bool)


@pytest.mark.parametrize("size", [4, 40, 4000])
def test_variance_of_a_mean_over_pairs(size: int) -> None:
    """The jackknife's was twice as large where the products scatter much more than what one vector has of them."""
    n = 24
    pairs = sets_of_pairs(n, size, 300 if size > 40 else 3000)
    means = pairs.sum(axis=(1, 2)) / (n * (n - 1))
    found = np.array([variance_of_mean(one) for one in pairs])
    square = (means - means.mean()) ** 2
    error = np.hypot(square.std(), found.std()) / np.sqrt(len(means))
    assert abs(found.mean() - square.mean()) < 4.0 * error
    assert error < 0.15 * square.mean()


def test_three_probes_have_the_jackknife() -> None:
    (pairs,) = sets_of_pairs(3, 5, 1)
    left_out = [np.delete(np.delete(pairs, k, 0), k, 1)[0, 1] for k in range(3)]
    assert variance_of_mean(pairs) == pytest.approx(2.0 * np.var(left_out), rel=1e-12)
