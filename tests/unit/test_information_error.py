"""Errors of means over pairs of random probes, against many sets of probes."""

import numpy as np
import pytest

import mcsim
from likelihoods import model
from mcsim.information import fisher
from mcsim.information.fisher import variance_of_mean
from mcsim.simulation.survey import survey


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


def test_pairs_whose_means_are_alike_by_chance_have_half_the_variance_of_independent_ones() -> None:
    """Without bias it would be less than nothing."""
    n, k = 6, np.arange(6)
    pairs = np.array([0.0, 2.0, -1.0, 5.0, -1.0, 2.0])[(k[:, None] - k) % n]
    off = pairs[~np.eye(n, dtype=bool)]
    assert np.ptp(np.sum(pairs, axis=1)) == 0.0
    second = np.sum((off - off.mean()) ** 2) / (n * (n - 3))  # of n (n - 3)/2 pairs that are free, each twice
    assert variance_of_mean(pairs) == pytest.approx(second / (n * (n - 1)))


def test_three_probes_have_the_jackknife() -> None:
    (pairs,) = sets_of_pairs(3, 5, 1)
    left_out = [np.delete(np.delete(pairs, k, 0), k, 1)[0, 1] for k in range(3)]
    assert variance_of_mean(pairs) == pytest.approx(2.0 * np.var(left_out), rel=1e-12)


@pytest.mark.parametrize("group", [61, 8])
def test_a_small_last_group_of_probes_counts_by_its_pairs(group: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """61 and 3 of 64 had a scatter of 9 % for 1 %: the three counted as much."""
    run = model()
    only = ("beam_ellipticity", "noise_level", "pixelization")
    exact = mcsim.limit(run, settings=mcsim.LimitSettings(only=only, dense=True)).effects
    pixels = sum(one.weight.size for one in survey(run).maps)
    monkeypatch.setattr(fisher, "PAIRED_BYTES", 8 * pixels * group)
    found = mcsim.limit(run, settings=mcsim.LimitSettings(only=only, probes=64)).effects
    pairs = sum(n * (n - 1) / 2 for n in [group] * (64 // group) + [64 % group] if n > 2)
    expected = 1.0 / np.sqrt(2.0 * pairs)
    for one, reference in zip(found, exact, strict=True):
        assert one.label == reference.label
        assert 0.1 * expected < one.error < 2.0 * expected  # by the number of modes and of components
        assert abs(one.sigma / reference.sigma - 1.0) < 4.0 * one.error
